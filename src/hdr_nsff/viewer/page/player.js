// The state of the viewer, and the loop that draws it.

import {
  filmedCamera,
  interpolate,
  meanDown,
  moved,
  orbit,
  pointAhead,
  scaleK,
} from "./cameras.js";
import { EXTENDED } from "./curves.js";
import { encodePng } from "./png.js";
import { PQ_TAGS, encodePq } from "./pq.js";
import { BLUR, Renderer } from "./renderer.js";

const STILL_VIEWS = 24; // of a camera path between two views at the same time
const MAX_PIXEL_RATIO = 2; // picture pixels per CSS pixel
const FLY_SPEED = 0.5; // near distances per second
const RADIANS_PER_PICTURE = 2.0; // turn for a drag across the picture
const MAX_EV = 8;
const MEASURED_FRAMES = 20; // in a row, at most, that tell the frame rate
const LEAST_FRAMES = 6;
const LEAST_MILLISECONDS = 1000; // that a frame rate is measured over before it has effects
const PAUSE_MILLISECONDS = 500; // between two frames: another tab was looked at
const PAUSE_FRAMES = 3; // as long at least, as a slow GPU pauses at every frame
const SLOW_FRAMES_PER_SECOND = 10;
const SMOOTH_FRAMES_PER_SECOND = 24;

export class Player {
  constructor(scene, canvas) {
    this.scene = scene;
    this.canvas = canvas;
    this.renderer = null; // set where the browser can draw
    this.frames = null; // else pictures come from the server
    this.hdr = null; // shows light above white, where browser and screen do
    this.changed = () => {}; // called after every change of `state`
    this.first = scene.times[0];
    this.last = scene.times[scene.times.length - 1];
    this.down = meanDown(scene.views);
    this.focus = 2 / (1 / scene.near + 1 / scene.far); // depth that orbits turn about
    this.free = scene.parallax === "full"; // whether the camera may leave the filmed places
    this.pose = filmedCamera(scene.views, this.first); // of the cameras that stay or are moved
    this.keys = []; // views of a camera path
    this.held = new Set(); // keys that fly
    this.state = {
      time: this.first,
      playing: false,
      loop: true,
      speed: 1,
      ev: Math.round(10 * Math.log2(scene.display_exposure)) / 10,
      curve: "reinhard",
      camera: 0,
      show: "radiance",
      clipping: false,
      falseColor: false,
      mode: "filmed",
      split: false,
      splitAt: 0.5,
      stats: false,
    };
    this.state.ev = clamp(this.state.ev, -MAX_EV, MAX_EV);
    this.maxRatio = MAX_PIXEL_RATIO; // less where drawing is slow
    this.advised = false; // whether a slow browser has been told of the videos
    this.frameTimes = [];
    this.gap = 0; // milliseconds between the last two turns of the loop
    this.dirty = true;
    this.sorting = false;
    this.sortedFor = "";
  }

  /** Change some of the state. */
  set(change) {
    if ("time" in change) change.time = clamp(change.time, this.first, this.last);
    if ("ev" in change) change.ev = clamp(change.ev, -MAX_EV, MAX_EV);
    if (change.mode && !this.free && change.mode !== "filmed") change.mode = "fixed";
    if (change.mode && change.mode !== "filmed" && this.state.mode === "filmed")
      this.pose = this.camera();
    if (
      change.split ||
      (this.state.split && !("split" in change) && change.mode && change.mode !== "filmed")
    ) {
      // a recorded frame is compared from where it was filmed
      if (change.split) change.mode = "filmed";
      else change.split = false;
    }
    if (change.mode && change.mode !== "fly") this.held.clear();
    Object.assign(this.state, change);
    this.dirty = true;
    this.changed();
  }

  /** The camera { c2w, K } now, K in pixels of the clip's frames. */
  camera() {
    const { mode, time } = this.state;
    return mode === "filmed" ? filmedCamera(this.scene.views, time) : this.pose;
  }

