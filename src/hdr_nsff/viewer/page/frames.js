// Frames that the server renders, for browsers without a GPU: coarse first, then finer;
// the newest request wins.

import { scaleK } from "./cameras.js";

export const SERVER_CURVES = ["camera", "reinhard", "clip"];
export const SERVER_VIEWS = ["radiance", "depth", "motion"];
const FIRST_SECONDS = 0.12; // that a first, coarse frame may take
const START_RATE = 3e5; // pixels per second, before any was measured
const SMALLEST_WIDTH = 32; // pixels
const ROUNDING = 0.99; // of the most pixels: sides are rounded

export class Frames {
  /**
   * Shows frames in `image`, at most `maxWidth` pixels wide: those of the clip, as finer
   * ones would take longer and show nothing more. They have `maxPixels` at most. Calls
   * `failed` with a sentence where none come.
   */
  constructor(image, maxWidth, maxPixels, failed) {
    this.image = image;
    this.maxWidth = maxWidth;
    this.maxPixels = maxPixels;
    this.failed = failed;
    this.rate = START_RATE;
    this.wanted = null; // the newest request that is not answered yet
    this.busy = false;
    this.shown = 0; // frames so far
  }

  request(view, state) {
    const { ev, curve, camera } = state;
    this.wanted = { ...view, ev, curve, camera };
    if (!this.busy) this.answer();
  }

  async answer() {
    this.busy = true;
    while (this.wanted) {
      const wanted = this.wanted;
      this.wanted = null;
      const scaleTo = (pixels) => Math.sqrt(pixels / (wanted.width * wanted.height));
      const affordable = scaleTo(this.rate * FIRST_SECONDS);
      const largest = scaleTo(ROUNDING * this.maxPixels);
      const finest = Math.min(this.maxWidth / wanted.width, largest, 1);
      let scale = Math.min(Math.max(affordable, SMALLEST_WIDTH / wanted.width), finest);
      while (!this.wanted) {
        if (!(await this.show(wanted, scale))) break;
        if (scale === finest) break;
        scale = Math.min(2 * scale, finest);
      }
    }
    this.busy = false;
  }

  /** Ask for a frame with `scale` times the pixels a side, and show it. */
  async show(wanted, scale) {
    const width = Math.max(Math.round(wanted.width * scale), 1);
    const height = Math.max(Math.round(wanted.height * scale), 1);
    const body = JSON.stringify({
      ...wanted,
      K: scaleK(wanted.K, width / wanted.width),
      width,
      height,
    });
    const start = performance.now();
    try {
      const response = await fetch("frame", { method: "POST", body });
      if (!response.ok) throw new Error(await response.text());
      const blob = await response.blob();
      this.rate = (1000 * width * height) / (performance.now() - start);
      const old = this.image.src;
      this.image.src = URL.createObjectURL(blob);
      await this.image.decode();
      this.image.hidden = false;
      this.shown++;
      if (old) URL.revokeObjectURL(old);
      return true;
    } catch (error) {
      this.failed(error instanceof TypeError ? "The server has stopped." : error.message);
      return false;
    }
  }
}
