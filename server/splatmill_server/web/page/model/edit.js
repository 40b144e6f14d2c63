// Cropping and cleaning: a box drawn in the view, a least opacity, a largest size. The server measures what an edit does on
// the held-out photos, and makes a new model of what is left; this one is kept.

import { send } from "../api.js";
import { h, toggle } from "../dom.js";
import { number } from "../format.js";
import { noticeOf } from "../shell.js";
import { LOADING } from "../viewer/errors.js";

/**
 * @import {Stage} from "./stage.js"
 * @import {View} from "../viewer.js"
 * @import {Vec} from "../viewer/pose.js"
 */

const AXES = ["x", "y", "z"];
/** Steps of a slider of the box, from one end of its range to the other. */
const STEPS = 200;
/** Half the range of the box around the point that the photos look at, over the farthest camera's distance from the mean. */
const REACH = 3;

export class Edit {
  /** @param {Stage} stage */
  constructor(stage) {
    this.stage = stage;
    /** @type {View | null} */
    this.view = null;
    this.on = false;
    this.button = toggle("Crop and clean", (on) => this.turn(on));
    this.crop = h("input", { type: "checkbox", id: "edit-crop", checked: true, onchange: () => this.draw() });
    /** The sliders of min and max along each axis. */
    this.ends = AXES.map((axis) => ["from", "to"].map((end) => h("input", {
      type: "range", min: 0, max: STEPS, value: end === "from" ? (3 * STEPS) / 8 : (5 * STEPS) / 8,
      "aria-label": `The box along ${axis}, ${end}`, oninput: () => this.draw(),
    })));
    this.opacity = h("input", { id: "edit-opacity", type: "number", min: 0, max: 0.99, step: 0.01, value: 0, class: "narrow-field" });
    this.size = h("input", { id: "edit-size", type: "number", min: 0, step: "any", placeholder: "no limit", class: "narrow-field" });
    this.state = h("div", { role: "status" });
    this.measureButton = h("button", { type: "button", onclick: () => void this.run(true) }, "Measure what it does");
    this.makeButton = h("button", { type: "submit", class: "primary" }, "Make a new model");
    this.panel = h("form", { class: "panel card", novalidate: true, hidden: true, "aria-label": "Crop and clean", onsubmit: (/** @type {Event} */ event) => {
      event.preventDefault();
      void this.run(false);
    } },
      h("h2", {}, "Crop and clean"),
      h("div", { class: "row" }, this.crop, h("label", { for: "edit-crop" }, "Keep only what lies in the box")),
      h("div", { class: "box-ends" }, AXES.map((axis, i) => h("fieldset", {}, h("legend", {}, axis), this.ends[i]))),
      h("div", { class: "row" },
        h("div", { class: "field" }, h("label", { for: "edit-opacity" }, "Least opacity"), this.opacity),
        h("div", { class: "field" }, h("label", { for: "edit-size" }, "Largest size, in units"), this.size)),
      h("div", { class: "row" }, this.measureButton, this.makeButton),
      this.state,
      h("p", { class: "hint" }, "This model is kept. The error is measured on up to 16 held-out photos, which show what lies outside of a box, so a crop raises it."));
  }

  /** @param {View} view */
  attach(view) {
    this.view = view;
    this.draw();
  }

  /** @param {boolean} on */
  turn(on) {
    this.on = on;
    this.panel.hidden = !on;
    this.draw();
  }

  /** The box in the coordinates of the model. */
  get box() {
    const { focus, spread } = /** @type {View} */ (this.view);
    const at = (/** @type {number} */ axis, /** @type {number} */ end) =>
      focus[axis] + REACH * spread * ((2 * Number(this.ends[axis][end].value)) / STEPS - 1);
    const ends = [0, 1, 2].map((axis) => [at(axis, 0), at(axis, 1)].sort((a, b) => a - b));
    return { min: /** @type {Vec} */ (ends.map((end) => end[0])), max: /** @type {Vec} */ (ends.map((end) => end[1])) };
  }

  draw() {
    this.view?.mark({ box: this.on && this.crop.checked ? this.box : null });
  }

  /** Why there is nothing to ask the server for, a sentence; it leads to the field that is to be changed. */
  problem() {
    if (!this.view) return LOADING;
    const wrong = [this.opacity, this.size].find((field) => !field.checkValidity());
    for (const field of [this.opacity, this.size]) field.setAttribute("aria-invalid", String(field === wrong));
    wrong?.focus();
    if (wrong === this.opacity) return "The least opacity is a number from 0 to 0.99.";
    if (wrong) return "The largest size is a number over 0, or left empty.";
    if (this.crop.checked || Number(this.opacity.value) > 0 || Number(this.size.value) > 0) return "";
    this.crop.focus();
    return "Nothing would change: keep only the box, or give a least opacity or a largest size.";
  }

  /** Ask the server for the edit. @param {boolean} preview */
  async run(preview) {
    const problem = this.problem();
    if (problem) {
      this.state.replaceChildren(h("p", { class: "error" }, problem));
      return;
    }
    const edit = {
      ...(this.crop.checked ? { box: this.box } : {}),
      ...(Number(this.opacity.value) > 0 ? { min_opacity: Number(this.opacity.value) } : {}),
      ...(Number(this.size.value) > 0 ? { max_size: Number(this.size.value) } : {}),
      preview,
    };
    this.measureButton.disabled = this.makeButton.disabled = true;
    this.state.replaceChildren(h("p", { class: "hint" }, "The server renders the held-out photos before and after."));
    try {
      const done = await send("POST", `${this.stage.shown.address}/edits`, edit);
      this.state.replaceChildren(h("p", { class: "number" }, said(done)),
        done.model ? h("p", {}, h("a", { href: `/models/${encodeURIComponent(done.model)}` }, "Open the new model")) : "");
    } catch (error) {
      this.state.replaceChildren(noticeOf(/** @type {Error} */ (error)));
    } finally {
      this.measureButton.disabled = this.makeButton.disabled = false;
    }
  }
}

/** @param {any} done the answer of the server */
function said(done) {
  const gone = done.gaussians_before - done.gaussians;
  const error = done.psnr === null ? "there are no photos to measure it on"
    : `${done.psnr_before.toFixed(2)} dB before, ${done.psnr.toFixed(2)} dB after`;
  return `${number(gone)} of ${number(done.gaussians_before)} Gaussians ${done.model ? "are left out" : "would be left out"}: ${error}.`;
}
