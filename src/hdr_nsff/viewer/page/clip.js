// The HDR video of the clip, for screens whose browser draws no light above white.

import { find } from "./controls.js";

/**
 * A button that plays an HDR video. `files` are the same video in several codecs, of which
 * the first is played that this browser can. Each has a `href`, and as `data` its content in
 * base64, without which a server has it.
 */
export function offerClip(files) {
  const button = document.createElement("button");
  Object.assign(button, { type: "button", id: "clip-button", textContent: files[0].text });
  find("videos").prepend(button);
  const [dialog, video, problem] = ["clip", "clip-video", "clip-problem"].map(find);
  button.onclick = () => {
    dialog.showModal();
    if (!video.src) playFirst(files, video, problem);
    else if (problem.hidden) video.play().catch(() => {});
  };
  dialog.onclose = () => video.pause();
}

/** Play the first of the files that the browser can; else offer to save the very first. */
function playFirst(files, video, problem, next = 0) {
  video.onerror = () => {
    if (next + 1 < files.length) return playFirst(files, video, problem, next + 1);
    problem.hidden = false;
    video.hidden = true;
    const name = decodeURIComponent(files[0].href.split("/").pop());
    Object.assign(find("clip-file"), { href: addressOf(files[0]), download: name });
  };
  video.src = addressOf(files[next]);
  video.play().catch(() => {}); // `onerror` says why
}

function addressOf({ href, data }) {
  if (!data) return href;
  const bytes = Uint8Array.from(atob(data), (letter) => letter.charCodeAt(0));
  return URL.createObjectURL(new Blob([bytes], { type: "video/mp4" }));
}
