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
 * Weights of the rows low - 1 ... low + 2 of a cubic through K values at a position in
 * [0, K - 1] (Catmull and Rom 1974). Both ends are extended in a straight line.
 */
export function catmullRom(count, position) {
  if (count === 1) return [[0, 1]];
  const last = count - 1;
  const low = Math.min(Math.max(Math.floor(position), 0), last - 1);
  const u = position - low;
  let before = 0.5 * u * (u * (2 - u) - 1);
  let start = 1 + 0.5 * u * u * (3 * u - 5);
  let end = 0.5 * u * (u * (4 - 3 * u) + 1);
  let after = 0.5 * u * u * (u - 1);
  if (low === 0) {
    start += 2 * before;
    end -= before;
    before = 0;
  }
  if (low + 2 > last) {
    start -= after;
    end += 2 * after;
    after = 0;
  }
  const rows = [
    [low - 1, before],
    [low, start],
    [low + 1, end],
    [low + 2, after],
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
 * The motion of every basis at a knot, POSE_FLOATS numbers each: a point x goes to
 * R (x - c) + c + s, as the rows of a 3 x 4 matrix; then the unit quaternion of R.
 */
export function posesAt(bases, numTimes, knot) {
  const poses = new Float32Array(Math.max(bases?.count ?? 0, 1) * POSE_FLOATS);
  if (!bases) return poses;
  const rows = catmullRom(numTimes, knot);
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
