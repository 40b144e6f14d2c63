// The time-lapse: snapshots that the training kept, shown in the viewer one at a time; the camera stays where it is.

import { h } from "../dom.js";
import { number, seconds } from "../format.js";
import { notify } from "../shell.js";

/**
 * @import {Shown} from "./model.js"
 * @import {Stage} from "./stage.js"
 */

/** Milliseconds for which playing shows a snapshot, at least. */
const SHOWN_FOR = 400;

/**
 * The scrubber; null for a model without snapshots.
 * @param {Shown} shown
 * @param {Stage} stage
 */
export function timeLapse({ report, address, model }, stage) {
  const taken = report.time_lapse ?? [];
  if (!taken.length) return null;
  const last = taken.length;
  const slider = h("input", { id: "lapse", type: "range", min: 0, max: last, step: 1, value: last });
  const state = h("output", { class: "number", for: "lapse" });
  const play = h("button", { type: "button", class: "small", onclick: () => void run() }, "Play");
  const note = h("p", { class: "hint", hidden: true }, "Snapshots are shown in the 3D view only.");
  let chosen = last;
  let shown = last;
  let playing = false;
  /** @type {Promise<void> | null} */
  let busy = null;

  const tell = () => {
    const at = taken[chosen];
    state.textContent = at
      ? `after ${seconds(at.seconds)} of training, step ${number(at.step)}: ${number(at.gaussians)} Gaussians`
      : `the finished model: ${number(model.gaussians)} Gaussians`;
    slider.setAttribute("aria-valuetext", state.textContent);
  };

  /** Show the chosen snapshot, and then the one that is chosen by then. */
  async function follow() {
    try {
      while (shown !== chosen) {
        const next = chosen;
        const file = taken[next]?.file;
        await stage.view?.replace(file ? { url: `${address}/files/${file}` } : stage.view.source);
        shown = next;
      }
    } catch (error) {
      playing = false;
      shown = chosen;
      notify(/** @type {Error} */ (error));
    } finally {
      busy = null;
    }
  }

  /** @param {number} index */
  function go(index) {
    chosen = index;
    slider.value = String(index);
    tell();
    busy ??= follow();
    return busy;
  }

  async function run() {
    playing = !playing;
    play.textContent = playing ? "Stop" : "Play";
    for (let index = chosen === last ? 0 : chosen + 1; playing && index <= last; index++) {
      await Promise.all([go(index), new Promise((done) => setTimeout(done, SHOWN_FOR))]);
    }
    playing = false;
    play.textContent = "Play";
  }

  slider.addEventListener("input", () => {
    playing = false;
    void go(Number(slider.value));
  });
  tell();
  const element = h("div", { class: "scrubber" },
    h("div", { class: "row" }, h("label", { for: "lapse" }, "Time-lapse"), state, play), slider, note);
  return {
    element,
    /** @param {boolean} yes */
    available(yes) {
      slider.disabled = play.disabled = !yes;
      note.hidden = yes;
      if (yes && chosen !== last) {
        shown = last; // a view that was opened anew shows the finished model
        void go(chosen);
      }
    },
  };
}
