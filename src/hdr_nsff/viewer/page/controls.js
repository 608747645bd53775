// What people touch: buttons, sliders, keys, the pointer on the picture.

import { CURVES, EXTENDED } from "./curves.js";
import { MODES, followed } from "./cameras.js";
import { VIEWS } from "./renderer.js";

const NO_PARALLAX = {
  rotation:
    "The camera of this clip only turned. " +
    "Without parallax there is no depth, so the view stays where it was filmed.",
  none:
    "The camera of this clip stood still. " +
    "Without parallax there is no depth, so the view stays where it was filmed.",
};
// of false color: stops from mid gray and colors, as in develop.frag
const BANDS = [
  ["<−6", "#29004d"],
  ["−6", "#1a40bf"],
  ["−4", "#1a99cc"],
  ["−2", "#597366"],
  ["0", "#59bf4d"],
  ["+½", "#bfb899"],
  ["+2", "#fad933"],
  ["+4", "#f2801a"],
  [">6", "#e61a1a"],
];
const PLAY = "M7 4v16l13-8z",
  PAUSE = "M6 4h4v16H6zm8 0h4v16h-4z";
const NOTE_SECONDS = 4;
const WHEEL_STEP = 0.0006; // near distances per unit of scrolling
const FLY_KEYS = ["w", "a", "s", "d", "q", "e"];

export function connectControls(player) {
  fillChoices(player);
  connectInputs(player);
  connectTimeline(player);
  connectPointer(player);
  connectDivider(player);
  connectKeyboard(player);
  const refresh = () => show(player);
  player.changed = refresh;
  const resize = () => layout(player);
  const sizes = new ResizeObserver(resize);
  for (const element of [find("stage"), document.body]) sizes.observe(element);
  watchDensity(resize);
  resize();
  refresh();
}

/** Offer the curve of HDR screens, and take it, while the window is on such a screen. */
export function offerExtended(player) {
  const label = CURVES.find(({ id }) => id === EXTENDED).label;
  const option = new Option(label, `${EXTENDED} 0`);
  const refresh = () => {
    option.disabled = !player.hdr?.usable;
    if (!option.disabled) player.set({ curve: EXTENDED });
    else if (player.state.curve === EXTENDED) player.set({ curve: "reinhard" });
  };
  find("curve").add(option, 0);
  player.hdr.watch(refresh);
  refresh();
}

/** Frames of a server end at white. */
export function withdrawExtended(player) {
  find("curve").querySelector(`[value^="${EXTENDED}"]`)?.remove();
  if (player.state.curve === EXTENDED) player.set({ curve: "reinhard" });
}

/** A message that goes away after some seconds; 0: it stays. */
export function note(text, seconds = NOTE_SECONDS) {
  const place = find("note");
  place.textContent = text;
  place.hidden = false;
  clearTimeout(note.timer);
  if (seconds) note.timer = setTimeout(() => (place.hidden = true), 1000 * seconds);
}

export function find(id) {
  return document.getElementById(id);
}

function fillChoices(player) {
  const { scene } = player;
  const many = scene.responses.length > 1;
  for (const { id, label } of CURVES) {
    if (id === EXTENDED) continue; // offered where the screen can show it
    if (id !== "camera" || !many) find("curve").add(new Option(label, `${id} 0`));
    else
      scene.responses.forEach((_, k) =>
        find("curve").add(new Option(`${label} ${k}`, `camera ${k}`)),
      );
  }
  const exposures = [...scene.exposures].sort((a, b) => a - b);
  const labeled = new Map(exposures.map((ev) => [stops(Math.round(10 * ev) / 10), ev]));
  for (const [text, ev] of labeled) {
    const button = document.createElement("button");
    button.type = "button";
    button.textContent = text;
    button.title = "As this exposure of the clip was recorded";
    button.onclick = () => player.set({ ev, curve: "camera" });
    find("brackets").append(button);
  }
  for (const [label, color] of BANDS) {
    const band = document.createElement("span");
    band.textContent = label;
    band.style.background = color;
    find("legend").append(band);
  }
  if (!player.free) {
    for (const mode of ["orbit", "fly"])
      document.querySelector(`[data-mode="${mode}"]`).disabled = true;
    find("camera-note").textContent = NO_PARALLAX[scene.parallax] ?? NO_PARALLAX.none;
    find("camera-note").hidden = false;
  }
}

