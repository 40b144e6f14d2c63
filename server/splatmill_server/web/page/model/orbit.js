// Videos on a circle or on a camera path: rendered by the server in the background, kept with the model, played here, and saved.

import { h } from "../dom.js";
import { bytes } from "../format.js";
import { keptOf } from "./kept.js";

/**
 * @import {Shown} from "./model.js"
 * @import {Stage} from "./stage.js"
 */

const SIZES = {
  "640 x 480": [640, 480], "960 x 720": [960, 720], "1280 x 720": [1280, 720], "1920 x 1080": [1920, 1080], "1080 x 1920": [1080, 1920],
};

/**
 * @param {HTMLElement} section
 * @param {Shown} shown
 * @param {Stage} stage
 */
export async function showOrbit(section, { model, address, background }, stage) {
  const way = h("select", { id: "orbit-way" }, h("option", { value: "circle" }, "circles the scene"), h("option", { value: "path" }, "follows the camera path"));
  const size = h("select", { id: "orbit-size" }, Object.keys(SIZES).map((name) => h("option", {}, name)));
  const length = h("input", { id: "orbit-length", type: "number", min: 0.5, max: 60, step: "any", value: 6, class: "narrow-field" });
  const make = h("button", { type: "button", onclick: start }, "Make the video");
  const bar = h("progress", { hidden: true, "aria-label": "Frames rendered" });
  const { stop, state, place, kept, begin, open } = keptOf(address, "orbits", make, {
    progress: ({ frames, frames_done }) => {
      bar.hidden = false;
      bar.max = frames;
      bar.value = frames_done;
      return `${frames_done} of ${frames} frames are rendered. The server continues if this page is closed.`;
    },
    failure: ({ detail }) => detail,
    entry: (orbit) => {
      const { width, height, seconds } = orbit.request;
      const name = `${orbit.request.camera_path ? "camera path" : "circle"}, ${width} x ${height}, ${seconds} seconds, ${bytes(orbit.bytes)}`;
      return { name: `the video ${name}`, use: h("button", { type: "button", class: "quiet", onclick: () => play(orbit) }, `Play ${name}`) };
    },
    whole: play,
    over: () => { bar.hidden = true; },
  });

  async function start() {
    const [width, height] = SIZES[/** @type {keyof typeof SIZES} */ (size.value)];
    place.replaceChildren();
    const path = way.value === "path" ? stage.path.path : null;
    if (way.value === "path" && !path) {
      state.textContent = "There is no camera path yet: add two views to it at least, with Camera path above.";
      stage.path.button.focus();
      return;
    }
    const possible = length.checkValidity() && length.value !== "";
    length.setAttribute("aria-invalid", String(!possible));
    if (!possible) {
      state.textContent = "A video has 0.5 to 60 seconds.";
      length.focus();
      return;
    }
    await begin({ seconds: Number(length.value), width, height, background, ...(path ? { camera_path: path } : {}) });
  }

  /** @param {any} orbit */
  function play(orbit) {
    place.replaceChildren(
      h("video", { src: orbit.links.video, controls: true, loop: true, playsinline: true, "aria-label": orbit.request.camera_path ? "Video of the camera path" : "Video that circles the scene" }),
      h("p", {}, h("a", { href: orbit.links.video, download: `${model.name || model.id}-${orbit.request.camera_path ? "path" : "orbit"}.mp4` }, "Save the video")));
  }

  section.append(h("h2", { id: "orbit-title" }, "Video"),
    h("p", { class: "muted" }, "A circle is as high and as far away as the photos were taken. A camera path leads through views that you choose."),
    h("div", { class: "row" },
      h("div", { class: "field" }, h("label", { for: "orbit-way" }, "The camera"), way),
      h("div", { class: "field" }, h("label", { for: "orbit-size" }, "Size"), size),
      h("div", { class: "field" }, h("label", { for: "orbit-length" }, "Length, in seconds"), length)),
    h("div", { class: "row" }, make, stop), bar, state, place, kept);
  await open();
}
