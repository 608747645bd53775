// Frames that the server renders, for browsers without a GPU: coarse first, then finer;
// the newest request wins.

import { scaleK } from "./cameras.js";

export const SERVER_CURVES = ["camera", "reinhard", "clip"];
export const SERVER_VIEWS = ["radiance", "depth", "motion"];
const FIRST_SECONDS = 0.12; // that a first, coarse frame may take
const START_RATE = 1e4; // pixels per second, as of `grid` on a CPU, before any was measured
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
    this.refining = null; // ends the request for a finer frame that is running
    this.shown = 0; // frames so far
  }

  /** Show another view. A coarse frame that is on its way comes first, a finer one never. */
  request(view, state) {
    const { ev, curve, camera } = state;
    this.wanted = { ...view, ev, curve, camera };
    if (this.busy) this.refining?.abort();
    else this.answer();
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
      while (await this.show(wanted, scale)) {
        if (this.wanted || scale === finest) break;
        scale = Math.min(2 * scale, finest);
        this.refining = new AbortController();
      }
      this.refining = null;
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
      const { signal } = this.refining ?? {};
      const response = await fetch("frame", { method: "POST", body, signal });
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
      if (error.name === "AbortError") return false; // another view is wanted
      this.failed(error instanceof TypeError ? "The server has stopped." : error.message);
      return false;
    }
  }
}
