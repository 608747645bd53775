// The scene as textures, which the vertex shader reads.

const TABLE_WIDTH = 2048; // texels in a row of every table, as in splat.vert
const MAX_GROUPS = 4; // as in splat.vert

/** Everything that the vertex shader reads of the scene, as textures. */
export function makeTables(gl, scene) {
  const { groups } = scene;
  if (groups.length > MAX_GROUPS)
    throw new Error(`This scene has more than ${MAX_GROUPS} groups of Gaussians.`);
  const total = groups.reduce((sum, group) => sum + group.count, 0);
  const rows = Math.max(Math.ceil(total / TABLE_WIDTH), 1);
  const layers = new Float32Array(5 * 4 * TABLE_WIDTH * rows);
  const layer = (k) => layers.subarray(k * 4 * TABLE_WIDTH * rows);
  const colors = [],
    opacities = [],
    weights = [],
    directions = [];
  const viewDependent = groups.some((group) => group.sh1);
  const places = [];
  let first = 0,
    firstColor = 0,
    firstOpacity = 0,
    firstWeight = 0;
  groups.forEach((group, k) => {
    const { count } = group;
    const at = 4 * first;
    interleave(layer(0).subarray(at), 4, [
      [group.means.data, 3],
      [group.opacity_logits.data, 1],
    ]);
    interleave(layer(1).subarray(at), 4, [[group.quaternions.data, 4]]);
    interleave(layer(2).subarray(at), 4, [
      [group.log_scales.data, 3],
      [new Float32Array(count).fill(k), 1],
    ]);
    const centers = group.centers?.data ?? new Float32Array(count);
    interleave(layer(3).subarray(at), 4, [
      [group.log_radiance.data, 3],
      [centers, 1],
    ]);
    if (group.velocities) {
      interleave(layer(4).subarray(at), 4, [
        [group.velocities.data, 3],
        [group.log_durations.data, 1],
      ]);
    }
    const colorKnots = group.color_offsets?.shape[0] ?? 0;
    const opacityKnots = group.opacity_offsets?.shape[0] ?? 0;
    if (colorKnots) colors.push(asColors(group.color_offsets));
    if (opacityKnots) opacities.push(group.opacity_offsets.data);
    if (group.mixture) weights.push(group.mixture.data);
    if (viewDependent) directions.push(asTriples(group.sh1?.data ?? new Float32Array(9 * count)));
    places.push({
      place: [first, count, group.mixture ? firstWeight : -1, group.velocities ? 1 : 0],
      knots: [firstColor, colorKnots, firstOpacity, opacityKnots],
    });
    first += count;
    firstColor += colorKnots * count;
    firstOpacity += opacityKnots * count;
    firstWeight += group.mixture?.data.length ?? 0;
  });
  const gaussians = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D_ARRAY, gaussians);
  gl.texImage3D(
    gl.TEXTURE_2D_ARRAY,
    0,
    gl.RGBA32F,
    TABLE_WIDTH,
    rows,
    5,
    0,
    gl.RGBA,
    gl.FLOAT,
    layers,
  );
  setNearest(gl, gl.TEXTURE_2D_ARRAY);
  return {
    gaussians: { kind: gl.TEXTURE_2D_ARRAY, texture: gaussians },
    colorOffsets: makeTable(gl, gl.RGBA16F, 4, concatenate(colors)),
    opacityOffsets: makeTable(gl, gl.R32F, 1, concatenate(opacities)),
    mixture: makeTable(gl, gl.R32F, 1, concatenate(weights)),
    sh1: makeTable(gl, gl.RGBA32F, 4, concatenate(directions)),
    groups: places,
    viewDependent,
  };
}

/** A texture of `values` with `channels` numbers a texel, row after row. */
export function makeTable(gl, format, channels, values, width = TABLE_WIDTH) {
  const rows = Math.max(Math.ceil(values.length / (channels * width)), 1);
  const padded = new Float32Array(channels * width * rows);
  padded.set(values);
  const texture = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, texture);
  const layout = channels === 1 ? gl.RED : gl.RGBA;
  gl.texImage2D(gl.TEXTURE_2D, 0, format, width, rows, 0, layout, gl.FLOAT, padded);
  setNearest(gl, gl.TEXTURE_2D);
  return { kind: gl.TEXTURE_2D, texture };
}

export function setNearest(gl, kind) {
  gl.texParameteri(kind, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
  gl.texParameteri(kind, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
  gl.texParameteri(kind, gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE);
  gl.texParameteri(kind, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
}

/** Columns of several arrays side by side, `stride` numbers a row. */
function interleave(out, stride, parts) {
  let column = 0;
  for (const [values, width] of parts) {
    for (let i = 0; i < values.length / width; i++) {
      for (let c = 0; c < width; c++) out[i * stride + column + c] = values[i * width + c];
    }
    column += width;
  }
}

/** Offsets of log radiance (K, N, 1 or 3) with four numbers an entry. */
function asColors({ shape, data }) {
  const channels = shape[2];
  const entries = shape[0] * shape[1];
  const out = new Float32Array(4 * entries);
  for (let i = 0; i < entries; i++) {
    for (let c = 0; c < 3; c++) out[4 * i + c] = data[channels * i + (channels === 3 ? c : 0)];
  }
  return out;
}

/** Triples with a fourth number. */
function asTriples(data) {
  const out = new Float32Array((4 * data.length) / 3);
  interleave(out, 4, [[data, 3]]);
  return out;
}

function concatenate(arrays) {
  const out = new Float32Array(arrays.reduce((sum, array) => sum + array.length, 0));
  let first = 0;
  for (const array of arrays) {
    out.set(array, first);
    first += array.length;
  }
  return out;
}
