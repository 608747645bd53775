// Cameras: as filmed, fixed, orbit, fly. OpenCV axes; poses are rows of 3 x 4 numbers.

export const MODES = ["filmed", "fixed", "orbit", "fly"];

/** The views of the camera that the page follows: the first one of several. */
export function followed(views) {
  return views.filter((view) => view.camera_id === views[0].camera_id);
}

/** The filmed camera at a time: { c2w, K } between its two neighbors. */
export function filmedCamera(views, time) {
  const own = followed(views);
  let after = own.findIndex((view) => view.time >= time);
  if (after < 0) after = own.length - 1;
  const before = Math.max(after - 1, 0);
  const a = own[before],
    b = own[after];
  const share = b.time > a.time ? Math.min(Math.max((time - a.time) / (b.time - a.time), 0), 1) : 1;
  return interpolate(a, b, share);
}

/** The camera a share of the way from `a` to `b`. */
export function interpolate(a, b, share) {
  const q = slerp(quaternionOf(a.c2w), quaternionOf(b.c2w), share);
  const center = a.c2w.map((row, i) => row[3] + share * (b.c2w[i][3] - row[3]));
  const K = a.K.map((row, i) => row.map((value, k) => value + share * (b.K[i][k] - value)));
  return { c2w: poseOf(matrixOf(q), center), K };
}

/** A pose turned about `pivot` by yaw about the axis `down`, then pitch about its right. */
export function orbit(c2w, pivot, down, yaw, pitch) {
  const right = c2w.map((row) => row[0]);
  const turn = multiply(axisAngle(down, yaw), axisAngle(right, pitch));
  const arm = c2w.map((row, i) => row[3] - pivot[i]);
  const center = apply(turn, arm).map((value, i) => value + pivot[i]);
  return poseOf(
    multiply(
      turn,
      c2w.map((row) => row.slice(0, 3)),
    ),
    center,
  );
}

/** A pose moved along its own axes: right, down, forward in scene units. */
export function moved(c2w, offset) {
  return c2w.map((row) => [
    row[0],
    row[1],
    row[2],
    row[3] + row[0] * offset[0] + row[1] * offset[1] + row[2] * offset[2],
  ]);
}

/** The point `depth` in front of a pose. */
export function pointAhead(c2w, depth) {
  return c2w.map((row) => row[3] + depth * row[2]);
}

/** The mean down axis of filmed views, of length 1. */
export function meanDown(views) {
  const sum = [0, 1, 2].map((i) => views.reduce((total, view) => total + view.c2w[i][1], 0));
  const length = Math.hypot(...sum) || 1;
  return sum.map((value) => value / length);
}

/** K for a picture of another size. */
export function scaleK(K, scale) {
  return [K[0].map((value) => value * scale), K[1].map((value) => value * scale), [0, 0, 1]];
}

function poseOf(rotation, center) {
  return rotation.map((row, i) => [...row, center[i]]);
}

function apply(matrix, vector) {
  return matrix.map((row) => row[0] * vector[0] + row[1] * vector[1] + row[2] * vector[2]);
}

function multiply(a, b) {
  return a.map((row) =>
    [0, 1, 2].map((k) => row[0] * b[0][k] + row[1] * b[1][k] + row[2] * b[2][k]),
  );
}

function axisAngle([x, y, z], angle) {
  const s = Math.sin(angle / 2);
  return matrixOf([Math.cos(angle / 2), s * x, s * y, s * z]);
}

function matrixOf([w, x, y, z]) {
  return [
    [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
    [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
    [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
  ];
}

/** The unit quaternion w x y z of a pose's rotation (Shepperd 1978). */
function quaternionOf(m) {
  const trace = m[0][0] + m[1][1] + m[2][2];
  const diagonal = [trace, m[0][0], m[1][1], m[2][2]];
  const largest = diagonal.indexOf(Math.max(...diagonal));
  if (largest === 0) {
    const w = Math.sqrt(1 + trace) / 2;
    return [
      w,
      (m[2][1] - m[1][2]) / (4 * w),
      (m[0][2] - m[2][0]) / (4 * w),
      (m[1][0] - m[0][1]) / (4 * w),
    ];
  }
  const i = largest - 1,
    j = (i + 1) % 3,
    k = (i + 2) % 3;
  const q = [0, 0, 0, 0];
  const length = Math.sqrt(1 + m[i][i] - m[j][j] - m[k][k]) / 2;
  q[0] = (m[k][j] - m[j][k]) / (4 * length);
  q[1 + i] = length;
  q[1 + j] = (m[j][i] + m[i][j]) / (4 * length);
  q[1 + k] = (m[k][i] + m[i][k]) / (4 * length);
  return q;
}

/** Between unit quaternions along the shortest arc. */
function slerp(a, b, share) {
  let cosine = a.reduce((sum, value, i) => sum + value * b[i], 0);
  const end = cosine < 0 ? b.map((value) => -value) : b;
  cosine = Math.min(Math.abs(cosine), 1);
  const angle = Math.acos(cosine);
  if (angle < 1e-6) return a;
  const [from, to] = [Math.sin((1 - share) * angle), Math.sin(share * angle)].map(
    (value) => value / Math.sin(angle),
  );
  return a.map((value, i) => from * value + to * end[i]);
}
