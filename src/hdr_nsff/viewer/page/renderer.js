// Draws a scene with WebGL2: Gaussians to linear maps in half floats, maps to the screen.

import { knotOf, posesAt } from "./motion.js";
import { CURVES, curveTable } from "./curves.js";
import { Program } from "./program.js";
import { makeTable, makeTables, setNearest } from "./tables.js";

export const VIEWS = ["radiance", "depth", "motion", "flow"];
const FEATURES = { radiance: 0, depth: 1, motion: 1, flow: 2 };
export const BLUR = 0.3; // pixels^2 added to 2D variances, as `render` does
const NEAREST = 0.01; // z-depth over that of the near depth: nothing nearer is drawn
const MAX_FLOW_SHARE = 0.02; // of the picture's width: flow shown in full color

/** A WebGL2 context that can blend half floats; throws a sentence where there is none. */
export function openContext(canvas) {
  const gl = canvas.getContext("webgl2", {
    alpha: false,
    antialias: false,
    powerPreference: "high-performance",
  });
  if (!gl) throw new Error("This browser offers no WebGL 2.");
  const halves =
    gl.getExtension("EXT_color_buffer_float") ?? gl.getExtension("EXT_color_buffer_half_float");
  if (!halves) throw new Error("This graphics driver cannot draw to half floats.");
  return gl;
}

/** The name of the graphics driver, as far as the browser tells it. */
export function driverName(gl) {
  const info = gl.getExtension("WEBGL_debug_renderer_info");
  return gl.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : gl.RENDERER) ?? "";
}