  /** What is drawn now, on the canvas or at another size. */
  view({ width, height } = this.canvas) {
    const { c2w, K } = this.camera();
    const { time, show } = this.state;
    const scale = width / this.scene.width;
    // pixels of the clip's size, as in training: sharper ones would show needles
    const blur = BLUR * Math.max(scale * scale, 1);
    return { time, c2w, K: scaleK(K, scale), width, height, show, blur };
  }

  /** Turn by a drag, in shares of the picture's width. */
  turn(x, y) {
    if (!this.free) return;
    if (this.state.mode !== "orbit" && this.state.mode !== "fly") this.set({ mode: "orbit" });
    const { c2w, K } = this.pose;
    const around = this.state.mode === "orbit";
    const pivot = around ? pointAhead(c2w, this.focus) : c2w.map((row) => row[3]);
    const sign = around ? 1 : -1;
    const angles = [sign * x * RADIANS_PER_PICTURE, -sign * y * RADIANS_PER_PICTURE];
    this.pose = { c2w: orbit(c2w, pivot, this.down, ...angles), K };
    this.touch();
  }

  /** Move right, down and forward, in near distances. */
  move(offset) {
    if (!this.free) return;
    if (this.state.mode !== "orbit" && this.state.mode !== "fly") this.set({ mode: "orbit" });
    const scaled = offset.map((value) => value * this.scene.near);
    this.pose = { ...this.pose, c2w: moved(this.pose.c2w, scaled) };
    if (this.state.mode === "orbit")
      this.focus = Math.max(this.focus - scaled[2], 0.05 * this.scene.near);
    this.touch();
  }

  /** Back to the filmed camera. */
  resetCamera() {
    this.focus = 2 / (1 / this.scene.near + 1 / this.scene.far);
    this.pose = filmedCamera(this.scene.views, this.state.time);
    this.set({ mode: "filmed" });
  }

  /** Show another state of the same scene: a run that is training. */
  async replace(scene) {
    for (const { address } of this.scene.views) if (address) URL.revokeObjectURL(address);
    this.scene = scene;
    this.frames?.forget();
    if (this.renderer) await this.renew(this.renderer, scene);
    this.set({});
  }

  /** Draw another scene in place of a renderer, unless the server has taken over. */
  async renew(old, scene) {
    const renderer = new Renderer(old.gl, scene, ...old.sources);
    await renderer.sort(this.view());
    if (this.renderer !== old) return renderer.dispose();
    this.renderer = renderer;
    this.sorting = false;
    this.sortedFor = "";
    this.frameTimes = []; // making it took long
    old.dispose();
  }

  /** Draw again. */
  touch() {
    this.dirty = true;
  }

  /** Fit the picture, of the clip's aspect, into `width` x `height` CSS pixels. */
  fit(width, height) {
    const { scene, canvas } = this;
    this.room = [width, height];
    const scale = Math.min(width / scene.width, height / scene.height);
    const shown = [scene.width * scale, scene.height * scale];
    const fullRatio = Math.min(devicePixelRatio || 1, MAX_PIXEL_RATIO);
    const ratio = Math.min(fullRatio, Math.max(this.maxRatio, 1 / scale));
    const sizeAt = (r) => shown.map((side) => Math.max(Math.round(side * r), 1));
    const [fullWidth, fullHeight] = sizeAt(fullRatio);
    this.fullSize = { width: fullWidth, height: fullHeight };
    const pixels = sizeAt(ratio);
    if (canvas.width !== pixels[0] || canvas.height !== pixels[1]) {
      [canvas.width, canvas.height] = pixels;
      this.touch();
    }
    return shown;
  }

