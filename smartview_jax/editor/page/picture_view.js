// One picture with zoom and pan, and what is drawn on it. Three canvases lie on one another: the
// picture, which changes when it is zoomed; the model, which changes with an answer; and what
// follows the mouse. So a mouse move with a thousand features draws a curve, not the features.

import { nearestOnCurve } from "./model.js";

const COLOURS = {
  point: "#2fd4bd", active: "#ffb224", edge: "#6fb3ff", curve: "#ff5fa8", bad: "#ff6b5e",
  offered: "#ffe27a", corner: "rgba(255,255,255,.42)", face: "rgba(167,139,250,.15)", graspable: "rgba(88,214,141,.20)",
  refused: "rgba(255,107,94,.16)",
};
// Standard deviation of where a person points, px of the screen; typical values, not measured here.
const CURSOR_SIGMA = { mouse: 1.5, pen: 1.5, touch: 8 };
const GRAB = 9;         // px of the screen: how near a mark has to be to be chosen, which measures nothing
const MARGIN = 0.2;     // of the object's width and height, around it
const MAX_SCALE = 60;   // px of the screen for one of the picture
const ELLIPSE_SIGMAS = 3;
const FEW_POINTS = 60;  // above it, names of points are shown only when the picture is zoomed

export class PictureView {
  constructor(owner, index, name) {
    this.owner = owner; this.index = index; this.name = name;
    this.element = document.createElement("div");
    this.element.className = "sv-view";
    this.element.dataset.view = name;
    this.layers = ["picture", "model", "live"].map(() => {
      const canvas = document.createElement("canvas");
      this.element.append(canvas);
      return canvas;
    });
    this.element.append(owner.html(`<div class="label">${owner.escape(name)} <span></span></div>`), owner.html(`<div class="hint"></div>`));
    this.hint = this.element.querySelector(".hint");
    this.levels = []; this.scale = 1; this.offset = [0, 0]; this.cursor = null; this.drag = null;
    this.pending = new Set();
    this.listen();
    this.framing = "whole"; this.pointer = "mouse";
    new ResizeObserver(() => this.frame()).observe(this.element);
  }

  // Width and height of the picture, px; the pictures of several cameras differ.
  get size() { return this.owner.model.views[this.index]?.size ?? [1, 1]; }

  async load(blob) {
    // Half-sized copies, so that a picture of 12 megapixels is drawn from one of the screen's size.
    let level = await createImageBitmap(blob);
    this.levels = [level];
    while (level.width > 700) {
      level = await createImageBitmap(level, { resizeWidth: level.width >> 1, resizeHeight: level.height >> 1, resizeQuality: "medium" });
      this.levels.push(level);
    }
    this.frame();
  }

  // Show the whole picture, or the part with the object: what is clicked or predicted here, else the
  // region that was drawn.
  frame(framing = this.framing) {
    this.framing = framing;
    const [width, height] = this.size;
    const box = this.element.getBoundingClientRect();
    if (!box.width || !box.height) return;
    this.ratio = window.devicePixelRatio || 1;
    for (const canvas of this.layers) {
      canvas.width = Math.round(box.width * this.ratio); canvas.height = Math.round(box.height * this.ratio);
    }
    this.smallest = Math.min(box.width / width, box.height / height);
    const [left, top, right, bottom] = (framing === "object" && this.objectRectangle()) || [-0.5, -0.5, width - 0.5, height - 0.5];
    this.scale = Math.min(MAX_SCALE, box.width / (right - left), box.height / (bottom - top));
    // The picture fills its cell where it is large enough, and is in the middle where it is not.
    this.offset = [[left + right, width, box.width], [top + bottom, height, box.height]].map(([sum, size, room]) => {
      const free = room - size * this.scale, centred = room / 2 - (sum / 2 + 0.5) * this.scale;
      return free >= 0 ? free / 2 : Math.min(0, Math.max(free, centred));
    });
    this.redraw("picture", "model", "live");
  }

  objectRectangle() {
    const { model, rectangles } = this.owner;
    const pixels = [...model.points.keys()].map((id) => model.pixel(id, this.index)).filter(Boolean);
    if (!pixels.length) return rectangles.get(this.name) ?? null;
    const [low, high] = [Math.min, Math.max].map((most) => [0, 1].map((k) => most(...pixels.map((pixel) => pixel[k]))));
    // A single point has no size: a sixteenth of the picture on each side.
    const margin = [0, 1].map((k) => Math.max(MARGIN * (high[k] - low[k]), this.size[0] / 16));
    return [low[0] - margin[0], low[1] - margin[1], high[0] + margin[0], high[1] + margin[1]];
  }

