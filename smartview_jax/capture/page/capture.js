// The page of smartview capture: asks for the state a few times a second and shows it.

const POLL = 300; // ms between two questions
const $ = (id) => document.getElementById(id);
const picture = new Image();
let shown = null; // when the picture that is shown was taken
let state = null;

function text(id, value) {
  if ($(id).textContent !== value) $(id).textContent = value;
}

async function poll() {
  try {
    const answer = await fetch("status");
    if (!answer.ok) throw new Error(answer.status === 403 ? "open the printed address again" : "");
    state = await answer.json();
    show(state);
    if (state.target && state.target.time !== shown) await load(state.target.time);
  } catch (error) {
    text("state", `smartview capture does not answer ${error.message ?? ""}`);
    $("state").className = "bad";
  }
  setTimeout(poll, POLL);
}

async function load(time) {
  picture.src = `picture?at=${time}`;
  try {
    await picture.decode();
    shown = time;
    draw(state);
  } catch { /* the next one comes soon */ }
}

function draw({ target }) {
  const canvas = $("picture"), context = canvas.getContext("2d");
  canvas.width = picture.naturalWidth;
  canvas.height = picture.naturalHeight;
  context.drawImage(picture, 0, 0);
  const scale = picture.naturalWidth / target.size[0];
  context.strokeStyle = "#2fd4bd";
  context.lineWidth = Math.max(1.5, canvas.width / 500);
  for (const [u, v] of target.points) {
    context.beginPath();
    context.arc((u + 0.5) * scale, (v + 0.5) * scale, canvas.width / 160, 0, 2 * Math.PI);
    context.stroke();
  }
}

function show(s) {
  text("folder", s.folder);
  const troubles = s.troubles.join("; ");
  text("state", troubles || (s.moving ? "moving" : s.running ? "automatic run" : `${s.views} views`));
  $("state").className = troubles ? "bad" : s.reached ? "good" : "";
  const target = s.target;
  text("target", !target ? "no picture yet"
    : target.reason ? `target not found: ${target.reason}` : `target found: ${target.count} of ${target.of} points`);
  $("target").className = target && target.reason ? "bad" : "";
  text("error", s.error_mm === null ? "–" : `${s.error_mm.toPrecision(2)} mm`);
  text("goal", `expected error, goal ${s.goal_mm} mm`);
  const part = s.error_mm === null ? 0 : Math.min(1, s.goal_mm / s.error_mm);
  $("progress").style.width = `${100 * part}%`;
  $("progress").className = s.reached ? "reached" : "";
  text("fit", s.reached ? `stop: ${s.goal_mm} mm reached`
    : s.fitting ? `fitting ${s.views} views …`
    : s.fitted_views === 0 ? "the first fit needs 4 views"
    : `fit of ${s.fitted_views} views${s.reliable ? "" : "; reliable from 8 views on"}${s.warnings.length ? `; ${s.warnings[0]}` : ""}`);
  text("next", s.reached ? "no more views are needed"
    : s.proposal ? `${s.proposal.text}${s.proposal.rough ? "\n(from the drawing: go slowly)" : ""}`
    : "none proposed yet: tilt and turn the camera to all sides");
  text("robot", s.robot || "–");
  for (const units of document.querySelectorAll(".units")) units.textContent = `(${s.pose_units})`;
  text("lines", s.lines.join("\n"));
  $("typed").hidden = !s.typed;
  $("move").hidden = $("skip").hidden = false;
  $("move").disabled = !s.may_move || !s.proposal || s.moving || s.running;
  $("move").title = s.may_move ? "" : "start with --move";
  $("skip").disabled = !s.proposal || s.moving || s.running;
  $("take").disabled = s.moving || s.running || !target || Boolean(target.reason);
  $("run").disabled = s.moving || s.running || s.typed;
  const cells = s.cells.flat();
  if ($("cells").children.length !== cells.length) {
    $("cells").replaceChildren(...cells.map(() => document.createElement("i")));
  }
  cells.forEach((on, k) => { $("cells").children[k].className = on ? "on" : ""; });
  const names = ["most", "second", "least"];
  $("rotations").replaceChildren(...s.rotations_deg.map((degrees, k) => {
    const row = document.createElement("tr");
    for (const word of [`${degrees.toFixed(1)}°`, `rotation about the ${names[k]} turned axis`]) {
      row.append(Object.assign(document.createElement("td"), { textContent: word }));
    }
    return row;
  }));
}

async function command(message) {
  text("said", "…");
  $("said").className = "";
  try {
    const answer = await fetch("do", { method: "POST", body: JSON.stringify(message) });
    const { ok, text: said } = await answer.json();
    text("said", said);
    $("said").className = ok ? "good" : "bad";
    return ok;
  } catch {
    text("said", "no answer");
    $("said").className = "bad";
    return false;
  }
}

for (const id of ["take", "move", "skip", "run", "stop"]) {
  $(id).addEventListener("click", () => command({ do: id }));
}
$("typed").addEventListener("submit", async (event) => {
  event.preventDefault();
  if (await command({ do: "pose", text: $("pose").value })) $("pose").value = "";
});
document.addEventListener("keydown", (event) => {
  if (event.key === "Escape") command({ do: "stop" });
});

window.smartviewCapture = { get state() { return state; } };
poll();