function connectInputs(player) {
  const { state } = player;
  find("ev").oninput = (event) => player.set({ ev: Number(event.target.value) });
  find("ev").ondblclick = () => player.set({ ev: 0 });
  find("curve").onchange = (event) => {
    const [curve, camera] = event.target.value.split(" ");
    player.set({ curve, camera: Number(camera) });
  };
  find("clipping").onchange = (event) => player.set({ clipping: event.target.checked });
  find("false-color").onchange = (event) => player.set({ falseColor: event.target.checked });
  find("show").onchange = (event) => player.set({ show: event.target.value });
  find("split").onchange = (event) => player.set({ split: event.target.checked });
  find("modes").onclick = ({ target }) =>
    target.dataset.mode && player.set({ mode: target.dataset.mode });
  find("add-view").onclick = () => addView(player);
  find("clear-views").onclick = () => player.clearKeys();
  find("copy-path").onclick = () => copyPath(player);
  find("save-8").onclick = () => savePng(player, 8);
  find("save-16").onclick = () => savePng(player, 16);
  find("help-button").onclick = () => find("help").showModal();
  find("stats-button").onclick = () => player.set({ stats: !state.stats });
}

function connectTimeline(player) {
  const slider = find("time");
  [slider.min, slider.max] = [player.first, player.last];
  slider.oninput = () => player.set({ time: Number(slider.value), playing: false });
  find("play").onclick = () => togglePlay(player);
  find("loop").onclick = () => player.set({ loop: !player.state.loop });
  find("speed").onchange = (event) => player.set({ speed: Number(event.target.value) });
}

function togglePlay(player) {
  const { playing, loop, time } = player.state;
  if (!playing && !loop && time >= player.last) player.set({ time: player.first });
  player.set({ playing: !playing });
}

function connectPointer(player) {
  const canvas = find("canvas");
  const fingers = new Map();
  canvas.onpointerdown = (event) => {
    if (event.button !== 0) return; // the menu of a right click takes its release
    canvas.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, [event.clientX, event.clientY]);
  };
  canvas.onpointermove = (event) => {
    if (!(event.buttons & 1)) fingers.delete(event.pointerId); // also beside another button
    const before = fingers.get(event.pointerId);
    if (!before) return;
    const width = canvas.clientWidth;
    const [x, y] = [(event.clientX - before[0]) / width, (event.clientY - before[1]) / width];
    const spread = fingerSpread(fingers);
    fingers.set(event.pointerId, [event.clientX, event.clientY]);
    if (fingers.size === 2) player.move([-x / 2, -y / 2, (fingerSpread(fingers) - spread) / width]);
    else if (event.shiftKey) player.move([-x, -y, 0]);
    else player.turn(x, y);
  };
  canvas.onpointerup = canvas.onpointercancel = (event) => fingers.delete(event.pointerId);
  canvas.addEventListener(
    "wheel",
    (event) => {
      event.preventDefault();
      player.move([0, 0, -WHEEL_STEP * event.deltaY]);
    },
    { passive: false },
  );
}

function fingerSpread(fingers) {
  const [a, b] = [...fingers.values()];
  return b ? Math.hypot(a[0] - b[0], a[1] - b[1]) : 0;
}

function connectDivider(player) {
  const divider = find("divider");
  divider.onpointerdown = (event) =>
    event.button === 0 && divider.setPointerCapture(event.pointerId);
  divider.onpointermove = (event) => {
    if (!event.buttons || !divider.hasPointerCapture(event.pointerId)) return;
    const { left, width } = find("picture").getBoundingClientRect();
    player.set({ splitAt: Math.min(Math.max((event.clientX - left) / width, 0), 1) });
  };
  divider.onkeydown = (event) => {
    const step = { ArrowLeft: -0.05, ArrowRight: 0.05 }[event.key];
    if (!step) return;
    event.stopPropagation();
    player.set({ splitAt: Math.min(Math.max(player.state.splitAt + step, 0), 1) });
  };
}