  // A pixel's centre has whole coordinates, so the picture begins at -0.5.
  toScreen([u, v]) { return [(u + 0.5) * this.scale + this.offset[0], (v + 0.5) * this.scale + this.offset[1]]; }
  toPixel([x, y]) { return [(x - this.offset[0]) / this.scale - 0.5, (y - this.offset[1]) / this.scale - 0.5]; }

  redraw(...layers) {
    if (!this.pending.size) requestAnimationFrame(() => {
      const wanted = new Set(this.pending);
      this.pending.clear();
      if (wanted.has("picture")) this.drawPicture();
      if (wanted.has("model")) this.drawModel();
      if (wanted.has("live")) this.drawLive();
      this.owner.drawn?.(this, wanted);
    });
    for (const layer of layers) this.pending.add(layer);
  }

  context(k) {
    const context = this.layers[k].getContext("2d");
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.clearRect(0, 0, this.layers[k].width, this.layers[k].height);
    context.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
    return context;
  }

  drawPicture() {
    const context = this.context(0);
    const [width, height] = this.size;
    const level = [...this.levels].reverse().find((one) => one.width >= width * this.scale * this.ratio) ?? this.levels[0];
    if (!level) return;
    context.imageSmoothingEnabled = this.scale < 4;
    context.drawImage(level, this.offset[0], this.offset[1], width * this.scale, height * this.scale);
    // Candidates belong to the picture: an answer does not change them.
    if (this.owner.tool === "point") this.drawCorners(context, this.owner.model);
  }

  drawModel() {
    const context = this.context(1), { model, selection, active } = this.owner;
    this.drawFaces(context, model, selection);
    this.drawEdges(context, model, selection);
    // What is usual is one path for all of it: a stroke for each of a thousand points takes long.
    const usual = [];
    for (const [id, point] of model.points) {
      const bad = point.problem || point.wrong;
      const special = id === active || bad || selection.has(`points:${id}`);
      if (special) this.drawPoints(context, [[id, point]], bad && id !== active ? COLOURS.bad : COLOURS.active, 2);
      else usual.push([id, point]);
    }
    this.drawPoints(context, usual, COLOURS.point, 1.3);
    this.drawOffer(context, this.owner.offer);
    this.drawDoubts(context);
    for (const [id, grasp] of model.grasps) this.drawGrasp(context, this.owner.previews.get(id) ?? grasp, selection.has(`grasps:${id}`));
  }

  drawCorners(context, model) {
    context.fillStyle = COLOURS.corner;
    const size = Math.min(3, Math.max(1.6, 1.2 * this.scale));
    context.beginPath();
    for (const corner of model.corners.get(this.name) ?? []) {
      const [x, y] = this.toScreen(corner);
      context.rect(x - size / 2, y - size / 2, size, size);
    }
    context.fill();
  }

  // A ring around the click that is probably wrong, dashed where it is one of several; and the edges
  // of the suggestion under the mouse.
  drawDoubts(context) {
    const { model, judgement, pointedAt } = this.owner;
    context.strokeStyle = COLOURS.bad; context.lineWidth = 2;
    for (const { suspects } of judgement.disagreements) {
      context.setLineDash(suspects.length > 1 ? [3, 3] : []);
      for (const [point, view] of suspects) {
        const clicked = view === this.name && model.points.get(point)?.clicks[view];
        if (!clicked) continue;
        context.beginPath(); context.arc(...this.toScreen(clicked), 11, 0, 2 * Math.PI); context.stroke();
      }
    }
    context.setLineDash([]);
    context.strokeStyle = COLOURS.active; context.lineWidth = 3;
    for (const ends of pointedAt) {
      const pixels = ends.map((id) => model.pixel(id, this.index));
      if (pixels.every(Boolean)) { this.path(context, pixels.flat()); context.stroke(); }
    }
  }

