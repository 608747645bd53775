// Writes PNG files, with 16 bits a channel too, which a canvas cannot.

const SIGNATURE = [137, 80, 78, 71, 13, 10, 26, 10];

/**
 * A PNG file of 8 or 16 bits of rgb in [0, 1], four numbers a pixel, from the top. Colors
 * are sRGB, or what `tags`, the content of the chunk cICP, say.
 */
export async function encodePng(values, width, height, bits, tags = null) {
  const bytes = bits / 8;
  const largest = 2 ** bits - 1;
  const rowBytes = 1 + 3 * bytes * width; // filter type 0, then three samples a pixel
  const raw = new DataView(new ArrayBuffer(rowBytes * height));
  for (let y = 0; y < height; y++) {
    for (let x = 0; x < width; x++) {
      for (let c = 0; c < 3; c++) {
        const value = Math.min(Math.max(values[4 * (y * width + x) + c], 0), 1);
        const place = y * rowBytes + 1 + bytes * (3 * x + c);
        const sample = Math.round(largest * value);
        if (bits === 16) raw.setUint16(place, sample);
        else raw.setUint8(place, sample);
      }
    }
  }
  const stream = new Blob([raw]).stream().pipeThrough(new CompressionStream("deflate"));
  const data = new Uint8Array(await new Response(stream).arrayBuffer());
  const header = new DataView(new ArrayBuffer(13));
  header.setUint32(0, width);
  header.setUint32(4, height);
  header.setUint8(8, bits);
  header.setUint8(9, 2); // rgb
  const parts = [
    Uint8Array.from(SIGNATURE),
    chunk("IHDR", new Uint8Array(header.buffer)),
    tags ? chunk("cICP", Uint8Array.from(tags)) : chunk("sRGB", Uint8Array.of(0)),
    chunk("IDAT", data),
    chunk("IEND", new Uint8Array()),
  ];
  return new Blob(parts, { type: "image/png" });
}

function chunk(kind, data) {
  const bytes = new Uint8Array(12 + data.length);
  const view = new DataView(bytes.buffer);
  view.setUint32(0, data.length);
  for (let i = 0; i < 4; i++) bytes[4 + i] = kind.charCodeAt(i);
  bytes.set(data, 8);
  view.setUint32(8 + data.length, crc32(bytes.subarray(4, 8 + data.length)));
  return bytes;
}

function crc32(bytes) {
  let crc = ~0;
  for (const byte of bytes) {
    crc ^= byte;
    for (let k = 0; k < 8; k++) crc = (crc >>> 1) ^ (crc & 1 ? 0xedb88320 : 0);
  }
  return ~crc >>> 0;
}