export class Renderer {
  /** `shaders` are sources by file name, `sorterSource` the text of the worker. */
  constructor(gl, scene, shaders, sorterSource) {
    this.gl = gl;
    this.scene = scene;
    this.sources = [shaders, sorterSource];
    this.count = scene.groups.reduce((sum, group) => sum + group.count, 0);
    this.splat = new Program(gl, shaders["splat.vert"], shaders["splat.frag"]);
    this.screen = new Program(gl, shaders["picture.vert"], shaders["develop.frag"]);
    this.tables = makeTables(gl, scene);
    this.responses = scene.responses.map((entry) =>
      makeTable(gl, gl.RGBA32F, 4, curveTable(entry), 1024),
    );
    this.targets = new Map(); // offscreen pictures by name
    this.orderBuffer = gl.createBuffer();
    this.vertices = gl.createVertexArray();
    gl.bindVertexArray(this.vertices);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.orderBuffer);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribIPointer(0, 1, gl.UNSIGNED_INT, 0, 0);
    gl.vertexAttribDivisor(0, 1);
    gl.bindVertexArray(null);
    this.sorter = new Sorter(scene, sorterSource);
    this.visible = 0;
  }

  /** Give back what the GPU holds. */
  dispose() {
    const { gl, tables } = this;
    const textures = ["gaussians", "colorOffsets", "opacityOffsets", "mixture", "sh1"].map(
      (name) => tables[name].texture,
    );
    for (const { texture } of this.responses) textures.push(texture);
    for (const { texture, framebuffer } of this.targets.values()) {
      textures.push(texture);
      gl.deleteFramebuffer(framebuffer);
    }
    for (const texture of [...textures, this.poseTable]) gl.deleteTexture(texture ?? null);
    gl.deleteBuffer(this.orderBuffer);
    this.sorter.dispose();
  }

  /** Sort for a view; resolves once its order is on the GPU, or after `dispose`. */
  async sort(view) {
    const sorted = await this.sorter.sort(view.time, this.poses(view.time), depthRow(view.c2w));
    if (!sorted) return;
    const { order, milliseconds } = sorted;
    const { gl } = this;
    gl.bindBuffer(gl.ARRAY_BUFFER, this.orderBuffer);
    gl.bufferData(gl.ARRAY_BUFFER, order, gl.DYNAMIC_DRAW);
    this.visible = order.length;
    this.sortMilliseconds = milliseconds;
  }

  poses(time) {
    const { bases, times } = this.scene;
    return posesAt(bases, times, knotOf(times, time));
  }

  /**
   * Composite a view, { time, c2w, K, width, height, show }, into the picture `name` of
   * RGBA16F: linear radiance, or sums of other features, premultiplied by opacity.
   */
  composite(view, name) {
    const { gl, scene, splat } = this;
    const target = this.target(name, view.width, view.height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.framebuffer);
    gl.viewport(0, 0, view.width, view.height);
    const background = view.show === "radiance" ? scene.background : [0, 0, 0];
    gl.clearBufferfv(gl.COLOR, 0, [...background, 0]);
    splat.use();
    this.setScene();
    this.setTime(view.time);
    this.setCamera(view);
    splat.set("u_feature", FEATURES[view.show]);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.bindVertexArray(this.vertices);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, this.visible);
    gl.bindVertexArray(null);
    gl.disable(gl.BLEND);
    return target;
  }

  setScene() {
    const { scene, splat, tables } = this;
    const units = ["gaussians", "colorOffsets", "opacityOffsets", "mixture", "sh1"];
    units.forEach((name, unit) => splat.texture(`u_${name}`, unit, tables[name]));
    tables.groups.forEach((group, i) => {
      splat.set(`u_place[${i}]`, group.place);
      splat.set(`u_knots[${i}]`, group.knots);
      splat.set(`u_motion[${i}]`, scene.groups[i].motion);
    });
    splat.set("u_bases", scene.bases?.count ?? 0);
    splat.set("u_bounded", scene.radiance === "sigmoid" ? 1 : 0);
    splat.set("u_viewDependent", tables.viewDependent ? 1 : 0);
  }

  setTime(time) {
    const { gl, scene, splat } = this;
    const { times } = scene;
    const knot = knotOf(times, time);
    const last = Math.max(times.length - 1, 1);
    const forward = knot + 1 <= times.length - 1;
    const flowKnot = Math.max(forward ? knot + 1 : knot - 1, 0);
    const low = Math.min(Math.floor(flowKnot), Math.max(times.length - 2, 0));
    const flowTime = times[low] + (flowKnot - low) * ((times[low + 1] ?? times[low]) - times[low]);
    splat.set("u_time", time);
    splat.set("u_share", knot / last);
    splat.set("u_flowTime", flowTime);
    splat.set("u_flowSign", forward ? 1 : -1);
    const poses = this.poses(time);
    const both = new Float32Array(2 * poses.length);
    both.set(poses);
    both.set(posesAt(scene.bases, times, flowKnot), poses.length);
    this.poseTable ??= gl.createTexture();
    gl.activeTexture(gl.TEXTURE5);
    gl.bindTexture(gl.TEXTURE_2D, this.poseTable);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32F, poses.length / 4, 2, 0, gl.RGBA, gl.FLOAT, both);
    setNearest(gl, gl.TEXTURE_2D);
    splat.texture("u_poses", 5, { kind: gl.TEXTURE_2D, texture: this.poseTable });
  }

  setCamera({ c2w, K, width, height, blur = BLUR }) {
    const { scene, splat } = this;
    const center = c2w.map((row) => row[3]);
    // columns of world to camera are rows of camera to world
    const rotation = c2w.flatMap((row) => row.slice(0, 3));
    const translation = [0, 1, 2].map(
      (i) => -c2w.reduce((sum, row, k) => sum + row[i] * center[k], 0),
    );
    splat.set("u_rotation", rotation);
    splat.set("u_translation", translation);
    splat.set("u_eye", center);
    splat.set("u_camera", [K[0][0], K[1][1], K[0][2], K[1][2]]);
    splat.set("u_nearest", NEAREST * scene.near);
    splat.set("u_size", [width, height]);
    splat.set("u_blur", blur);
  }

  /**
   * Show a composited picture on the canvas, or in the picture `into`; its rows from the
   * top with `flipped`.
   */
  develop(target, look, into = null, flipped = false) {
    const { gl, screen, scene } = this;
    const [width, height] = into
      ? [into.width, into.height]
      : [gl.drawingBufferWidth, gl.drawingBufferHeight];
    gl.bindFramebuffer(gl.FRAMEBUFFER, into ? into.framebuffer : null);
    gl.viewport(0, 0, width, height);
    screen.use();
    screen.texture("u_maps", 0, { kind: gl.TEXTURE_2D, texture: target.texture });
    screen.texture("u_response", 1, this.responses[look.camera]);
    screen.set("u_flipped", flipped ? 1 : 0);
    screen.set("u_view", VIEWS.indexOf(look.show));
    screen.set(
      "u_curve",
      CURVES.findIndex((curve) => curve.id === look.curve),
    );
    screen.set("u_gain", gains(scene.responses[look.camera], look));
    screen.set("u_responseEnd", scene.responses[look.camera].x.at(-1));
    screen.set("u_clipping", look.clipping ? 1 : 0);
    screen.set("u_falseColor", look.falseColor ? 1 : 0);
    screen.set("u_depthRange", [scene.near, scene.far]);
    screen.set("u_maxFlow", MAX_FLOW_SHARE * target.width);
    gl.bindVertexArray(this.vertices);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.bindVertexArray(null);
  }

  /** Whether pictures can be read as half floats. */
  readsHalves() {
    const { gl } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target("halves", 1, 1).framebuffer);
    return gl.getParameter(gl.IMPLEMENTATION_COLOR_READ_TYPE) === gl.HALF_FLOAT;
  }

  /** A composited picture developed as half floats, for a screen beyond white. */
  halves(target, look) {
    const { gl } = this;
    const [width, height] = [gl.drawingBufferWidth, gl.drawingBufferHeight];
    const picture = this.target("halves", width, height);
    this.develop(target, look, picture, true);
    const count = 4 * width * height;
    if (this.halfValues?.length !== count) this.halfValues = new Uint16Array(count);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.HALF_FLOAT, this.halfValues);
    return { values: this.halfValues, width, height };
  }

  /** The format of pictures with the most precision that this browser can draw. */
  deepFormat() {
    const { gl } = this;
    return gl.getExtension("EXT_color_buffer_float") ? gl.RGBA32F : gl.RGBA16F;
  }

  /** Numbers of a picture as float32 RGBA, row by row from the top. */
  read(target) {
    const { gl } = this;
    const { width, height } = target;
    const upward = new Float32Array(4 * width * height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.framebuffer);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.FLOAT, upward);
    const downward = new Float32Array(upward.length);
    for (let y = 0; y < height; y++) {
      downward.set(
        upward.subarray(4 * width * y, 4 * width * (y + 1)),
        4 * width * (height - 1 - y),
      );
    }
    return downward;
  }

  /** An offscreen picture, made anew where its size has changed. */
  target(name, width, height, format = this.gl.RGBA16F) {
    const { gl } = this;
    const found = this.targets.get(name);
    if (found && found.width === width && found.height === height) return found;
    if (found) {
      gl.deleteTexture(found.texture);
      gl.deleteFramebuffer(found.framebuffer);
    }
    const texture = gl.createTexture();
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texStorage2D(gl.TEXTURE_2D, 1, format, width, height);
    setNearest(gl, gl.TEXTURE_2D);
    const framebuffer = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
    const made = { texture, framebuffer, width, height };
    this.targets.set(name, made);
    return made;
  }
}