function connectKeyboard(player) {
  addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || document.querySelector("dialog[open]")) return;
    if (usesKey(event.target, event.key)) return;
    const { state } = player;
    const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
    const ahead = event.shiftKey ? 10 : 1;
    const repeated = event.repeat && !key.startsWith("Arrow"); // of a key that is held down
    const actions = {
      " ": () => togglePlay(player),
      ArrowLeft: () => player.set({ time: state.time - ahead, playing: false }),
      ArrowRight: () => player.set({ time: state.time + ahead, playing: false }),
      ArrowUp: () => player.set({ ev: state.ev + 0.5 }),
      ArrowDown: () => player.set({ ev: state.ev - 0.5 }),
      Home: () => player.set({ time: player.first }),
      End: () => player.set({ time: player.last }),
      "?": () => find("help").showModal(),
      v: () => player.set({ show: after(VIEWS, state.show) }),
      c: () => player.set({ curve: after(offeredCurves(), state.curve) }),
      x: () => player.set({ split: !state.split }),
      r: () => player.resetCamera(),
      k: () => addView(player),
      p: () => savePng(player, event.shiftKey ? 16 : 8),
      l: () => player.set({ loop: !state.loop }),
      i: () => player.set({ stats: !state.stats }),
      h: () => document.body.classList.toggle("bare"),
    };
    MODES.forEach((mode, i) => (actions[i + 1] = () => player.set({ mode })));
    if (FLY_KEYS.includes(key) && player.free) actions[key] = () => fly(player, key);
    if (!actions[key]) return;
    if (!repeated) actions[key]();
    event.preventDefault();
  });
  // after a click, keys are for the player again
  addEventListener("click", ({ detail, target }) => {
    if (detail > 0) target.closest("button, label, input[type=checkbox]")?.blur();
  });
  let byPointer = false;
  addEventListener("pointerdown", () => (byPointer = true), true);
  addEventListener("keydown", () => (byPointer = false), true);
  addEventListener(
    "change",
    ({ target }) => byPointer && target.matches("select") && target.blur(),
  );
  addEventListener("keyup", (event) => player.held.delete(event.key.toLowerCase()));
  // a Mac hides the release of a letter beside Command, and names it otherwise beside Option
  addEventListener("keydown", ({ key }) => {
    if (key === "Meta" || key === "Alt") player.held.clear();
  });
  addEventListener("blur", () => player.held.clear());
}

function fly(player, key) {
  if (player.state.mode !== "fly") player.set({ mode: "fly" });
  player.held.add(key);
}

/** Whether an element does something with a key itself. */
function usesKey(element, key) {
  if (element.matches("select")) return true;
  if (element.id === "time") return false; // as elsewhere: frame by frame
  if (element.matches('input[type="range"]'))
    return key.startsWith("Arrow") || key === "Home" || key === "End";
  return key === " " && element.matches("button, a, input");
}

/** The curves that can be chosen now. */
function offeredCurves() {
  const options = [...find("curve").options].filter((option) => !option.disabled);
  return [...new Set(options.map((option) => option.value.split(" ")[0]))];
}

function after(list, value) {
  return list[(list.indexOf(value) + 1) % list.length];
}

function addView(player) {
  player.addKey();
  const count = player.keys.length;
  note(
    count === 1
      ? "One view in the camera path. Add another."
      : `${count} views in the camera path.`,
  );
}

async function copyPath(player) {
  const path = player.cameraPath();
  const text = JSON.stringify(path);
  try {
    await navigator.clipboard.writeText(text);
  } catch {
    // where a page may not use the clipboard
    if (!copyBySelection(text)) return note("This browser did not let the page copy the path.");
  }
  const views = path.length === 1 ? "one view" : `${path.length} views`;
  const { camera } = player.state;
  const whose = camera > 0 ? ` --camera-id ${camera}` : "";
  const command = `hdr-nsff render RUN --path path.json${whose}`;
  note(`Copied ${views}. Save it as path.json, then: ${command}`, 8);
}

