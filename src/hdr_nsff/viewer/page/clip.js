// Videos of the clip that the page plays itself: in HDR, for screens whose browser draws no
// light above white, and in 8 bits, for browsers that draw slowly.

import { find } from "./controls.js";

let offered = null; // the files of the video that the dialog shows

/**
 * A button that plays a video. `files` are the same video in several codecs, of which the
 * first is played that this browser can. Each has a `text`, a `href`, and as `data` its
 * content in base64, without which a server has it.
 */
export function offerVideo(id, files) {
  const button = document.createElement("button");
  const { text } = files[0];
  Object.assign(button, { type: "button", id, textContent: text });
  find("videos").append(button);
  const [dialog, video, problem] = ["clip", "clip-video", "clip-problem"].map(find);
  button.onclick = () => {
    dialog.ariaLabel = text;
    dialog.showModal();
    if (offered !== files) playFirst(files, video, problem);
    else if (problem.hidden) video.play().catch(() => {});
    offered = files;
  };
  dialog.onclose = () => video.pause();
}

/** Play the first of the files that the browser can; else offer to save the very first. */
function playFirst(files, video, problem, next = 0) {
  problem.hidden = true;
  video.hidden = false;
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