/** The factors (3) from radiance to what a curve takes. */
export function gains(response, look) {
  const balance = look.curve === "camera" ? response.white_balance : response.neutral;
  return balance.map((value) => value * 2 ** look.ev);
}

/** The third row of world to camera, which gives z-depth. */
function depthRow(c2w) {
  const forward = c2w.map((row) => row[2]);
  return [...forward, -c2w.reduce((sum, row) => sum + row[2] * row[3], 0)];
}

/** The worker that sorts. One view at a time: callers wait for the answer. */
class Sorter {
  constructor(scene, source) {
    const address = URL.createObjectURL(new Blob([source], { type: "text/javascript" }));
    this.worker = new Worker(address);
    this.pending = new Map();
    this.next = 0;
    this.worker.onmessage = ({ data }) => {
      this.pending.get(data.id)(data);
      this.pending.delete(data.id);
    };
    const groups = scene.groups.map((group) => ({
      count: group.count,
      means: group.means.data,
      mixture: group.mixture?.data,
      velocities: group.velocities?.data,
      centers: group.centers?.data,
      logDurations: group.log_durations?.data,
    }));
    this.worker.postMessage({ groups, nearest: NEAREST * scene.near });
  }

  sort(time, poses, row) {
    const id = this.next++;
    return new Promise((resolve) => {
      this.pending.set(id, resolve);
      this.worker.postMessage({ id, time, poses, row });
    });
  }

  /** End the worker; who still waits gets nothing. */
  dispose() {
    this.worker.terminate();
    for (const resolve of this.pending.values()) resolve(null);
    this.pending.clear();
  }
}