/** Copy a text as people do; false where the browser refuses. */
function copyBySelection(text) {
  const area = document.createElement("textarea");
  area.value = text;
  document.body.append(area);
  area.select();
  const copied = document.execCommand("copy");
  area.remove();
  return copied;
}

async function savePng(player, bits) {
  const { time } = player.state; // playback goes on while the file is made
  const picture = await player.png(bits);
  if (!picture) return; // a note says why
  const link = document.createElement("a");
  link.href = URL.createObjectURL(picture);
  const signal = bits === 16 && player.isBeyondWhite() ? "_pq" : "";
  link.download = `${player.scene.title}_${time.toFixed(2)}${signal}.png`;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
}

/** Bring what is on the page in line with the state. */
function show(player) {
  const { state, scene } = player;
  find("ev").value = state.ev;
  find("ev-value").textContent = `${stops(Math.round(10 * state.ev) / 10)} EV`;
  find("curve").value = state.curve === "camera" ? `camera ${state.camera}` : `${state.curve} 0`;
  find("clipping").checked = state.clipping;
  find("false-color").checked = state.falseColor;
  find("legend").hidden = !state.falseColor;
  find("show").value = state.show;
  find("split").checked = state.split;
  for (const button of find("modes").children)
    button.ariaPressed = String(button.dataset.mode === state.mode);
  find("clear-views").hidden = !player.keys.length;
  find("add-view").textContent = player.keys.length
    ? `Add view (${player.keys.length})`
    : "Add view";
  find("time").value = state.time;
  find("time-value").textContent = `${state.time.toFixed(1)} / ${player.last}`;
  find("play").ariaLabel = state.playing ? "Pause" : "Play";
  find("play-shape").setAttribute("d", state.playing ? PAUSE : PLAY);
  find("speed").value = state.speed;
  find("loop").ariaPressed = String(state.loop);
  find("stats-button").ariaPressed = String(state.stats);
  find("stats").hidden = !state.stats;
  showSplit(player, scene, state);
}

function showSplit(player, scene, state) {
  const on = state.split && scene.recorded?.length > 0;
  for (const id of ["recorded", "divider", "recorded-label", "rendered-label"])
    find(id).hidden = !on;
  if (!on) return;
  const nearest = followed(scene.views).reduce((best, view) =>
    Math.abs(view.time - state.time) < Math.abs(best.time - state.time) ? view : best,
  );
  nearest.address ??= URL.createObjectURL(
    new Blob([scene.recorded.subarray(...nearest.picture)], { type: "image/jpeg" }),
  );
  if (find("recorded").src !== nearest.address) find("recorded").src = nearest.address;
  const percent = 100 * state.splitAt;
  find("recorded").style.clipPath = `inset(0 ${100 - percent}% 0 0)`;
  find("divider").style.left = `${percent}%`;
  find("divider").ariaValueNow = String(Math.round(percent));
  const ev = Math.round(10 * nearest.ev) / 10;
  find("recorded-label").textContent = `Recorded, ${stops(ev)} EV`;
}

/** Call `changed` whenever the window has come to a screen of another pixel density. */
function watchDensity(changed) {
  const here = matchMedia(`(resolution: ${devicePixelRatio}dppx)`);
  const renewed = () => {
    changed();
    watchDensity(changed);
  };
  here.addEventListener("change", renewed, { once: true });
}

function layout(player) {
  const stage = find("stage");
  // above the controls of a narrow window, the stage is as high as its picture, up to a limit
  const height = parseFloat(getComputedStyle(stage).maxHeight) || stage.clientHeight;
  const [width, shownHeight] = player.fit(stage.clientWidth, height);
  find("picture").style.width = `${width}px`;
  find("picture").style.height = `${shownHeight}px`;
}

/** Stops with their sign: +2, −2, 0. */
function stops(ev) {
  const size = Math.abs(ev);
  if (size === 0) return "0";
  return `${ev > 0 ? "+" : "−"}${size}`;
}
