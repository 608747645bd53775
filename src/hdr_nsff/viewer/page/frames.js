// Frames that the server renders, for browsers without a GPU: coarse first, then finer;
// the newest request wins.

import { scaleK } from "./cameras.js";

const FIRST_SECONDS = 0.12; // that a first, coarse frame may take
const START_RATE = 1e4; // pixels per second, as of `grid` on a CPU, before any was measured
const SMALLEST_WIDTH = 32; // pixels
const PROBLEM_SECONDS = 8; // that a sentence about a frame is shown
const ROUNDING = 0.99; // of the most pixels: sides are rounded

export class Frames {
  /**
   * Shows frames in `image`, at most `maxWidth` pixels wide: those of the clip, as finer
   * ones would take longer and show nothing more. `settings` are those of the page. Where
   * none come, calls `failed` with a sentence and for how many seconds it is of use, 0: for
   * ever.
   */
  constructor(image, maxWidth, settings, failed) {
    this.image = image;
    this.maxWidth = maxWidth;
    this.maxPixels = settings.max_pixels;
    this.records = settings.records;
    this.failed = failed;
    this.rate = START_RATE;
    this.wanted = null; // the newest request that is not answered yet
    this.busy = false;
    this.refining = null; // ends the request for a finer frame that is running
    this.kept = null; // the place and the scale of the last frame, which the server keeps
    this.scenes = 0; // that the server has had after the first one
    this.shown = 0; // frames so far
  }

  /** Show another view. A coarse frame that is on its way comes first, a finer one never. */
  request(view, state) {
    this.wanted = orderOf(view, state, "jpeg");
    if (this.busy) this.refining?.abort();
    else this.answer();
  }

  /** The scene is another one. */
  forget() {
    this.scenes++;
  }

  async answer() {
    this.busy = true;
    while (this.wanted) {
      const wanted = this.wanted;
      this.wanted = null;
      const finest = this.finestScale(wanted);
      let scale = this.firstScale(wanted, finest);
      while (await this.show(wanted, scale)) {
        if (this.wanted || scale === finest) break;
        scale = Math.min(2 * scale, finest);
        this.refining = new AbortController();
      }
      this.refining = null;
    }
    this.busy = false;
  }

  finestScale(wanted) {
    const largest = scaleTo(wanted, ROUNDING * this.maxPixels);
    return Math.min(this.maxWidth / wanted.width, largest, 1);
  }

  /** Where the server has a frame to develop anew, its scale; else one that is fast. */
  firstScale(wanted, finest) {
    if (this.isKept(wanted)) return this.kept.scale;
    const affordable = scaleTo(wanted, this.rate * FIRST_SECONDS);
    return Math.min(Math.max(affordable, SMALLEST_WIDTH / wanted.width), finest);
  }

  isKept(wanted) {
    const rendered = this.records && wanted.curve === "camera"; // once more by the server
    return this.kept?.place === this.placeOf(wanted) && !rendered;
  }

  /** What a rendering depends on; it can be developed in any way. */
  placeOf({ time, c2w, K, width, height, show }) {
    return JSON.stringify([this.scenes, time, c2w, K, width, height, show === "flow"]);
  }

  /** Ask for a frame with `scale` times the pixels a side, and show it; whether it came. */
  async show(wanted, scale) {
    const place = this.placeOf(wanted);
    const rendered = !this.isKept(wanted) || scale !== this.kept.scale;
    const start = performance.now();
    const blob = await this.load(wanted, scale, this.refining?.signal);
    if (!blob) return false;
    const pixels = wanted.width * wanted.height * scale * scale;
    if (rendered) this.rate = (1000 * pixels) / (performance.now() - start);
    this.kept = { place, scale };
    const old = this.image.src;
    this.image.src = URL.createObjectURL(blob);
    await this.image.decode();
    this.image.hidden = false;
    this.shown++;
    if (old) URL.revokeObjectURL(old);
    return true;
  }

  /** The finest frame of a view as a PNG file of 8 or 16 bits; null where none comes. */
  png(view, state, bits) {
    const wanted = orderOf(view, state, `png${bits}`);
    return this.load(wanted, this.finestScale(wanted));
  }

  /** A frame's file; null, after a sentence, where none comes, and where it was aborted. */
  async load(wanted, scale, signal) {
    const width = Math.max(Math.round(wanted.width * scale), 1);
    const height = Math.max(Math.round(wanted.height * scale), 1);
    const K = scaleK(wanted.K, width / wanted.width);
    const body = JSON.stringify({ ...wanted, K, width, height });
    try {
      const response = await fetch("frame", { method: "POST", body, signal });
      if (!response.ok) throw new Error(await response.text());
      return await response.blob();
    } catch (error) {
      if (error.name === "AbortError") return null; // another view is wanted
      if (error instanceof TypeError) this.failed("The server has stopped.", 0);
      else this.failed(error.message, PROBLEM_SECONDS);
      return null;
    }
  }
}

/** What is asked of the server. */
function orderOf(view, { ev, curve, camera, clipping, falseColor }, kind) {
  return { ...view, ev, curve, camera, clipping, falseColor, kind };
}

/** The scale that gives a view so many pixels. */
function scaleTo({ width, height }, pixels) {
  return Math.sqrt(pixels / (width * height));
}
