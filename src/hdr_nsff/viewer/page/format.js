// Reads a scene file: safetensors with a JSON document (docs/formats.md, "Scene file").

const KEY = "hdr4d";
const ARRAYS = [
  "means",
  "quaternions",
  "log_scales",
  "opacity_logits",
  "log_radiance",
  "color_offsets",
  "opacity_offsets",
  "mixture",
  "velocities",
  "centers",
  "log_durations",
  "sh1",
];

/** The bytes of a base64 text that holds a gzip file. */
export async function unpack(text) {
  const binary = atob(text.trim());
  const bytes = Uint8Array.from(binary, (letter) => letter.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Response(stream).arrayBuffer();
}

/** The scene of a scene file's bytes. All arrays are decoded to float32. */
export function readScene(buffer) {
  const length = Number(new DataView(buffer).getBigUint64(0, true));
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 8, length)));
  const scene = JSON.parse(header.__metadata__[KEY]);
  const read = (name) => {
    const entry = header[name];
    if (!entry) return null;
    const [first, last] = entry.data_offsets;
    const bytes = buffer.slice(8 + length + first, 8 + length + last);
    return { shape: entry.shape, data: decode(bytes, entry.dtype, scene.factors[name] ?? 1) };
  };
  for (const group of scene.groups) {
    for (const name of ARRAYS) group[name] = read(`${group.name}.${name}`);
  }
  scene.bases = null;
  if (header["bases.centers"]) {
    const centers = read("bases.centers");
    scene.bases = {
      count: centers.shape[0],
      centers: centers.data,
      quaternions: read("bases.quaternions").data,
      shifts: read("bases.shifts").data,
    };
  }
  scene.recorded = header.recorded
    ? new Uint8Array(buffer, 8 + length + header.recorded.data_offsets[0])
    : null;
  return scene;
}

/** Numbers of a safetensors type as float32, times a factor. */
function decode(bytes, type, factor) {
  switch (type) {
    case "F32":
      return new Float32Array(bytes);
    case "F16":
      return halfToFloat(new Uint16Array(bytes));
    case "I16":
      return Float32Array.from(new Int16Array(bytes), (value) => value * factor);
    case "U16":
      return Float32Array.from(new Uint16Array(bytes), (value) => value * factor);
  }
  throw new Error(`scene file: arrays of type ${type} are not known`);
}

/** IEEE half precision to single precision. */
function halfToFloat(halves) {
  const floats = new Float32Array(halves.length);
  for (let i = 0; i < halves.length; i++) {
    const bits = halves[i];
    const exponent = (bits >> 10) & 31;
    const mantissa = bits & 1023;
    let value = exponent === 0 ? mantissa * 2 ** -24 : (1 + mantissa / 1024) * 2 ** (exponent - 15);
    if (exponent === 31) value = mantissa ? NaN : Infinity;
    floats[i] = bits & 0x8000 ? -value : value;
  }
  return floats;
}
