// A worker that lists the Gaussians of a view from back to front.

import { POSE_FLOATS } from "./motion.js";

const MAX_AGE = 2.8; // durations from its center time at which a Gaussian is alive
const BUCKETS = 65536;

let groups = [];
let nearest = 0; // z-depth, scene units: nothing nearer is drawn
let total = 0;

onmessage = ({ data }) => {
  if (data.groups) {
    ({ groups, nearest } = data);
    total = groups.reduce((sum, group) => sum + group.count, 0);
    return;
  }
  const start = performance.now();
  const order = backToFront(data.time, data.poses, data.row);
  const milliseconds = performance.now() - start;
  postMessage({ id: data.id, order, milliseconds }, [order.buffer]);
};

/**
 * Indices of all Gaussians before the camera, farthest first. `row` is the third row of
 * world to camera: z = row . (x, y, z, 1). Ties are drawn in descending order.
 */
function backToFront(time, poses, row) {
  const depths = new Float32Array(total);
  let first = 0;
  for (const group of groups) {
    fillDepths(group, time, poses, row, depths.subarray(first, first + group.count));
    first += group.count;
  }
  // positive floats sort like their bits: two passes of 16 bits, stable
  const bits = new Uint32Array(depths.buffer);
  let visible = new Uint32Array(total);
  let count = 0;
  for (let i = total - 1; i >= 0; i--) {
    if (depths[i] > nearest) visible[count++] = i;
  }
  visible = visible.subarray(0, count);
  return sortPass(sortPass(visible, bits, 0), bits, 16);
}

/** z-depths of a group; 0 for Gaussians whose window is closed at that time. */
function fillDepths(group, time, poses, row, depths) {
  const { means, mixture, velocities, centers, logDurations } = group;
  const [rx, ry, rz, rw] = row;
  if (mixture) {
    fillMixedDepths(group, poses, row, depths);
    return;
  }
  for (let i = 0, k = 0; i < group.count; i++, k += 3) {
    depths[i] = rx * means[k] + ry * means[k + 1] + rz * means[k + 2] + rw;
    if (!velocities) continue;
    const since = time - centers[i];
    const share = since / Math.exp(logDurations[i]);
    const speed = rx * velocities[k] + ry * velocities[k + 1] + rz * velocities[k + 2];
    depths[i] = Math.abs(share) > MAX_AGE ? 0 : depths[i] + speed * since;
  }
}

/** z-depths of Gaussians that mix motion bases. A basis moves a point to depth linearly. */
function fillMixedDepths({ means, mixture, count }, poses, [rx, ry, rz, rw], depths) {
  const bases = mixture.length / count;
  const rows = [];
  for (let b = 0; b < bases; b++) {
    const p = poses.subarray(b * POSE_FLOATS, (b + 1) * POSE_FLOATS);
    for (let c = 0; c < 4; c++) {
      rows.push(rx * p[c] + ry * p[4 + c] + rz * p[8 + c] + (c === 3 ? rw : 0));
    }
  }
  for (let i = 0; i < count; i++) {
    const x = means[3 * i],
      y = means[3 * i + 1],
      z = means[3 * i + 2];
    let depth = 0;
    for (let b = 0, r = 0; b < bases; b++, r += 4) {
      depth +=
        mixture[i * bases + b] * (rows[r] * x + rows[r + 1] * y + rows[r + 2] * z + rows[r + 3]);
    }
    depths[i] = depth;
  }
}

/** `indices` by 16 of their bits from `shift` on, descending; equal ones keep their order. */
function sortPass(indices, bits, shift) {
  const starts = new Uint32Array(BUCKETS + 1);
  for (const i of indices) starts[BUCKETS - 1 - ((bits[i] >>> shift) & 0xffff) + 1]++;
  for (let k = 0; k < BUCKETS; k++) starts[k + 1] += starts[k];
  const sorted = new Uint32Array(indices.length);
  for (const i of indices) sorted[starts[BUCKETS - 1 - ((bits[i] >>> shift) & 0xffff)]++] = i;
  return sorted;
}
