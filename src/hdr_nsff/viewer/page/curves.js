// The curves that develop radiance. Their formulas are in develop.frag, in this order.

export const EXTENDED = "extended"; // light above white, on screens that have it
export const CURVES = [
  { id: "camera", label: "Camera (learned)" },
  { id: "agx", label: "AgX" },
  { id: "neutral", label: "Khronos PBR Neutral" },
  { id: "reinhard", label: "Reinhard" },
  { id: "clip", label: "sRGB, clipped" },
  { id: EXTENDED, label: "HDR screen" },
];
const SIZE = 1024; // entries, as in develop.frag
const GAMMA = 2.2;

/** A learned response evenly in x^(1/2.2) up to its last x: RGBA, four numbers an entry. */
export function curveTable({ x, y }) {
  const table = new Float32Array(4 * SIZE);
  const end = x[x.length - 1];
  let right = 1;
  for (let i = 0; i < SIZE; i++) {
    const exposed = end * (i / (SIZE - 1)) ** GAMMA;
    while (right < x.length - 1 && x[right] < exposed) right++;
    const share = Math.min(Math.max((exposed - x[right - 1]) / (x[right] - x[right - 1]), 0), 1);
    for (let c = 0; c < 3; c++)
      table[4 * i + c] = y[c][right - 1] + share * (y[c][right] - y[c][right - 1]);
  }
  return table;
}
