// Light above white, on screens that have it: WebGPU presents what WebGL has drawn.
//
// The canvas of WebGL ends at white in the browsers of today. One of WebGPU above it
// takes half floats in extended range, where 1 is the page's white. The picture goes
// there through memory, which works between all drivers.

const HIGH_RANGE = "(dynamic-range: high)";
const MAX_WAIT_MILLISECONDS = 2000; // for the graphics driver

/** Whether the window is on a screen of high dynamic range. */
export function hasHighRange() {
  return matchMedia(HIGH_RANGE).matches;
}

/** The screen of extended range on `canvas`; null where browser or screen have none. */
export async function openHdrScreen(canvas) {
  if (!navigator.gpu || !hasHighRange()) return null;
  const late = new Promise((done) => setTimeout(done, MAX_WAIT_MILLISECONDS, null));
  try {
    return await Promise.race([connect(canvas), late]);
  } catch {
    return null; // the picture is that of other screens
  }
}

async function connect(canvas) {
  const adapter = await navigator.gpu.requestAdapter();
  const device = await adapter.requestDevice();
  const context = canvas.getContext("webgpu");
  context.configure({
    device,
    format: "rgba16float",
    usage: GPUTextureUsage.RENDER_ATTACHMENT | GPUTextureUsage.COPY_DST,
    toneMapping: { mode: "extended" },
  });
  // browsers that know no such mode leave it out
  if (context.getConfiguration().toneMapping?.mode !== "extended") return null;
  return new HdrScreen(canvas, device, context);
}

export class HdrScreen {
  constructor(canvas, device, context) {
    this.canvas = canvas;
    this.device = device;
    this.context = context;
    this.range = matchMedia(HIGH_RANGE);
    this.lost = false;
    device.lost.then(() => (this.lost = true));
  }

  /** Whether the window is on a screen of high dynamic range now. */
  get usable() {
    return this.range.matches && !this.lost;
  }

  /** Call `changed` when the screen may have become another one. */
  watch(changed) {
    this.range.addEventListener("change", changed);
    this.device.lost.then(changed);
  }

  /** Show half floats, sRGB beyond white, RGBA row by row from the top. */
  present({ values, width, height }) {
    const { canvas, context, device } = this;
    if (canvas.width !== width) canvas.width = width;
    if (canvas.height !== height) canvas.height = height;
    const texture = context.getCurrentTexture();
    const rows = { bytesPerRow: 8 * width };
    device.queue.writeTexture({ texture }, values, rows, [width, height]);
    canvas.hidden = false;
  }

  hide() {
    this.canvas.hidden = true;
  }
}
