// The orbit video: rendered by the server on demand, played here, and saved.

import { request, whole } from "../api.js";
import { h } from "../dom.js";
import { noticeOf } from "../shell.js";

/** @import {Shown} from "../model.js" */

const SIZES = { "640 x 480": [640, 480], "960 x 720": [960, 720], "1280 x 720": [1280, 720] };

/**
 * @param {HTMLElement} section
 * @param {Shown} shown
 */
export function showOrbit(section, { model, address, background }) {
  const size = h("select", { id: "orbit-size" }, Object.keys(SIZES).map((name) => h("option", {}, name)));
  const length = h("select", { id: "orbit-length" }, [4, 6, 10].map((seconds) => h("option", { value: seconds }, `${seconds} seconds`)));
  const make = h("button", { type: "button", onclick: start }, "Make the video");
  const stop = h("button", { type: "button", class: "quiet", hidden: true, onclick: () => running?.abort() }, "Stop");
  const state = h("p", { class: "hint", role: "status" });
  const place = h("div");
  /** @type {AbortController | null} */
  let running = null;
  let shownUrl = "";

  async function start() {
    running = new AbortController();
    make.disabled = true;
    stop.hidden = false;
    place.replaceChildren();
    const [width, height] = SIZES[/** @type {keyof typeof SIZES} */ (size.value)];
    state.textContent = `Rendering ${24 * Number(length.value)} frames. Without a GPU on the server this takes minutes.`;
    try {
      const answer = await request("POST", `${address}/orbit`, {
        json: { seconds: Number(length.value), width, height, background }, signal: running.signal,
      });
      URL.revokeObjectURL(shownUrl);
      shownUrl = URL.createObjectURL(await whole(answer.blob()));
      place.append(
        h("video", { src: shownUrl, controls: true, loop: true, playsinline: true, "aria-label": "Video that circles the scene" }),
        h("p", {}, h("a", { href: shownUrl, download: `${model.name || model.id}-orbit.mp4` }, "Save the video")));
      state.textContent = "";
    } catch (error) {
      state.textContent = running.signal.aborted ? "Stopped." : "";
      if (!running.signal.aborted) place.append(noticeOf(/** @type {Error} */ (error)));
    } finally {
      make.disabled = false;
      stop.hidden = true;
    }
  }

  section.append(h("h2", { id: "orbit-title" }, "Orbit video"),
    h("p", { class: "muted" }, "The camera circles the scene once, as high and as far away as the photos were taken."),
    h("div", { class: "row" },
      h("div", { class: "field" }, h("label", { for: "orbit-size" }, "Size"), size),
      h("div", { class: "field" }, h("label", { for: "orbit-length" }, "Length"), length)),
    h("div", { class: "row" }, make, stop), state, place);
}