  drawOffer(context, { points, edges }) {
    const pixels = new Map(points.map((point) => [point.number, point.in[this.index]]));
    context.strokeStyle = COLOURS.offered; context.lineWidth = 1.2; context.setLineDash([3, 3]);
    for (const [a, b] of edges) {
      if (!pixels.get(a) || !pixels.get(b)) continue;
      this.path(context, [...pixels.get(a), ...pixels.get(b)]); context.stroke();
    }
    context.setLineDash([]);
    points.forEach((point, k) => {
      const pixel = point.in[this.index];
      if (!pixel) return;
      const [x, y] = this.toScreen(pixel), size = k ? 4 : 7;
      context.lineWidth = k ? 1.3 : 2.2;
      context.beginPath();
      context.moveTo(x, y - size); context.lineTo(x + size, y); context.lineTo(x, y + size); context.lineTo(x - size, y); context.closePath();
      context.stroke();
    });
  }

  drawFaces(context, model, selection) {
    const eye = model.views[this.index].world_from_camera.map((row) => row[3]);
    for (const [id, face] of model.faces) {
      const corners = face.loop.map((point) => model.pixel(point, this.index));
      if (face.problem || corners.some((corner) => !corner)) continue;
      // Faces that are turned away are behind others; filling them would hide what is seen.
      const towards = face.normal[0] * (eye[0] - face.centre[0]) + face.normal[1] * (eye[1] - face.centre[1]) + face.normal[2] * (eye[2] - face.centre[2]);
      if (towards <= 0) continue;
      this.path(context, corners.flat());
      context.closePath();
      context.fillStyle = selection.has(`faces:${id}`) ? "rgba(255,178,36,.28)" : face.graspable === true ? COLOURS.graspable : face.graspable === false ? COLOURS.refused : COLOURS.face;
      context.fill();
    }
  }

  drawEdges(context, model, selection) {
    context.lineWidth = 1.6; context.strokeStyle = COLOURS.edge;
    context.beginPath();
    const others = [];
    for (const [id, edge] of model.edges) {
      if (edge.problem || this.owner.doubts.has(`edges:${id}`) || selection.has(`edges:${id}`)) others.push([id, edge]);
      else if (edge.in[this.index]) this.trace(context, edge.in[this.index]);
    }
    context.stroke();
    for (const [id, edge] of others) {
      const ends = edge.ends.map((end) => model.pixel(end, this.index));
      const line = edge.in?.[this.index] ?? (ends.every(Boolean) ? ends.flat() : null);
      if (!line) continue;
      context.strokeStyle = selection.has(`edges:${id}`) ? COLOURS.active : COLOURS.bad;
      context.setLineDash(edge.problem ? [4, 4] : []);
      this.path(context, line); context.stroke();
    }
    context.setLineDash([]);
  }

  // Ellipses of three standard deviations, a cross where the point was clicked, the residual, and
  // the number of the point where there is room for it.
  drawPoints(context, points, colour, width) {
    context.strokeStyle = context.fillStyle = colour;
    context.lineWidth = width;
    context.beginPath();
    for (const [, point] of points) {
      const seen = point.in?.[this.index], clicked = point.clicks[this.name];
      if (seen) {
        const [x, y] = this.toScreen(seen);
        const [long, short] = [seen[2], seen[3]].map((sigma) => Math.max(ELLIPSE_SIGMAS * sigma * this.scale, 1.5));
        context.moveTo(x + long * Math.cos(seen[4]), y + long * Math.sin(seen[4]));
        context.ellipse(x, y, long, short, seen[4], 0, 2 * Math.PI);
      }
      if (clicked) {
        const [x, y] = this.toScreen(clicked);
        context.moveTo(x - 5, y); context.lineTo(x + 5, y); context.moveTo(x, y - 5); context.lineTo(x, y + 5);
      }
    }
    context.stroke();
    this.drawResiduals(context, points);
    const chosen = width > 1.5 || this.owner.model.points.size <= FEW_POINTS || this.scale > 3 * this.smallest;
    if (!chosen) return;
    context.font = "10.5px ui-monospace, 'DejaVu Sans Mono', monospace";
    context.lineWidth = 3; context.strokeStyle = "rgba(8,9,12,.75)";
    for (const [id, point] of points) {
      const at = point.clicks[this.name] ?? point.in?.[this.index];
      if (!at) continue;
      const [x, y] = this.toScreen(at);
      context.strokeText(id, x + 7, y - 6); context.fillText(id, x + 7, y - 6);
    }
  }

