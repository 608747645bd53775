// The HDR video of the clip, for screens whose browser draws no light above white.

import { find } from "./controls.js";

/**
 * A button that plays an HDR video; `link` names it, and `data` is its file as base64
 * text, without which a server has it.
 */
export function offerClip(link, data) {
  const button = document.createElement("button");
  Object.assign(button, { type: "button", id: "clip-button", textContent: link.text });
  find("videos").prepend(button);
  const [dialog, video, problem] = ["clip", "clip-video", "clip-problem"].map(find);
  button.onclick = () => {
    if (!video.src) {
      video.src = data ? toAddress(data) : link.href;
      const name = decodeURIComponent(link.href.split("/").pop());
      Object.assign(find("clip-file"), { href: video.src, download: name });
    }
    dialog.showModal();
    if (problem.hidden) video.play().catch(() => {}); // `onerror` says why
  };
  video.onerror = () => {
    problem.hidden = false;
    video.hidden = true;
  };
  dialog.onclose = () => video.pause();
}

function toAddress(base64) {
  const bytes = Uint8Array.from(atob(base64), (letter) => letter.charCodeAt(0));
  return URL.createObjectURL(new Blob([bytes], { type: "video/mp4" }));
}