  /**
   * Draw fewer pixels from now on where drawing is not smooth, down to the clip's; whether
   * that was done.
   */
  easeOff() {
    const { canvas, scene } = this;
    if (!this.isBelow(SMOOTH_FRAMES_PER_SECOND) || canvas.width <= scene.width) return false;
    this.maxRatio = Math.min(this.maxRatio, devicePixelRatio || 1) / 2;
    this.frameTimes = [];
    this.fit(...this.room);
    return true;
  }

  /** One turn of the loop, at `now` in milliseconds. */
  tick(now) {
    const gap = now - (this.before ?? now);
    if (gap > Math.max(PAUSE_MILLISECONDS, PAUSE_FRAMES * this.gap)) this.frameTimes = [];
    this.gap = gap;
    this.before = now;
    const seconds = Math.min(gap / 1000, 0.25);
    this.advance(seconds);
    this.fly(seconds);
    if (this.renderer) this.drawIfNeeded(now);
    else if (this.frames && this.dirty) {
      this.dirty = false;
      this.frames.request(this.view(), this.state);
    }
  }

  advance(seconds) {
    const { playing, speed, loop, time } = this.state;
    if (!playing || this.last === this.first) return;
    let next = time + seconds * speed * this.scene.fps;
    if (next <= this.last) return this.set({ time: next });
    if (!loop) return this.set({ time: this.last, playing: false });
    const length = this.last - this.first;
    next = this.first + ((next - this.first) % length);
    this.set({ time: next });
  }

  fly(seconds) {
    if (!this.held.size) return;
    const along = (plus, minus) => (this.held.has(plus) ? 1 : 0) - (this.held.has(minus) ? 1 : 0);
    const step = FLY_SPEED * seconds;
    this.move([step * along("d", "a"), step * along("q", "e"), step * along("w", "s")]);
  }

  drawIfNeeded(now) {
    const view = this.view();
    const place = JSON.stringify([view.time, view.c2w]);
    if (place !== this.sortedFor && !this.sorting) {
      this.sorting = true;
      this.sortedFor = place;
      const { renderer } = this;
      renderer.sort(view).then(() => {
        if (renderer !== this.renderer) return;
        this.sorting = false;
        this.dirty = true;
      });
    }
    if (!this.dirty) {
      this.frameTimes = []; // at rest, time says nothing about speed
      return;
    }
    this.dirty = false;
    const target = this.renderer.composite(view, "screen");
    if (this.isBeyondWhite()) this.hdr.present(this.renderer.halves(target, this.state));
    else this.renderer.develop(target, this.state);
    this.frameTimes.push(now);
    if (this.frameTimes.length > MEASURED_FRAMES) this.frameTimes.shift();
    if (this.frameTimes.length >= LEAST_FRAMES) {
      this.rate = (1000 * (this.frameTimes.length - 1)) / (now - this.frameTimes[0]);
    }
  }

  /** Whether light above white is shown now; else the canvas for it is hidden. */
  isBeyondWhite() {
    const { curve, show, falseColor } = this.state;
    if (this.hdr && curve === EXTENDED && show === "radiance" && !falseColor) return true;
    this.hdr?.hide();
    return false;
  }

  /** Pictures drawn per second, when last they were drawn one after the other; or null. */
  framesPerSecond() {
    return this.rate ?? null;
  }

  /** Whether pictures were drawn one after the other at less than `rate` per second. */
  isBelow(rate) {
    const { frameTimes } = this;
    const span = frameTimes[frameTimes.length - 1] - frameTimes[0];
    const measured = frameTimes.length >= LEAST_FRAMES && span >= LEAST_MILLISECONDS;
    return measured && this.rate < rate;
  }

  /** Whether this browser has just drawn too slowly to be of use. */
  isSlow() {
    return this.isBelow(SLOW_FRAMES_PER_SECOND);
  }

