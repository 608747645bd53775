// Opens the scene of this page and starts the viewer.

import { readScene, unpack } from "./format.js";
import { Renderer, driverName, openContext } from "./renderer.js";
import { Player } from "./player.js";
import { connectControls, find, note } from "./controls.js";

const SOFTWARE = /swiftshader|llvmpipe|softpipe|software|basic render/i;

/** The page's settings, or the text of a source file that the page holds. */
function held(id) {
  return document.getElementById(id)?.textContent;
}

async function loadScene() {
  const text = held("scene");
  if (text) return readScene(await unpack(text));
  const response = await fetch("scene.hdr4d");
  if (!response.ok) throw new Error(`The server has no scene (${response.status}).`);
  return readScene(await response.arrayBuffer());
}

async function start() {
  const settings = JSON.parse(held("settings"));
  const scene = await loadScene();
  const player = new Player(scene, find("canvas"));
  globalThis.viewer = player; // for scripts and tests
  connectControls(player);
  showVideos(settings.videos ?? []);
  const gl = openContext(player.canvas);
  const names = ["splat.vert", "splat.frag", "picture.vert", "develop.frag"];
  const shaders = Object.fromEntries(names.map((name) => [name, held(name)]));
  player.renderer = new Renderer(gl, scene, shaders, held("sorter.js"));
  player.driver = driverName(gl);
  player.software = SOFTWARE.test(player.driver);
  if (player.software) note("This browser draws without a GPU, so playback is slow.");
  find("loading").hidden = true;
  await player.renderer.sort(player.view());
  const loop = (now) => {
    player.tick(now);
    if (player.state.stats) showStats(player);
    requestAnimationFrame(loop);
  };
  requestAnimationFrame(loop);
  document.body.dataset.ready = "yes";
}

function showVideos(videos) {
  for (const { href, text } of videos) {
    const link = document.createElement("a");
    Object.assign(link, { href, textContent: text, target: "_blank" });
    find("videos").append(link);
  }
}

function showStats(player) {
  const { renderer, canvas } = player;
  const thousands = (count) => count.toLocaleString("en");
  find("stats").textContent = [
    `${player.framesPerSecond().toFixed(0)} frames/s at ${canvas.width} × ${canvas.height}`,
    `${thousands(renderer.visible)} of ${thousands(renderer.count)} Gaussians`,
    `sorted in ${(renderer.sortMilliseconds ?? 0).toFixed(1)} ms`,
    player.driver,
  ].join("\n");
}

start().catch((error) => {
  find("loading").textContent = error.message;
  find("loading").hidden = false;
  document.body.dataset.ready = "no";
  throw error;
});
