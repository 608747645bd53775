// Where Gaussians are at a time. The vertex shader evaluates the same functions.

export const POSE_FLOATS = 16; // of a basis: three rows of a 3 x 4 matrix, and a quaternion
const MIN_LENGTH = 1e-12;

/** Position of a time (in frames) on the rising list of training times, clamped to it. */
export function knotOf(times, time) {
  const last = times.length - 1;
  if (last === 0 || time <= times[0]) return 0;
  if (time >= times[last]) return last;
  let after = 1;
  while (times[after] < time) after++;
  return after - 1 + (time - times[after - 1]) / (times[after] - times[after - 1]);
}

/**
 * Weights of the rows low - 1 ... low + 2 of a cubic through values at the rising times,
 * at a position in [0, K - 1]. Its velocity at a time is that of the parabola through
 * the value and the two beside it; at both ends, that of the line to the neighbor.
 */
export function cubic(times, position) {
  const last = times.length - 1;
  if (last === 0) return [[0, 1]];
  const low = Math.min(Math.max(Math.floor(position), 0), last - 1);
  const u = position - low;
  const gap = times[low + 1] - times[low];
  // this gap over those before and after, which are endless at the ends
  const before = low > 0 ? gap / (times[low] - times[low - 1]) : 0;
  const after = low + 1 < last ? gap / (times[low + 2] - times[low + 1]) : 0;
  // of the velocities at both times, then of the steps from row to row
  const start = u * (1 - u) * (1 - u);
  const end = -u * u * (1 - u);
  const stepBefore = (start * before * before) / (1 + before);
  const step = u * u * (3 - 2 * u) + start / (1 + before) + end / (1 + after);
  const stepAfter = (end * after * after) / (1 + after);
  const rows = [
    [low - 1, -stepBefore],
    [low, 1 + stepBefore - step],
    [low + 1, step - stepAfter],
    [low + 2, stepAfter],
  ];
  return rows.filter(([row]) => row >= 0 && row <= last);
}

/** The rotation matrix, row by row, of a unit quaternion w x y z. */
export function rotationMatrix([w, x, y, z]) {
  return [
    1 - 2 * (y * y + z * z),
    2 * (x * y - w * z),
    2 * (x * z + w * y),
    2 * (x * y + w * z),
    1 - 2 * (x * x + z * z),
    2 * (y * z - w * x),
    2 * (x * z - w * y),
    2 * (y * z + w * x),
    1 - 2 * (x * x + y * y),
  ];
}

/**
 * The motion of every basis at a knot of the times, POSE_FLOATS numbers each: a point x goes to
 * R (x - c) + c + s, as the rows of a 3 x 4 matrix; then the unit quaternion of R.
 */
export function posesAt(bases, times, knot) {
  const poses = new Float32Array(Math.max(bases?.count ?? 0, 1) * POSE_FLOATS);
  if (!bases) return poses;
  const rows = cubic(times, knot);
  for (let b = 0; b < bases.count; b++) {
    const turn = [0, 0, 0, 0];
    const shift = [0, 0, 0];
    for (const [row, weight] of rows) {
      const place = row * bases.count + b;
      for (let i = 0; i < 4; i++) turn[i] += weight * bases.quaternions[4 * place + i];
      for (let i = 0; i < 3; i++) shift[i] += weight * bases.shifts[3 * place + i];
    }
    const length = Math.hypot(...turn) + MIN_LENGTH;
    const unit = turn.map((value) => value / length);
    const r = rotationMatrix(unit);
    const center = bases.centers.subarray(3 * b, 3 * b + 3);
    for (let i = 0; i < 3; i++) {
      const [rx, ry, rz] = r.slice(3 * i, 3 * i + 3);
      const turned = rx * center[0] + ry * center[1] + rz * center[2];
      poses.set([rx, ry, rz, center[i] + shift[i] - turned], b * POSE_FLOATS + 4 * i);
    }
    poses.set(unit, b * POSE_FLOATS + 12);
  }
  return poses;
}