  /**
   * Exposed linear radiance, 2^EV times what `render` gives, as float32 RGBA row by row
   * from the top; alpha is opacity. Without a `view`, of what is shown.
   */
  async readLinear(view = this.view()) {
    const whole = { show: "radiance", ...view };
    const renderer = await this.sorted(whole);
    const values = renderer.read(renderer.composite(whole, "read"));
    this.sortedFor = ""; // what is shown is sorted again
    const gain = whole.show === "radiance" ? 2 ** this.state.ev : 1;
    for (let i = 0; i < values.length; i++) if (i % 4 !== 3) values[i] *= gain;
    return values;
  }

  /**
   * What is shown as a PNG file of 8 or 16 bits, as fine as the screen. Light above white
   * is kept with 16 bits, as PQ. Null where the server renders, and does not answer.
   */
  async png(bits) {
    const view = this.view(this.fullSize);
    const renderer = await this.sorted(view);
    if (!renderer) return this.frames.png(view, this.state, bits);
    const maps = renderer.composite(view, "read");
    const picture = renderer.target("png", view.width, view.height, renderer.deepFormat());
    renderer.develop(maps, this.state, picture);
    this.sortedFor = ""; // what is shown is sorted again
    const values = renderer.read(picture);
    const size = [view.width, view.height];
    if (bits === 16 && this.isBeyondWhite())
      return encodePng(encodePq(values), ...size, bits, PQ_TAGS);
    return encodePng(values, ...size, bits);
  }

  /** The renderer once it has sorted for a view; another one may take its place. */
  async sorted(view) {
    for (;;) {
      const { renderer } = this;
      await renderer?.sort(view);
      if (renderer === this.renderer) return renderer;
    }
  }

  /** Remember the camera and time of now for a path. */
  addKey() {
    this.keys.push({ time: this.state.time, ...this.camera() });
    this.changed();
  }

  clearKeys() {
    this.keys = [];
    this.changed();
  }

  /**
   * The camera path as `render --path` takes it: through the remembered views, one view
   * a frame of the clip; without any, the camera of now through the whole clip.
   */
  cameraPath() {
    const { curve, ev, mode } = this.state;
    let views = this.keys.length ? pathThrough(this.keys) : null;
    views ??= evenTimes(this.scene.times).map((time) => ({
      time,
      ...(mode === "filmed" ? filmedCamera(this.scene.views, time) : this.pose),
    }));
    const exposed = curve === "camera" ? { ev } : {}; // others have no learned camera
    const { times } = this.scene;
    return views.map(({ time, c2w, K }) => ({
      time: clamp(round(time), times[0], times[times.length - 1]), // `render` takes no other
      c2w: rounded(c2w),
      K: rounded(K),
      ...exposed,
    }));
  }
}

/** From the first to the last of `times` by their usual gap: also held-out frames. */
function evenTimes(times) {
  const [first, last] = [times[0], times[times.length - 1]];
  const gaps = times.slice(1).map((time, i) => time - times[i]);
  const usual = gaps.sort((a, b) => a - b)[(gaps.length - 1) >> 1]; // as `paths.usual_gap`
  const count = usual ? Math.ceil((last - first) / usual - 1e-6) : 0;
  return [...Array.from({ length: count }, (_, k) => first + k * usual), last];
}

/** Views through `keys`, about a frame of the clip apart. */
function pathThrough(keys) {
  const views = [];
  for (let i = 0; i + 1 < keys.length; i++) {
    const [a, b] = [keys[i], keys[i + 1]];
    const frames = Math.abs(b.time - a.time);
    const count = frames > 0.5 ? Math.ceil(frames) : STILL_VIEWS;
    for (let k = 0; k < count; k++) {
      const share = k / count;
      views.push({ time: a.time + share * (b.time - a.time), ...interpolate(a, b, share) });
    }
  }
  return [...views, keys[keys.length - 1]];
}

function round(value) {
  return Number(value.toFixed(6));
}

function rounded(rows) {
  return rows.map((row) => row.map(round));
}

function clamp(value, low, high) {
  return Math.min(Math.max(value, low), high);
}
