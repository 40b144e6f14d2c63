// Orbit videos: rendered by the server in the background, kept with the model, played here, and saved.

import { get, request, send } from "../api.js";
import { h } from "../dom.js";
import { bytes } from "../format.js";
import { noticeOf } from "../shell.js";

/** @import {Shown} from "./model.js" */

const SIZES = { "640 x 480": [640, 480], "960 x 720": [960, 720], "1280 x 720": [1280, 720] };

/** Milliseconds between two looks how far a video is. */
const LOOK_MS = 500;

/**
 * @param {HTMLElement} section
 * @param {Shown} shown
 */
export async function showOrbit(section, { model, address, background }) {
  const size = h("select", { id: "orbit-size" }, Object.keys(SIZES).map((name) => h("option", {}, name)));
  const length = h("select", { id: "orbit-length" }, [4, 6, 10].map((seconds) => h("option", { value: seconds }, `${seconds} seconds`)));
  const make = h("button", { type: "button", onclick: start }, "Make the video");
  const stop = h("button", { type: "button", class: "quiet", hidden: true }, "Stop");
  const state = h("p", { class: "hint", role: "status" });
  const bar = h("progress", { hidden: true, "aria-label": "Frames rendered" });
  const place = h("div");
  const kept = h("ul", { class: "kept" });

  async function start() {
    const [width, height] = SIZES[/** @type {keyof typeof SIZES} */ (size.value)];
    make.disabled = true;
    place.replaceChildren();
    try {
      await follow(await send("POST", `${address}/orbits`, { seconds: Number(length.value), width, height, background }));
    } catch (error) {
      place.append(noticeOf(/** @type {Error} */ (error)));
    } finally {
      make.disabled = false;
    }
  }

  /** Show how far a video is until it is whole, and then the video. @param {any} orbit */
  async function follow(orbit) {
    const stopping = new AbortController();
    stop.onclick = async () => {
      stopping.abort(); // a question under way could come after the deletion
      try {
        await request("DELETE", orbit.links.self);
      } catch (error) {
        place.append(noticeOf(/** @type {Error} */ (error)));
      }
    };
    make.disabled = true;
    stop.hidden = bar.hidden = false;
    try {
      while (!stopping.signal.aborted && !["succeeded", "failed"].includes(orbit.state)) {
        bar.max = orbit.frames;
        bar.value = orbit.frames_done;
        state.textContent = `${orbit.frames_done} of ${orbit.frames} frames are rendered. The server continues if this page is closed.`;
        await new Promise((resolve) => setTimeout(resolve, LOOK_MS));
        if (!stopping.signal.aborted) orbit = await get(orbit.links.self, {}, stopping.signal);
      }
      const stopped = stopping.signal.aborted;
      state.textContent = stopped ? "Stopped." : orbit.state === "failed" ? orbit.problem.detail : "";
      if (!stopped && orbit.state === "succeeded") {
        play(orbit);
        await list();
      }
    } catch (error) {
      state.textContent = stopping.signal.aborted ? "Stopped." : "";
      if (!stopping.signal.aborted) throw error;
    } finally {
      make.disabled = false;
      stop.hidden = bar.hidden = true;
    }
  }

  /** @param {any} orbit */
  function play(orbit) {
    place.replaceChildren(
      h("video", { src: orbit.links.video, controls: true, loop: true, playsinline: true, "aria-label": "Video that circles the scene" }),
      h("p", {}, h("a", { href: orbit.links.video, download: `${model.name || model.id}-orbit.mp4` }, "Save the video")));
  }

  /** List the videos that are kept, and return those that are not whole yet. */
  async function list() {
    /** @type {any[]} */
    const orbits = (await get(`${address}/orbits`)).orbits;
    kept.replaceChildren(...orbits.filter(({ state }) => state === "succeeded").map((orbit) => {
      const { width, height, seconds } = orbit.request;
      const name = `${width} x ${height}, ${seconds} seconds, ${bytes(orbit.bytes)}`;
      return h("li", {},
        h("button", { type: "button", class: "quiet", onclick: () => play(orbit) }, `Play ${name}`),
        h("button", { type: "button", class: "quiet", "aria-label": `Delete the video ${name}`, onclick: () => remove(orbit) }, "Delete"));
    }));
    return orbits.filter(({ state }) => state === "queued" || state === "running");
  }

  /** @param {any} orbit */
  async function remove(orbit) {
    try {
      await request("DELETE", orbit.links.self);
      place.replaceChildren();
      await list();
    } catch (error) {
      place.append(noticeOf(/** @type {Error} */ (error)));
    }
  }

  section.append(h("h2", { id: "orbit-title" }, "Orbit video"),
    h("p", { class: "muted" }, "The camera circles the scene once, as high and as far away as the photos were taken."),
    h("div", { class: "row" },
      h("div", { class: "field" }, h("label", { for: "orbit-size" }, "Size"), size),
      h("div", { class: "field" }, h("label", { for: "orbit-length" }, "Length"), length)),
    h("div", { class: "row" }, make, stop), bar, state, place, kept);
  try {
    const [unfinished] = await list();
    if (unfinished) await follow(unfinished);
  } catch (error) {
    place.append(noticeOf(/** @type {Error} */ (error)));
  }
}
