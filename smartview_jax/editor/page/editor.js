// The editor's page: tools, keys, lists, and what a click means. What is right and where points are
// is Python's to say; the page asks, and draws the answers.

import { layOut } from "./layout.js";
import { Model } from "./model.js";
import { PictureView } from "./picture_view.js";
import { SpaceView } from "./space_view.js";

const TOOLS = {
  point: { key: "p", label: "Points", icon: '<circle cx="10" cy="10" r="2.2"/><path d="M10 2v4M10 14v4M2 10h4M14 10h4"/>',
    help: "Click a feature in one view, then the same one in another: the two clicks make a point in space. Alt-click does not snap." },
  edge: { key: "e", label: "Edges", icon: '<path d="M4 16 16 4"/><circle cx="4" cy="16" r="1.6"/><circle cx="16" cy="4" r="1.6"/>',
    help: "Click points one after another to join them. Esc ends the line." },
  face: { key: "f", label: "Faces", icon: '<path d="M4 13 9 4l8 3-3 9z"/>',
    help: "Click the corners of a flat surface around it; the first corner again, or Enter, closes it." },
  grasp: { key: "g", label: "Grasps", icon: '<path d="M4 18V9a6 6 0 0 1 12 0v9M10 3V1"/>',
    help: "Click on a face to place the gripper, and drag to turn it." },
  region: { key: "r", label: "Region", icon: '<rect x="3" y="5" width="14" height="10" stroke-dasharray="3 2"/>',
    help: "Drag a rectangle around the object in one view or in several: only points seen inside are proposed. A click in a view removes its rectangle." },
  select: { key: "s", label: "Select", icon: '<path d="M5 3l11 6-5 1.5L8.5 16z"/>',
    help: "Click points or edges, with Shift for several: see distances, say what you know of them, or delete them." },
};
const KEYS = [
  ["P E F G R S", "tools: points, edges, faces, grasps, region, select"],
  ["N  or  Esc", "next point; end a line or a face"],
  ["Enter", "close a face"],
  ["Del", "delete what is chosen"],
  ["Ctrl Z   Ctrl Y", "undo, redo"],
  ["Ctrl S", "write the model's file"],
  ["1 … 9,  double click", "make a view large; again for all views"],
  ["wheel,  right drag", "zoom, pan"],
  ["Z   0", "zoom all pictures to the object; show them whole"],
  ["A   X", "accept, reject the proposed point that is marked"],
  ["Alt click", "click without snapping to a corner"],
  ["?", "this help"],
];
const HOVER_PAUSE = 25;  // ms between two curves that follow the mouse
const JUDGE_PAUSE = 400;  // ms without a change before symmetry, disagreements and suggestions are asked for

export function start(root, connection) { return new Editor(root, connection); }

class Editor {
  constructor(root, connection) {
    this.connection = connection;
    this.model = new Model();
    this.tool = "point"; this.active = null; this.selection = new Set(); this.chain = [];
    this.curves = null; this.previews = new Map(); this.rectangles = new Map(); this.symmetry = null; this.judgement = { disagreements: [], suggestions: [] }; this.doubts = new Map(); this.pointedAt = []; this.views = []; this.offer = { points: [], edges: [] }; this.busy = Promise.resolve();
    this.build(root);
    connection.onUpdate = (message) => this.accept(message);
    connection.onState = (state) => this.connected(state);
    connection.open();
    window.smartviewEditor = this;  // for the tests of the page
  }

  html(text) {
    const template = document.createElement("template");
    template.innerHTML = text.trim();
    return template.content.firstChild;
  }

