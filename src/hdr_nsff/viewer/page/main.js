// Opens the scene of this page and starts the viewer.

import { readScene, unpack } from "./format.js";
import { Renderer, driverName, openContext } from "./renderer.js";
import { offerVideo } from "./clip.js";
import { hasHighRange, openHdrScreen } from "./hdr.js";
import { Player } from "./player.js";
import { Frames } from "./frames.js";
import { connectControls, find, note, offerExtended, withdrawExtended } from "./controls.js";

const WORKER = "sorter.js";
const FOLLOW_MILLISECONDS = 5000; // between two looks at the version of the scene
const MAX_FAILURES = 3; // of such looks in a row: then the server has stopped
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
  // asked first: the scene is of this version, or of a newer one
  const version = settings.server ? await fetchVersion() : null;
  const scene = await loadScene();
  const player = new Player(scene, find("canvas"));
  globalThis.viewer = player; // for scripts and tests
  connectControls(player);
  showVideos(settings);
  if (scene.groups.length) await draw(player, settings);
  else showFrames(player, settings);
  if (player.renderer) await player.renderer.sort(player.view());
  if (hasHighRange() && !player.hdr) explainRange(settings);
  find("loading").hidden = true;
  const loop = (now) => {
    player.tick(now);
    if (player.state.stats) showStats(player);
    if (player.renderer) helpSlowDrawing(player, settings);
    requestAnimationFrame(loop);
  };
  requestAnimationFrame(loop);
  if (settings.server) followVersion(player, version);
  document.body.dataset.ready = "yes";
}

/** Draw in this browser, if it can; else have the server render. */
async function draw(player, settings) {
  const gpuWanted = location.hash === "#draw"; // to see what a browser without a GPU does
  try {
    const gl = openContext(player.canvas);
    player.driver = driverName(gl);
    const software = SOFTWARE.test(player.driver);
    if (software && settings.server && !gpuWanted) return showFrames(player, settings);
    player.renderer = new Renderer(gl, player.scene, shaderSources(), held(WORKER));
    player.canvas.addEventListener("webglcontextlost", () =>
      note("The graphics driver was reset. Reload the page.", 0),
    );
    if (player.renderer.readsHalves()) player.hdr = await openHdrScreen(find("hdr"));
    if (player.hdr) offerExtended(player);
    if (software)
      note(`This browser draws without a GPU, so playback is slow.${videoAdvice(settings)}`, 8);
    player.advised = software;
  } catch (error) {
    if (!settings.server) throw new Error(error.message + videoAdvice(settings));
    showFrames(player, settings);
  }
}

/** Where drawing is slow: fewer pixels, frames of the server, or the videos. */
function helpSlowDrawing(player, settings) {
  if (settings.server && player.isSlow()) return showFrames(player, settings);
  if (player.easeOff() || player.advised || !player.isSlow()) return;
  note(`This browser draws slowly here.${videoAdvice(settings)}`, 8);
  player.advised = true;
}

/** Which videos play smoothly: first the one inside the page, which is always there. */
function videoAdvice({ videos, server }) {
  if (!videos.length) return "";
  const inside = videos.find(({ href }) => held(href));
  const others = videos.filter((video) => video !== inside);
  const first = inside
    ? ` “${inside.text}” below the settings plays smoothly.`
    : " The videos below the settings play smoothly.";
  if (server || !others.length) return first;
  return `${first} ${inside ? "The others" : "They"} lie ${placeOf(others)}.`;
}

/** Where files lie that a page links to. */
function placeOf(links) {
  const folders = new Set(links.map(({ href }) => decodeURIComponent(href.replace(/[^/]*$/, ""))));
  const named = [...folders].filter(Boolean).join(", ");
  return `${named && `in ${named} `}beside this page`;
}

function shaderSources() {
  const names = ["splat.vert", "splat.frag", "picture.vert", "develop.frag"];
  return Object.fromEntries(names.map((name) => [name, held(name)]));
}

/** From now on, frames that the server renders. */
function showFrames(player, settings) {
  player.renderer?.dispose();
  player.renderer = null;
  player.hdr?.hide();
  player.hdr = null;
  withdrawExtended(player);
  player.frames = new Frames(find("frame"), player.scene.width, settings, note);
  player.touch();
}

/** The version of the server's scene. */
async function fetchVersion() {
  const response = await fetch("version");
  if (!response.ok) throw new Error(`The server has no scene (${response.status}).`);
  return response.text();
}

/** Load the scene again whenever the server has a newer one: a run that is training. */
async function followVersion(player, version) {
  for (let failures = 0; failures < MAX_FAILURES; ) {
    await new Promise((done) => setTimeout(done, FOLLOW_MILLISECONDS));
    try {
      const found = await fetchVersion();
      if (found !== version) await player.replace(await loadScene());
      version = found;
      failures = 0;
    } catch {
      failures++; // the scene of before is here already
    }
  }
}

/** Buttons for videos that play here, and links to those that lie beside the page. */
function showVideos({ videos, hdr_clips: clips, server }) {
  const files = clips.map((clip) => ({ ...clip, data: held(clip.href) }));
  const played = files.length && (files[0].data || server); // else a file beside the page
  if (played) offerVideo("clip-button", files);
  for (const { href, text } of played ? videos : [...clips, ...videos]) {
    const data = held(href);
    if (data) offerVideo("video-button", [{ href, text, data }]);
    else addLink(href, text, server);
  }
}

function addLink(href, text, server) {
  const link = document.createElement("a");
  const title = server ? "" : `Lies ${placeOf([{ href }])}`;
  Object.assign(link, { href, textContent: text, target: "_blank", title });
  find("videos").append(link);
}

/** On an HDR screen: what shows the light that this page does not draw. */
function explainRange({ hdr_clips: clips }) {
  find("range-note").textContent = clips.length
    ? "Drawn here, light ends at white. The HDR clip shows it on this screen."
    : "Drawn here, light ends at white. For this screen, make an HDR clip: " +
      "hdr-nsff render RUN --path training --hdr-video hlg";
  find("range-note").hidden = false;
}

function showStats(player) {
  const { renderer, frames, canvas } = player;
  const thousands = (count) => count.toLocaleString("en");
  const rate = player.framesPerSecond();
  const speed = rate === null ? "At rest" : `${rate.toFixed(rate < 10 ? 1 : 0)} frames/s`;
  const lines = renderer
    ? [
        `${speed}, ${canvas.width} × ${canvas.height}`,
        `${thousands(renderer.visible)} of ${thousands(renderer.count)} Gaussians`,
        `sorted in ${(renderer.sortMilliseconds ?? 0).toFixed(1)} ms`,
      ]
    : [
        `${thousands(frames.shown)} frames from the server`,
        `${thousands(Math.round(frames.rate))} pixels/s`,
      ];
  find("stats").textContent = [...lines, player.driver ?? ""].join("\n");
}

start().catch((error) => {
  find("loading").textContent = error.message;
  find("loading").hidden = false;
  document.body.dataset.ready = "no";
  throw error;
});
