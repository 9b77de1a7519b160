// Where the pictures and the view of space are: the pictures keep their aspect, so that nothing of
// them is cut off and nothing beside them is empty; space has the rest.

const SPACE = 150;  // px: least width (or height) of the view of space
const GAP = 2;      // px between views

// The rectangles [left, top, width, height] of so many pictures, and of space: in columns, or in
// rows, whichever gives the pictures more of the screen.
export function layOut(count, aspect, width, height) {
  let best = null;
  for (const columns of [true, false]) {
    const [along, across, ratio] = columns ? [height, width, aspect] : [width, height, 1 / aspect];
    for (let lines = 1; lines <= count; lines++) {
      // Pictures of one line have one size; the lines have as many pictures as each other, or one less.
      const sizes = Array.from({ length: lines }, (_, k) => Math.floor((count + lines - 1 - k) / lines));
      const total = sizes.reduce((sum, size) => sum + (along * ratio) / size, 0);
      const scale = Math.min(1, (across - Math.min(SPACE, across / 4)) / total);
      // The area of the pictures, less what stays empty where they are made smaller to leave room.
      const gain = total * along * scale * (2 * scale - 1);
      if (!best || gain > best.gain) best = { gain, columns, sizes, scale, along, across, ratio, total };
    }
  }
  const pictures = [];
  let start = 0;
  for (const size of best.sizes) {
    const length = (best.scale * best.along) / size, thickness = length * best.ratio;
    for (let k = 0; k < size; k++) pictures.push(place(best.columns, start, k * length, thickness, length));
    start += thickness;
  }
  return { pictures, space: place(best.columns, start, 0, best.across - start, best.along) };
}

function place(columns, across, along, thickness, length) {
  return columns ? [across, along, thickness - GAP, length - GAP] : [along, across, length - GAP, thickness - GAP];
}