  // From where a point is predicted to where it was clicked, ten times as long as it is.
  drawResiduals(context, points) {
    const paths = { "#ffffff": [], [COLOURS.bad]: [] };
    for (const [, point] of points) {
      const seen = point.in?.[this.index], clicked = point.clicks[this.name];
      if (!seen || !clicked) continue;
      const [du, dv] = [clicked[0] - seen[0], clicked[1] - seen[1]], [x, y] = this.toScreen(seen);
      const [dx, dy] = [10 * du * this.scale, 10 * dv * this.scale];
      if (Math.hypot(dx, dy) >= 2) paths[point.wrong ? COLOURS.bad : "#ffffff"].push([x, y, x + dx, y + dy]);
    }
    context.lineWidth = 1.4;
    for (const [colour, lines] of Object.entries(paths)) {
      context.strokeStyle = colour;
      context.beginPath();
      for (const [x, y, x2, y2] of lines) { context.moveTo(x, y); context.lineTo(x2, y2); }
      context.stroke();
    }
  }

  drawGrasp(context, grasp, selected) {
    if (!grasp.in) return;
    context.strokeStyle = COLOURS.active; context.lineCap = "round";
    grasp.in.forEach((polylines, k) => {
      const line = polylines[this.index];
      if (!line) return;
      context.lineWidth = k === 3 ? 1.5 : selected ? 4.5 : 3.2;
      context.setLineDash(k === 3 ? [5, 4] : []);
      this.path(context, line);
      context.stroke();
    });
    context.setLineDash([]); context.lineCap = "butt";
  }

  drawLive() {
    const context = this.context(2), { curves, chain, model, tool } = this.owner;
    this.hint.textContent = "";
    const pieces = curves && curves.view !== this.name ? curves.curves[this.name] : null;
    if (pieces) {
      context.strokeStyle = COLOURS.curve; context.lineWidth = 1.5;
      for (const { pixels } of pieces) { this.path(context, pixels); context.stroke(); }
      const nearest = this.cursor && nearestOnCurve(pieces, this.toPixel(this.cursor));
      if (nearest && nearest.distance * this.scale < 40) {
        const [x, y] = this.toScreen(nearest.pixel);
        context.beginPath(); context.arc(x, y, 4, 0, 2 * Math.PI); context.fillStyle = COLOURS.curve; context.fill();
        this.hint.textContent = isFinite(nearest.mm) ? `depth ${nearest.mm.toFixed(1)} mm` : "depth infinite";
      }
    }
    if (curves && curves.view === this.name) {
      const [x, y] = this.toScreen(curves.pixel);
      context.strokeStyle = COLOURS.curve; context.lineWidth = 1.5;
      context.beginPath(); context.arc(x, y, 6, 0, 2 * Math.PI); context.stroke();
    }
    const rectangle = this.owner.rectangles.get(this.name);
    if (rectangle) this.drawRectangle(context, rectangle, tool === "region");
    if (chain.length) {
      const corners = chain.map((id) => model.pixel(id, this.index)).filter(Boolean).flat();
      if (this.cursor) corners.push(...this.toPixel(this.cursor));
      context.strokeStyle = COLOURS.active; context.lineWidth = 1.5; context.setLineDash([5, 4]);
      this.path(context, corners); context.stroke(); context.setLineDash([]);
    }
    if (this.cursor && (tool === "point" || tool === "edge" || tool === "face")) {
      const target = this.target(this.cursor, false);
      if (target.snapped) {
        const [x, y] = this.toScreen(target.pixel);
        context.strokeStyle = target.point === null ? "#ffffff" : COLOURS.active; context.lineWidth = 1.5;
        context.strokeRect(x - 6, y - 6, 12, 12);
      } else if (tool === "point" && this.cursorSigma > 2 * model.clickSigma && !this.hint.textContent) {
        this.hint.textContent = `a click here: ± ${this.cursorSigma.toFixed(1)} px; zoom in`;
      }
    }
  }