  escape(text) {
    return String(text).replace(/[&<>"']/g, (c) => `&#${c.charCodeAt(0)};`);
  }

  build(root) {
    const tools = Object.entries(TOOLS).map(([name, tool]) => `<button data-tool="${name}" title="${tool.label} (${tool.key.toUpperCase()})"><svg viewBox="0 0 20 20">${tool.icon}</svg>${tool.label}</button>`).join("");
    const keys = KEYS.map(([key, text]) => `<tr><td>${key.split(/ {2,}/).map((part) => (/^(or)$/.test(part) ? part : `<kbd>${part}</kbd>`)).join(" ")}</td><td>${text}</td></tr>`).join("");
    this.root = this.html(`<div class="sv" tabindex="0">
      <div class="sv-head"><label class="sv-field"><input class="sv-name" placeholder="name of the object" aria-label="name of the object" data-empty="no name: the file has none"></label>
        <span class="grow"></span><span class="sv-kept">connecting</span>
        <button data-do="object" title="Z: zoom all pictures to the object">Zoom to object</button><button data-do="whole" title="0: show all pictures whole">Whole pictures</button>
        <button data-do="propose" title="match all views and offer points">Propose all</button><button data-do="undo" title="Ctrl Z">Undo</button><button data-do="redo" title="Ctrl Y">Redo</button>
        <button data-do="save" class="sv-save" title="Ctrl S">Save</button><button data-do="help" title="?">?</button></div>
      <div class="sv-tools">${tools}</div><div class="sv-views"></div>
      <div class="sv-side"><h3>Chosen</h3><div class="box detail"></div><div class="doubts" hidden><h3>Disagrees</h3><div class="box"></div></div><div class="suggested" hidden><h3>Likely</h3><div class="box"></div></div><div class="offer" hidden><h3>Proposed</h3><div class="box"></div></div><div class="symmetry" hidden><h3>Symmetry</h3><div class="box"></div></div><h3>Object, in mm</h3><div class="list"></div></div>
      <div class="sv-foot"><span class="grow said"></span><span class="counts"></span></div>
      <div class="sv-help" hidden><div><h2>Keys</h2><table>${keys}</table></div></div>
      <div class="sv-veil"><span>connecting …</span></div></div>`);
    root.replaceChildren(this.root);
    this.find = (selector) => this.root.querySelector(selector);
    this.root.addEventListener("click", (event) => {
      const button = event.target.closest("button");
      if (button?.dataset.tool) this.use(button.dataset.tool);
      if (button?.dataset.do) this.command(button.dataset.do);
      if (event.target.closest(".sv-help")) this.find(".sv-help").hidden = true;
    });
    this.checkName(this.find(".sv-name"), { do: "rename" }, () => this.root.focus());
    this.root.ownerDocument.addEventListener("keydown", (event) => this.key(event));
    this.root.ownerDocument.addEventListener("keyup", (event) => { if (event.code === "Space") this.space = false; });
    this.use("point");
  }

  async connected(state) {
    this.find(".sv-veil").hidden = state === "open" && this.views.length > 0;
    if (state !== "open") {
      this.find(".sv-veil").firstChild.textContent = this.views.length ? "The server is gone. Everything that was answered is kept; trying again …" : "connecting …";
      this.find(".sv-kept").className = "sv-kept lost";
      this.find(".sv-kept").textContent = "not connected";
      return;
    }
    try {
      const greeting = await this.connection.ask({ do: "hello" });
      this.model.greet(greeting);
      this.active = null; this.chain = []; this.selection.clear(); this.curves = null;
      if (!this.views.length) this.arrange();
      this.find(".sv-veil").hidden = true;
      this.refresh();
      this.judgeLater();
      if (greeting.notes.length) this.say(greeting.notes.join("; "));
      this.ready = Promise.all(this.views.map((view) => this.loadPicture(view)));
      await this.ready;
      for (const view of this.views) await this.loadFeatures(view);
      this.complete = true;
    } catch (error) { this.say(error.message, true); }
  }

  async loadPicture(view) {
    if (view.levels.length) return;
    view.element.querySelector(".label span").textContent = "loading …";
    await view.load(await this.connection.picture(view.name));
    view.element.querySelector(".label span").textContent = "";
  }

  async loadFeatures(view) {
    try {
      const found = await this.connection.ask({ do: "features", view: view.name });
      this.model.corners.set(view.name, found.corners);
      view.redraw("picture");
    } catch (error) { this.say(error.message, true); }
  }

  arrange() {
    const box = this.find(".sv-views");
    this.views = this.model.views.map((view, k) => new PictureView(this, k, view.name));
    this.space3d = new SpaceView(this);
    box.replaceChildren(...this.views.map((view) => view.element), this.space3d.element);
    new ResizeObserver(() => this.layOut()).observe(box);
    document.title = `${this.model.file ?? "object"} · smartview model`;
  }

  layOut() {
    const box = this.find(".sv-views"), aspects = this.views.map(({ size: [width, height] }) => Math.log(width / height));
    if (!box.clientWidth || !box.clientHeight) return;
    const { pictures, space } = layOut(this.views.length, Math.exp(aspects.reduce((sum, one) => sum + one, 0) / aspects.length), box.clientWidth, box.clientHeight);
    [...pictures, space].forEach((rectangle, k) => {
      const style = (this.views[k] ?? this.space3d).element.style;
      ["left", "top", "width", "height"].forEach((side, n) => { style[side] = `${rectangle[n]}px`; });
    });
  }

  enlarge(view) {
    const large = !view.element.classList.contains("large");
    for (const one of [...this.views, this.space3d]) one.element.classList.remove("large");
    view.element.classList.toggle("large", large);
  }

  use(tool) {
    this.tool = tool; this.chain = []; this.curves = null;
    if (tool !== "point") this.active = null;
    for (const button of this.root.querySelectorAll(".sv-tools button")) button.classList.toggle("on", button.dataset.tool === tool);
    this.say(TOOLS[tool].help);
    for (const view of this.views) view.redraw("picture");
    this.refresh();
  }

  say(text, bad = false) {
    const said = this.find(".said");
    said.textContent = text;
    said.classList.toggle("bad", bad);
  }

  // A change is answered by what it moved. Changes are made one after another.
  change(message) {
    const asked = performance.now();
    this.busy = this.busy.then(async () => {
      try {
        const answer = await this.connection.ask(message);
        this.accept(answer);
        this.lastAnswer = { asked, answered: performance.now() };
        if (answer.note) this.say(answer.note);
        return answer;
      } catch (error) { this.say(error.message, true); return null; }
    });
    return this.busy;
  }

  accept(message) {
    this.model.update(message);
    if (message.offer) this.offer = message.offer;
    this.judgeLater();
    for (const key of this.selection) {
      const [kind, id] = key.split(":");
      if (!this.model[kind].has(+id)) this.selection.delete(key);
    }
    if (!this.model.points.has(this.active)) this.active = null;
    this.chain = this.chain.filter((id) => this.model.points.has(id));
    this.refresh();
  }

  refresh() {
    for (const view of this.views) view.redraw("model", "live");
    this.space3d?.update();
    this.showStatus();
    this.showDetail();
    this.showOffer();
    this.showList();
  }

  showStatus() {
    const { can_undo, can_redo, saved, kept, name } = this.model.status, label = this.find(".sv-kept");
    this.find('[data-do="undo"]').disabled = !can_undo;
    this.find('[data-do="redo"]').disabled = !can_redo;
    const input = this.find(".sv-name");
    if (this.root.ownerDocument.activeElement !== input && !input.classList.contains("bad")) input.value = name ?? "";
    label.className = `sv-kept ${saved ? "saved" : kept ? "kept" : ""}`;
    label.textContent = saved ? `all saved in ${this.model.file}` : kept ? `every change kept · ${this.model.file} not written yet` : "in memory only";
    const { points, edges, faces, grasps } = this.model;
    this.find(".counts").textContent = [[points, "point"], [edges, "edge"], [faces, "face"], [grasps, "grasp"]].map(([all, word]) => `${all.size} ${word}${all.size === 1 ? "" : "s"}`).join(" · ");
  }

  // What is chosen, in numbers; the one place where positions are read.
  showDetail() {
    const box = this.find(".detail");
    // A name that cannot be kept stays to be mended.
    if (box.contains(this.root.ownerDocument.activeElement) && box.querySelector("input.bad")) return;
    const chosen = [...this.selection].map((key) => key.split(":"));
    const points = chosen.filter(([kind]) => kind === "points").map(([, id]) => +id);
    if (this.active !== null && !points.includes(this.active)) points.unshift(this.active);
    const others = chosen.filter(([one]) => one !== "points"), [kind, id] = others[0] ?? [];
    if (others.length > 1) box.innerHTML = `<div class="big">${others.length} ${kind}</div>`;
    else if (kind) box.innerHTML = this[`${kind}Detail`](+id, this.model[kind].get(+id));
    else if (points.length === 2) this.distanceDetail(box, points);
    else if (points.length === 1) box.innerHTML = this.pointsDetail(points[0], this.model.points.get(points[0]));
    else if (points.length) box.innerHTML = `<div class="big">${points.length} points</div>`;
    else box.innerHTML = `<span class="dim">nothing</span>`;
    this.offerFacts(box, chosen);
    for (const button of box.querySelectorAll("[data-change]")) button.onclick = () => this.change(JSON.parse(button.dataset.change));
    for (const input of box.querySelectorAll("[data-name]")) this.checkName(input, JSON.parse(input.dataset.name));
    for (const input of box.querySelectorAll("[data-key]")) {
      input.onchange = () => this.change({ ...JSON.parse(input.dataset.ask), [input.dataset.key]: input.value / 1000 });
    }
  }

  // What Python proposes, one by one: the first of the offer is marked in all views.
  showOffer() {
    const { points, edges } = this.offer, box = this.find(".offer");
    box.hidden = !points.length;
    if (!points.length) return;
    const [first] = points;
    box.querySelector(".box").innerHTML = `<div class="big">${points.length} <small>points, ${edges.length} edges</small></div>
      <span class="dim">marked: seen in ${first.views} views, ${first.rms.toFixed(2)} px</span>
      <div class="sv-buttons"><button data-decide="accept">Accept <kbd>A</kbd></button><button data-decide="reject">Reject <kbd>X</kbd></button><button data-decide="all">Accept all</button></div>`;
    for (const button of box.querySelectorAll("[data-decide]")) button.onclick = () => this.decide(button.dataset.decide);
  }

  // Asked for when the model has been left alone for a moment: Python may take a while.
  judgeLater() {
    clearTimeout(this.judgeTimer);
    const turn = this.judgeTurn = (this.judgeTurn ?? 0) + 1;
    this.judgeTimer = setTimeout(async () => {
      const asked = [this.model.points.size < 3 ? null : { do: "symmetry" }, { do: "judge" }];
      const [found, judgement] = await Promise.all(asked.map((ask) => ask && this.connection.ask(ask).catch(() => null)));
      if (turn !== this.judgeTurn) return;  // the model has changed meanwhile, and is judged again
      this.symmetry = found?.symmetry ?? null;
      this.judgement = judgement ?? { disagreements: [], suggestions: [] };
      this.doubts = new Map(this.judgement.disagreements.map((one) => [`${one.kind}:${one.id}`, one]));
      this.pointedAt = [];
      this.showSymmetry();
      this.showJudgement();
      for (const view of this.views) view.redraw("model");
      this.space3d?.update();
      this.showList();
    }, JUDGE_PAUSE);
  }

  // What disagrees, with the click to doubt; and what the data make likely, for the person to state.
  showJudgement() {
    const { disagreements, suggestions } = this.judgement, doubts = this.find(".doubts"), likely = this.find(".suggested");
    doubts.hidden = !disagreements.length; likely.hidden = !suggestions.length;
    // A fact about an edge that is shown says nothing more.
    const named = new Set(disagreements.filter(({ kind }) => kind === "edges").map(({ id }) => String([...(this.model.edges.get(id)?.ends ?? [])].sort())));
    const told = ({ kind, id }) => kind === "constraints" && this.model.constraints.get(id)?.items.some((ends) => named.has(String([...ends].sort())));
    doubts.querySelector(".box").innerHTML = disagreements.filter((one) => !told(one)).map((one) => `<div class="sv-doubt" data-row="${one.kind}:${one.id}"><b>${this.partName(one.kind, one.id)}</b> ${this.escape(one.words)}${this.residualsOf(one)}</div>`).join("");
    for (const element of doubts.querySelectorAll("[data-row]")) element.onclick = () => { this.selection = new Set([element.dataset.row]); this.refresh(); };
    likely.querySelector(".box").innerHTML = `<div class="dim">Click what is true; nothing is assumed.</div>${suggestions.map((one, k) => `<button class="sv-likely" data-likely="${k}" title="${this.escape(one.why)}; odds ${this.escape(one.odds)}"><span class="grow">${one.items.map((ends) => ends.join("–")).join(", ")} ${this.escape(one.words)}</span><span class="num">${this.escape(one.odds)}</span><small>${this.escape(one.why)}</small></button>`).join("")}`;
    for (const button of likely.querySelectorAll("[data-likely]")) {
      const { kind, items } = suggestions[button.dataset.likely];
      button.onclick = () => this.change({ do: "add_constraint", kind, items });
      button.onmouseenter = () => this.pointAt(items);
      button.onmouseleave = () => this.pointAt([]);
    }
  }

  pointAt(edges) {
    this.pointedAt = edges;
    for (const view of this.views) view.redraw("model");
  }

  partName(kind, id) {
    if (kind === "edges") return this.model.edges.get(id)?.ends.join(" – ") ?? `edge ${id}`;
    return kind === "constraints" ? this.escape(this.model.constraints.get(id)?.words ?? "") : `point ${id}`;
  }

  // The residuals by view, those of clicks that may be wrong in red.
  residualsOf({ kind, residuals, suspects }) {
    const wrong = (point, view) => suspects.some(([p, v]) => p === point && v === view);
    const shown = residuals.map(([point, view, size]) => `<span class="${wrong(point, view) ? "bad" : ""}">${kind === "points" ? "" : `${point} in `}${this.escape(view)} ${size.toFixed(1)}</span>`);
    return shown.length ? `<small>residuals, px: ${shown.join(" · ")}</small>` : "";
  }

  // A name is checked while it is typed, by the same rule that would refuse it; a wrong one is not sent.
  checkName(input, change, done = () => {}) {
    const problem = document.createElement("span");
    problem.className = "sv-problem";
    problem.setAttribute("role", "alert");
    input.after(problem);
    input.addEventListener("input", async () => {
      const name = input.value.trim();
      const found = await this.connection.ask({ do: "check", change: { ...change, name } }).catch((error) => ({ problem: error.message }));
      if (name !== input.value.trim()) return;  // typed on meanwhile
      problem.textContent = found.problem || (name ? "" : input.dataset.empty ?? "");
      problem.classList.toggle("note", !found.problem);
      input.classList.toggle("bad", Boolean(found.problem));
      input.setAttribute("aria-invalid", Boolean(found.problem));
    });
    input.addEventListener("change", () => {
      if (input.classList.contains("bad")) return;
      problem.textContent = "";
      this.change({ ...change, name: input.value.trim() });
      done();
    });
  }

  // What the geometry says, for the person to confirm: a label may tell two poses apart.
  showSymmetry() {
    const box = this.find(".symmetry"), one = this.symmetry;
    box.hidden = !one || (one.order === 1 && !one.round);
    if (box.hidden) return;
    const say = (label, confirmed) => this.button(label, { do: "confirm_symmetry", confirmed: one.said === confirmed ? null : confirmed, order: one.order }, one.said === confirmed);
    box.querySelector(".box").innerHTML = `<div class="big">${one.round ? "round" : `${one.order} <small>poses look alike</small>`}</div><span class="dim">${this.escape(one.words)}</span>
      <div class="${one.said === null ? "" : "dim"}">${one.said === null ? "Is it meant? Until you say so, the file has none." : one.said ? "confirmed: saved with the model" : "refused: all poses can be told apart"}</div>
      <div class="sv-buttons">${say("Confirm", true)}${say("Refuse", false)}</div>`;
    for (const button of box.querySelectorAll("[data-change]")) button.onclick = () => this.change(JSON.parse(button.dataset.change));
  }

  async decide(how) {
    const numbers = this.offer.points.map((point) => point.number);
    if (!numbers.length) return;
    await this.change({ do: how === "reject" ? "reject" : "accept", points: how === "all" ? numbers : numbers.slice(0, 1) });
    if (how === "all") this.say(`${numbers.length} points accepted; undo takes them back together`);
  }

  async propose() {
    const rectangles = Object.fromEntries(this.rectangles);
    this.say(this.rectangles.size ? `matching the corners of all views within the region (${[...this.rectangles.keys()].join(", ")}) …` : "matching the corners of all views …");
    const answer = await this.connection.ask({ do: "propose", rectangles }).catch((error) => { this.say(error.message, true); });
    if (!answer) return;
    this.accept(answer);
    this.say(answer.offer.points.length ? "Accept or reject the proposed points one by one, or all of them." : "Nothing was found that is not there already.");
  }

  // What can be said of what is chosen: buttons that make constraints.
  offerFacts(box, chosen) {
    const kinds = new Set(chosen.map(([kind]) => kind));
    if (!this.model.facts || kinds.size !== 1 || !(kinds.has("points") || kinds.has("edges")) || this.tool !== "select") return;
    const [takes] = kinds, ids = chosen.map(([, id]) => +id);
    const fitting = this.model.facts.filter((fact) => fact.takes === takes && fact.least <= ids.length && ids.length <= fact.most && !(fact.kind === "symmetric" && ids.length % 2));
    if (takes === "points" && ids.length === 2) fitting.push(this.model.facts.find((fact) => fact.kind === "known_length"));
    if (!fitting.length) return;
    const items = takes === "points" ? [ids] : ids.map((id) => this.model.edges.get(id).ends);
    const buttons = fitting.map((fact) => (fact.kind === "known_length"
      ? `<input type="number" step="0.1" placeholder="length" data-key="value" data-ask='${this.escape(JSON.stringify({ do: "add_constraint", kind: fact.kind, items }))}'> mm`
      : this.button(fact.words, { do: "add_constraint", kind: fact.kind, items })));
    box.insertAdjacentHTML("beforeend", `<div class="dim" style="margin-top:8px">I know that they are</div><div class="sv-buttons">${buttons.join("")}</div>`);
  }

  constraintsDetail(id, one) {
    return `<div class="big">${this.escape(one.words)} <small>${one.value_mm === null ? "" : `${one.value_mm} mm`}</small></div>
      <span class="dim">${one.items.map((group) => group.join(" – ")).join(", ")}</span>${one.problem ? `<div class="bad">${this.escape(one.problem)}</div>` : ""}`;
  }

  pointsDetail(id, point) {
    const rows = Object.keys(point.clicks).map((view) => {
      const residual = point.residuals?.[view], wrong = point.wrong?.[view];
      const size = residual ? `${Math.hypot(...residual).toFixed(2)} px` : "";
      const reason = wrong ? `<tr><td colspan="2" class="bad">${this.escape(wrong)}</td></tr>` : "";
      return `<tr><td>${this.escape(view)}</td><td class="${wrong ? "bad" : "dim"}">${size} ${this.button("×", { do: "remove_click", point: id, view })}</td></tr>${reason}`;
    }).join("");
    const place = point.at
      ? `<table>${["x", "y", "z"].map((axis, k) => `<tr><td class="dim">${axis}</td><td>${(1e3 * point.at[k]).toFixed(2)} ± ${point.sigma_mm[k].toFixed(2)} mm</td></tr>`).join("")}</table>`
      : `<div class="bad">${this.escape(point.problem)}</div>`;
    return `<div class="big">Point ${id}</div>${place}<table style="margin-top:6px"><tr><td class="dim">clicked in</td><td class="dim">residual</td></tr>${rows}</table>`;
  }

  edgesDetail(id, edge) {
    const doubt = this.doubts.get(`edges:${id}`);
    return `<div class="big">${edge.mm === undefined ? "" : `${edge.mm.toFixed(2)} <small>± ${edge.sigma_mm.toFixed(2)} mm</small>`}</div><span class="${edge.problem ? "bad" : "dim"}">${edge.problem ? this.escape(edge.problem) : `edge between ${edge.ends[0]} and ${edge.ends[1]}`}</span>${doubt ? `<div class="bad">${this.escape(doubt.words)}</div>` : ""}`;
  }

  facesDetail(id, face) {
    const choice = (label, value) => this.button(label, { do: "change_face", id, graspable: value }, face.graspable === value);
    return `<div class="big">Face ${id} <small>${face.area_mm2 === undefined ? "" : `${face.area_mm2.toFixed(0)} mm²`}</small></div>
      ${face.problem ? `<div class="bad">${this.escape(face.problem)}</div>` : ""}
      ${this.nameField(face, { do: "change_face", id }, `face ${id}`)}
      <div class="sv-buttons">${choice("graspable", true)}${choice("not graspable", false)}
      ${this.button("turn over", { do: "change_face", id, loop: [...face.loop].reverse() })}</div>`;
  }

  nameField(part, change, shown) {
    return `<label class="sv-field"><input class="sv-text" placeholder="name" aria-label="name" value="${this.escape(part.name)}" data-empty="no name: shown as ${shown}" data-name='${JSON.stringify(change)}'></label>`;
  }

  graspsDetail(id, grasp) {
    const ask = JSON.stringify({ do: "change_grasp", id });
    const number = (label, key, value) => `<tr><td class="dim">${label}</td><td><span class="sv-buttons" style="display:inline-flex;margin:0"><input type="number" step="0.5" data-key="${key}" data-ask='${ask}' value="${value}"></span> mm</td></tr>`;
    const rows = grasp.problem ? "" : `<table>${number("opening", "opening", grasp.opening_mm)}${number("depth", "depth", grasp.depth_mm)}
      <tr><td class="dim">object there</td><td>${grasp.width_mm === null ? "open" : `${grasp.width_mm.toFixed(2)} mm`}</td></tr>
      <tr><td class="dim">tolerance</td><td>± ${grasp.tolerance_mm.toFixed(2)} mm</td></tr></table>`;
    return `<div class="big">Grasp ${id} <small>on face ${grasp.face}</small></div>${this.nameField(grasp, { do: "change_grasp", id }, `grasp ${id}`)}${grasp.problem ? `<div class="bad">${this.escape(grasp.problem)}</div>` : rows}`;
  }

  async distanceDetail(box, [a, b]) {
    const key = `${a}-${b}`;
    box.dataset.key = key;
    box.innerHTML = `<span class="dim">distance of ${a} and ${b}</span>`;
    try {
      const found = await this.connection.ask({ do: "distance", a, b });
      if (box.dataset.key === key && box.textContent.startsWith("distance")) box.innerHTML = `<div class="big">${found.mm.toFixed(2)} <small>± ${found.sigma_mm.toFixed(2)} mm</small></div><span class="dim">distance of ${a} and ${b}</span>`;
    } catch (error) { box.innerHTML = `<span class="bad">${this.escape(error.message)}</span>`; }
  }

  button(label, change, on = false) {
    return `<button class="${on ? "on" : ""}" data-change='${this.escape(JSON.stringify(change))}'>${label}</button>`;
  }

  // The list is made anew at most a few times a second, and not longer than a screen or two.
  showList() {
    if (this.listTimer) return;
    this.listTimer = setTimeout(() => { this.listTimer = null; this.makeList(); }, 120);
  }

  makeList() {
    const { points, edges, faces, grasps, constraints } = this.model, rows = [], most = 150;
    const row = (kind, id, mark, text, number) => {
      const doubt = this.doubts.get(`${kind}:${id}`);
      // A doubted point shows its residuals by view instead of its deviation.
      if (doubt && kind === "points") number = `${doubt.residuals.map(([, view, size]) => `${this.escape(view)} ${size.toFixed(1)}`).join(" · ")} px`;
      rows.push(`<div title="${doubt ? this.escape(doubt.words) : ""}" class="sv-row ${doubt ? "doubt" : ""} ${this.selection.has(`${kind}:${id}`) || (kind === "points" && id === this.active) ? "on" : ""}" data-row="${kind}:${id}"><i class="${doubt ? "bad" : mark}"></i><span class="grow">${text}</span><span class="num">${number}</span></div>`);
    };
    for (const [id, one] of grasps) row("grasps", id, one.problem ? "bad" : "grasp", this.escape(one.name || `grasp ${id}`), one.problem ? "" : `opens ${one.opening_mm}`);
    for (const [id, one] of faces) row("faces", id, one.problem ? "bad" : "face", this.escape(one.name || `face ${id}`), one.graspable === true ? "graspable" : one.graspable === false ? "not" : "");
    for (const [id, one] of constraints) row("constraints", id, one.problem ? "bad" : "fact", this.escape(one.words), one.value_mm === null ? one.items.map((group) => group.join("–")).join(" ") : `${one.value_mm} mm`);
    for (const [id, one] of [...edges].slice(-most)) row("edges", id, one.problem ? "bad" : "edge", `${one.ends[0]} – ${one.ends[1]}`, one.mm === undefined ? "" : `${one.mm.toFixed(2)} ± ${one.sigma_mm.toFixed(2)}`);
    for (const [id, one] of [...points].slice(-most)) row("points", id, one.problem || one.wrong ? "bad" : "", `point ${id}`, one.at ? `${Object.keys(one.clicks).length} views · ${Math.max(...one.sigma_mm).toFixed(2)}` : `${Object.keys(one.clicks).length} view`);
    const list = this.find(".list");
    list.innerHTML = rows.join("") || `<div class="dim" style="padding:6px">Click a corner in two views.</div>`;
    for (const element of list.querySelectorAll("[data-row]")) {
      element.onclick = (event) => {
        if (!event.shiftKey && !event.ctrlKey) this.selection.clear();
        this.toggle(element.dataset.row);
        this.refresh();
      };
    }
  }

  toggle(key) { if (!this.selection.delete(key)) this.selection.add(key); }

  // -- the mouse in a picture -------------------------------------------------------------------

  press(view, target, drag) {
    clearTimeout(this.hoverTimer);  // a click is answered before any curve
    this.hovering = false;
    if (this.tool === "grasp") drag.grasp = this.placeGrasp(view, target.pixel);
    if (this.tool === "region") drag.corner = view.toPixel(drag.from);
    if (this.tool === "point" && target.point !== null) drag.point = target.point;
    this.root.focus({ preventScroll: true });
  }

  async placeGrasp(view, pixel) {
    const answer = await this.change({ do: "grasp_at", view: view.name, pixel });
    if (!answer) return null;
    this.selection = new Set([`grasps:${answer.new}`]);
    this.refresh();
    return answer.new;
  }

  async dragged(view, pixel, drag) {
    if (drag.corner) this.rectangles.set(view.name, this.rectangle(view, drag.corner, pixel));
    if (drag.grasp && !drag.asking) {
      drag.asking = true;
      const grasp = await drag.grasp;
      try {
        if (grasp !== null) {
          const found = await this.connection.ask({ do: "turn_grasp", grasp, view: view.name, pixel });
          if (!drag.done) { this.previews.set(grasp, found.entry); for (const one of this.views) one.redraw("model"); }
        }
      } catch (error) { this.say(error.message, true); }
      drag.asking = false;
    }
    if (drag.point !== undefined && this.tool === "point") {
      // The click follows the mouse in this picture; Python hears of it when it is let go.
      const point = this.model.points.get(drag.point);
      if (point?.clicks[view.name]) { point.clicks[view.name] = pixel; view.redraw("model"); }
    }
  }

  // Smallest u and v, then largest: within the picture, whichever way it was drawn.
  rectangle(view, [a, b], [c, d]) {
    const [width, height] = view.size, within = (x, most) => Math.min(Math.max(x, -0.5), most - 0.5);
    return [within(Math.min(a, c), width), within(Math.min(b, d), height), within(Math.max(a, c), width), within(Math.max(b, d), height)];
  }

  releasedRegion(view, drag) {
    if (!drag.moved) this.rectangles.delete(view.name);
    const count = this.rectangles.size;
    this.find('[data-do="propose"]').textContent = count ? "Propose in region" : "Propose all";
    this.say(count ? `Points are proposed that are seen in ${count === 1 ? "the rectangle" : `all ${count} rectangles`}. A click in a view removes its rectangle.` : TOOLS.region.help);
    view.redraw("live");
  }

  async released(view, target, drag, event) {
    if (this.tool === "region") return this.releasedRegion(view, drag);
    if (this.tool === "grasp") return this.releasedGrasp(view, target, drag);
    if (this.tool === "point") return this.releasedPoint(view, target, drag);
    if (target.point === null) { if (this.tool === "select") { if (!event.shiftKey && !event.ctrlKey) this.selection.clear(); this.chooseOther(view, target.pixel); this.refresh(); } return; }
    if (this.tool === "edge") await this.joinTo(target.point);
    else if (this.tool === "face") await this.turnTo(target.point);
    else {
      if (!event.shiftKey && !event.ctrlKey && this.selection.size > 1) this.selection.clear();
      for (const key of this.selection) if (!key.startsWith("points:")) this.selection.delete(key);
      this.toggle(`points:${target.point}`);
      this.refresh();
    }
  }

  async releasedGrasp(view, target, drag) {
    drag.done = true;
    const grasp = await drag.grasp;
    if (grasp === null || grasp === undefined) return;
    this.previews.delete(grasp);
    if (drag.moved) await this.change({ do: "turn_grasp", grasp, view: view.name, pixel: target.pixel, commit: true });
  }

  async releasedPoint(view, target, drag) {
    if (drag.point !== undefined && drag.moved) {
      if (this.model.points.get(drag.point)?.clicks[view.name]) await this.change({ do: "click", point: drag.point, view: view.name, pixel: view.toPixel(view.cursor) });
      return;
    }
    const point = this.model.points.get(this.active);
    // Clicking the active point where it is only predicted says that it is there.
    if (target.point !== null && !(target.point === this.active && !point.clicks[view.name])) return this.activate(target.point);
    if (point && !point.clicks[view.name]) await this.change({ do: "click", point: this.active, view: view.name, pixel: target.pixel });
    else {
      const answer = await this.change({ do: "add_point", clicks: { [view.name]: target.pixel } });
      if (answer) this.active = answer.new;
    }
    this.activate(this.active);
  }

  // The point that the next clicks belong to; one click draws its curves in the other views.
  async activate(id) {
    this.active = id;
    this.selection.clear();
    this.curves = null;
    this.refresh();
    const clicks = Object.entries(this.model.points.get(id)?.clicks ?? {});
    if (clicks.length === 1) await this.showCurves(...clicks[0]);
  }

  async showCurves(view, pixel) {
    try {
      const found = await this.connection.ask({ do: "hover", view, pixel });
      const only = Object.entries(this.model.points.get(this.active)?.clicks ?? {});
      // The mouse or the person may have gone on while Python computed.
      if (this.tool === "point" && (this.active === null || only.length === 1)) this.curves = found;
    } catch { this.curves = null; }
    for (const one of this.views) one.redraw("live");
  }

  hovered(view, target) {
    if (this.tool !== "point" || this.active !== null || this.hovering || !this.model.views.length) return;
    const [width, height] = view.size, [u, v] = target.pixel;
    if (!(u >= -0.5 && v >= -0.5 && u <= width - 0.5 && v <= height - 0.5)) return;
    // Not at once: the mouse of somebody who clicks moves until it is pressed.
    this.hovering = true;
    this.hoverTimer = setTimeout(() => {
      const place = view.cursor ? view.target(view.cursor, false).pixel : target.pixel;
      this.showCurves(view.name, place).finally(() => { this.hovering = false; });
    }, HOVER_PAUSE);
  }

  left() {
    if (this.active === null && this.curves) { this.curves = null; for (const one of this.views) one.redraw("live"); }
  }

  async joinTo(point) {
    const last = this.chain.at(-1);
    this.chain = [point];
    const joined = [...this.model.edges.values()].some(({ ends }) => ends.includes(last) && ends.includes(point));
    if (last !== undefined && last !== point && !joined) await this.change({ do: "add_edge", ends: [last, point] });
    this.refresh();
  }

  async turnTo(point) {
    if (point === this.chain[0] && this.chain.length > 2) return this.closeFace();
    if (!this.chain.includes(point)) this.chain.push(point);
    this.refresh();
  }

  async closeFace() {
    const loop = this.chain;
    const answer = await this.change({ do: "add_face", loop });
    if (!answer) return;
    this.chain = [];
    const id = [...this.model.faces.keys()].at(-1);
    this.selection = new Set([`faces:${id}`]);
    this.refresh();
  }

  // With the select tool, an edge or a face that was clicked, if no point was.
  chooseOther(view, pixel) {
    let best = null, least = 7 / view.scale;
    for (const [id, edge] of this.model.edges) {
      const line = edge.in?.[view.index];
      if (!line) continue;
      for (let k = 0; k + 3 < line.length; k += 2) {
        const [dx, dy] = [line[k + 2] - line[k], line[k + 3] - line[k + 1]];
        const t = Math.min(1, Math.max(0, ((pixel[0] - line[k]) * dx + (pixel[1] - line[k + 1]) * dy) / (dx * dx + dy * dy || 1)));
        const distance = Math.hypot(pixel[0] - line[k] - t * dx, pixel[1] - line[k + 1] - t * dy);
        if (distance < least) { least = distance; best = `edges:${id}`; }
      }
    }
    if (best) this.selection.add(best);
  }

  // -- keys -------------------------------------------------------------------------------------

  key(event) {
    if (!this.root.isConnected || event.target.matches?.("input, textarea")) return;
    // In a notebook the page is one of many things: its keys are its own only while it has focus.
    const page = this.root.ownerDocument;
    if (page.activeElement !== page.body && !this.root.contains(page.activeElement)) return;
    const name = event.key.toLowerCase(), control = event.ctrlKey || event.metaKey;
    const tool = Object.entries(TOOLS).find(([, one]) => one.key === name)?.[0];
    if (control && name === "z") this.command(event.shiftKey ? "redo" : "undo");
    else if (control && name === "y") this.command("redo");
    else if (control && name === "s") this.command("save");
    else if (control || event.altKey) return;
    else if (tool) this.use(tool);
    else if ((name === "a" || name === "x") && this.offer.points.length) this.decide(name === "a" ? "accept" : "reject");
    else if (name === "?") this.command("help");
    else if (name === "escape" || name === "n") this.rest();
    else if (name === "enter" && this.chain.length > 2) this.closeFace();
    else if (name === "delete" || name === "backspace") this.remove();
    else if (name === "z") this.command("object");
    else if (name === "0") this.command("whole");
    else if (/^[1-9]$/.test(name) && this.views[name - 1]) this.enlarge(this.views[name - 1]);
    else if (event.code === "Space") this.space = true;
    else return;
    event.preventDefault();
  }

  rest() {
    this.find(".sv-help").hidden = true;
    this.active = null; this.chain = []; this.curves = null; this.selection.clear();
    this.refresh();
  }

  async remove() {
    const keys = this.active !== null ? [`points:${this.active}`] : [...this.selection];
    const changes = keys.map((key) => ({ do: "delete", kind: key.split(":")[0], id: +key.split(":")[1] }));
    this.curves = null;
    if (changes.length === 1) await this.change(changes[0]);
    if (changes.length > 1) await this.change({ do: "several", changes });
  }

  command(name) {
    if (name === "help") this.find(".sv-help").hidden = !this.find(".sv-help").hidden;
    else if (name === "propose") this.propose();
    else if (name === "object" || name === "whole") for (const view of this.views) view.frame(name);
    else { this.curves = null; this.change({ do: name }); }
  }
}
