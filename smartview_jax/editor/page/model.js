// What the page knows of the session: entries by kind and id, as the server's answers bring them.

// Distance, in standard deviations, beyond which a right click of two coordinates is once in a hundred.
const REACH = Math.sqrt(9.21);

export class Model {
  constructor() {
    this.points = new Map(); this.edges = new Map(); this.faces = new Map();
    this.grasps = new Map(); this.constraints = new Map();
    this.views = []; this.status = {};
    this.corners = new Map();
  }
  greet(message) {
    for (const kind of KINDS) this[kind].clear();
    Object.assign(this, { views: message.views, facts: message.facts, file: message.file, clickSigma: message.click_sigma });
    this.update(message);
  }
  update(message) {
    for (const kind of KINDS) {
      for (const [id, entry] of Object.entries(message.parts?.[kind] ?? {})) {
        if (entry === null) this[kind].delete(+id); else this[kind].set(+id, entry);
      }
    }
    for (const key of ["can_undo", "can_redo", "saved", "kept", "name"]) {
      if (key in message) this.status[key] = message[key];
    }
  }
  viewIndex(name) { return this.views.findIndex((view) => view.name === name); }
  // Where a point is drawn in a view: where it was clicked, else where it is predicted.
  pixel(id, view) {
    const entry = this.points.get(id);
    if (!entry) return null;
    const clicked = entry.clicks[this.views[view].name];
    if (clicked) return clicked;
    const seen = entry.in?.[view];
    return seen ? [seen[0], seen[1]] : null;
  }
  // The point whose mark is nearest to a pixel, within a radius in px of the picture.
  pointAt(view, pixel, radius) {
    let best = null, least = radius;
    for (const id of this.points.keys()) {
      const p = this.pixel(id, view);
      if (!p) continue;
      const distance = Math.hypot(p[0] - pixel[0], p[1] - pixel[1]);
      if (distance <= least) { least = distance; best = id; }
    }
    return best;
  }
  // The point that was clicked, or is predicted, where a cursor of this deviation (px of the
  // picture) may mean it.
  pointMeant(view, pixel, sigma) {
    const deviation = (id) => (this.points.get(id).clicks[this.views[view].name] ? Math.hypot(sigma, this.clickSigma) : sigma);
    const nearest = this.pointAt(view, pixel, REACH * Math.hypot(sigma, this.clickSigma));
    if (nearest === null) return null;
    const [u, v] = this.pixel(nearest, view);
    return Math.hypot(u - pixel[0], v - pixel[1]) <= REACH * deviation(nearest) ? nearest : null;
  }
  // The corner that a click of this deviation may mean: both are uncertain, the cursor and the corner.
  cornerMeant(view, pixel, sigma) {
    let best = null, least = REACH * REACH;
    for (const [u, v, uu, uv, vv] of this.corners.get(this.views[view].name) ?? []) {
      const [du, dv] = [u - pixel[0], v - pixel[1]], [a, c] = [uu + sigma * sigma, vv + sigma * sigma];
      const square = (c * du * du - 2 * uv * du * dv + a * dv * dv) / (a * c - uv * uv);
      if (square <= least) { least = square; best = [u, v]; }
    }
    return best;
  }
}

const KINDS = ["points", "edges", "faces", "grasps", "constraints"];

// The nearest place on a curve to a pixel: {pixel, mm, distance}, or null for an empty curve.
export function nearestOnCurve(pieces, pixel) {
  let best = null;
  for (const { pixels, mm } of pieces) {
    for (let k = 0; k + 3 < pixels.length; k += 2) {
      const [ax, ay, bx, by] = [pixels[k], pixels[k + 1], pixels[k + 2], pixels[k + 3]];
      const [dx, dy] = [bx - ax, by - ay];
      const length = Math.max(dx * dx + dy * dy, 1e-12);
      const t = Math.min(1, Math.max(0, ((pixel[0] - ax) * dx + (pixel[1] - ay) * dy) / length));
      const x = ax + t * dx, y = ay + t * dy;
      const distance = Math.hypot(pixel[0] - x, pixel[1] - y);
      if (!best || distance < best.distance) {
        // Depth is linear along a segment in its inverse; -1 stands for an infinite depth.
        const [i, j] = [mm[k / 2] < 0 ? 0 : 1 / mm[k / 2], mm[k / 2 + 1] < 0 ? 0 : 1 / mm[k / 2 + 1]];
        const inverse = (1 - t) * i + t * j;
        best = { pixel: [x, y], distance, mm: inverse > 0 ? 1 / inverse : Infinity };
      }
    }
  }
  return best;
}