  // The region of proposals: what is outside is dimmed while it is being chosen.
  drawRectangle(context, [left, top, right, bottom], chosen) {
    const [x, y] = this.toScreen([left, top]), [x2, y2] = this.toScreen([right, bottom]);
    if (chosen) {
      const box = this.element.getBoundingClientRect();
      context.fillStyle = "rgba(8,9,12,.45)";
      context.beginPath(); context.rect(0, 0, box.width, box.height); context.rect(x, y, x2 - x, y2 - y); context.fill("evenodd");
    }
    context.strokeStyle = COLOURS.offered; context.lineWidth = 1.5; context.setLineDash([6, 4]);
    context.strokeRect(x, y, x2 - x, y2 - y);
    context.setLineDash([]);
  }

  path(context, pixels) {
    context.beginPath();
    this.trace(context, pixels);
  }

  trace(context, pixels) {
    for (let k = 0; k < pixels.length; k += 2) {
      const [x, y] = this.toScreen([pixels[k], pixels[k + 1]]);
      if (k) context.lineTo(x, y); else context.moveTo(x, y);
    }
  }

  // Standard deviation of the cursor, px of the picture: a screen's pixel is many of a picture's.
  get cursorSigma() { return (CURSOR_SIGMA[this.pointer] ?? CURSOR_SIGMA.mouse) / this.scale; }

  // What a click at a place of the screen means: a point that is there, a candidate, or the place.
  target(place, free) {
    const pixel = this.toPixel(place), { model, tool, active } = this.owner, measures = tool === "point";
    const point = measures ? model.pointMeant(this.index, pixel, this.cursorSigma) : model.pointAt(this.index, pixel, GRAB / this.scale);
    // Where the active point is only predicted, its place is what the click is to tell.
    const predicted = measures && point === active && !model.points.get(point)?.clicks[this.name];
    if (point !== null && !predicted) return { point, pixel: model.pixel(point, this.index), snapped: true };
    const corner = free || !measures ? null : model.cornerMeant(this.index, pixel, this.cursorSigma);
    return corner ? { point: null, pixel: corner, snapped: true } : { point: null, pixel, snapped: false };
  }

  listen() {
    const place = (event) => {
      const box = this.element.getBoundingClientRect();
      return [event.clientX - box.left, event.clientY - box.top];
    };
    this.element.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoom(place(event), Math.exp(-event.deltaY * (event.deltaMode ? 0.05 : 0.0016)));
    }, { passive: false });
    this.element.addEventListener("pointerdown", (event) => {
      this.element.setPointerCapture(event.pointerId);
      this.pointer = event.pointerType;
      const at = place(event), pan = event.button === 1 || event.button === 2 || (event.button === 0 && this.owner.space);
      this.drag = { from: at, offset: [...this.offset], pan, moved: false, free: event.altKey };
      if (!pan && event.button === 0) this.owner.press(this, this.target(at, event.altKey), this.drag);
    });
    this.element.addEventListener("pointermove", (event) => {
      this.cursor = place(event); this.pointer = event.pointerType;
      const drag = this.drag;
      if (drag) {
        const [dx, dy] = [this.cursor[0] - drag.from[0], this.cursor[1] - drag.from[1]];
        drag.moved ||= Math.hypot(dx, dy) > 4;
        if (drag.pan && drag.moved) {
          this.offset = [drag.offset[0] + dx, drag.offset[1] + dy];
          this.redraw("picture", "model", "live");
          return;
        }
        if (drag.moved) this.owner.dragged(this, this.toPixel(this.cursor), drag);
      } else this.owner.hovered(this, this.target(this.cursor, event.altKey));
      this.redraw("live");
    });
    this.element.addEventListener("pointerup", (event) => {
      const drag = this.drag;
      this.drag = null;
      if (drag && !drag.pan && event.button === 0) this.owner.released(this, this.target(place(event), drag.free), drag, event);
    });
    this.element.addEventListener("pointercancel", () => { this.drag = null; });
    this.element.addEventListener("pointerleave", () => { this.cursor = null; this.owner.left(this); this.redraw("live"); });
    this.element.addEventListener("dblclick", () => this.owner.enlarge(this));
    this.element.addEventListener("contextmenu", (event) => event.preventDefault());
  }

  zoom(place, factor) {
    const scale = Math.min(MAX_SCALE, Math.max(this.smallest * 0.8, this.scale * factor));
    this.offset = place.map((x, k) => x - ((x - this.offset[k]) / this.scale) * scale);
    this.scale = scale;
    this.redraw("picture", "model", "live");
  }
}
