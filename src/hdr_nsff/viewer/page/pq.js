// The signal of HDR pictures: PQ of BT.2100, as `maths/hdr_signal.py` has it.

export const PQ_TAGS = [9, 16, 0, 1]; // PNG's chunk cICP: BT.2020, PQ, rgb, full range
const WHITE_NITS = 203; // diffuse white (BT.2408)
const TO_REC2020 = [
  [0.6274039, 0.3292830, 0.0433131],
  [0.0690973, 0.9195404, 0.0113623],
  [0.0163914, 0.0880133, 0.8955953],
];

/** sRGB that continues beyond white, four numbers a pixel, as PQ in BT.2020; in place. */
export function encodePq(values) {
  for (let i = 0; i < values.length; i += 4) {
    const rgb = [0, 1, 2].map((c) => WHITE_NITS * toLinear(values[i + c]));
    TO_REC2020.forEach(([r, g, b], c) => {
      values[i + c] = pq(r * rgb[0] + g * rgb[1] + b * rgb[2]);
    });
  }
  return values;
}

function toLinear(value) {
  return value <= 0.04045 ? value / 12.92 : ((value + 0.055) / 1.055) ** 2.4;
}

/** The signal in [0, 1] of light in nits (SMPTE ST 2084). */
function pq(nits) {
  const power = Math.min(Math.max(nits / 10000, 0), 1) ** (2610 / 16384);
  const ratio = (3424 / 4096 + (2413 / 128) * power) / (1 + (2392 / 128) * power);
  return ratio ** (2523 / 32);
}
