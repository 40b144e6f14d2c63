// Cropping and cleaning: a box drawn in the view, a least opacity, a largest size, a selection. The view shows what is left out; the server
// measures what that does to the held-out photos, and makes a new model of what is left. This one is kept.

import { send } from "../api.js";
import { h, toggle } from "../dom.js";
import { count, number } from "../format.js";
import { noticeOf } from "../shell.js";
import { BoxHandles, boxAround, boxOf } from "../viewer/box_handles.js";
import { LOADING } from "../viewer/errors.js";
import { Selecting } from "./selecting.js";

/**
 * @import {Stage} from "./stage.js"
 * @import {View} from "../viewer.js"
 * @import {Box} from "../viewer/box_handles.js"
 * @import {Vec} from "../viewer/pose.js"
 */

/** The axes of a model, and what is true of them from wherever they are seen, where its frame.json says how they were chosen. */
const AXES = ["x", "y", "z"];
const DIRECTED = ["x, level", "y, downwards", "z, level"];
/** The box is laid around what lies nearer to where the view turns about than the camera does, over its distance. */
const REACH = 0.8;
/** Where the server draws: length of the box over the width or height that is in sight there. */
const SHARE = 0.9;

export class Edit {
  /** @param {Stage} stage */
  constructor(stage) {
    this.stage = stage;
    /** @type {View | null} */
    this.view = null;
    /** @type {BoxHandles | null} */
    this.handles = null;
    this.on = false;
    /** In the coordinates of the model. @type {Box} */
    this.box = { min: [-1, -1, -1], max: [1, 1, 1] };
    this.began = false;
    /** What is chosen, and what was before, to go back to. */
    this.chosen = "";
    /** @type {string[]} */
    this.before = [];
    this.button = toggle("Crop and clean", (on) => this.turn(on));
    const change = () => this.change();
    const legends = stage.shown.model.files.some((/** @type {any} */ file) => file.name === "frame.json") ? DIRECTED : AXES;
    this.crop = h("input", { type: "checkbox", id: "edit-crop", checked: true, onchange: change });
    /** The fields of min and max along each axis. */
    this.ends = AXES.map((axis, i) => ["from", "to"].map((end) => h("input", {
      type: "number", step: "any", class: "narrow-field", "aria-label": `The box along ${axis}, ${end}`, onchange: () => this.typed(i, end),
    })));
    this.opacity = h("input", { id: "edit-opacity", type: "number", min: 0, max: 0.99, step: 0.01, value: 0, class: "narrow-field", oninput: () => this.draw(), onchange: change });
    this.size = h("input", { id: "edit-size", type: "number", min: 0, step: "any", placeholder: "no limit", class: "narrow-field", oninput: () => this.draw(), onchange: change });
    this.sizeLabel = h("label", { for: "edit-size" });
    this.look = h("select", { id: "edit-look", onchange: () => this.draw() },
      h("option", { value: "dimmed" }, "dimmed"), h("option", { value: "hidden" }, "hidden"), h("option", { value: "shown" }, "as ever"));
    this.selecting = new Selecting({
      began: () => {
        // A box that nobody has moved is not what a selection is drawn for.
        if (!this.before.length) this.crop.checked = false;
        change();
      },
      changed: change,
      factor: () => this.factor,
    });
    this.state = h("div", { role: "status" });
    this.undoButton = h("button", { type: "button", class: "quiet", disabled: true, onclick: () => this.undo() }, "Undo");
    this.measureButton = h("button", { type: "button", onclick: () => void this.run(true) }, "Measure what it does");
    this.makeButton = h("button", { type: "submit", class: "primary" }, "Make a new model");
    this.unit = h("p", { class: "hint" });
    this.panel = h("form", { class: "panel card", novalidate: true, hidden: true, "aria-label": "Crop and clean", onsubmit: (/** @type {Event} */ event) => {
      event.preventDefault();
      void this.run(false);
    } },
      h("h2", {}, "Crop and clean"),
      h("div", { class: "row" }, this.crop, h("label", { for: "edit-crop" }, "Keep only what lies in the box, whose sides are moved by the handles in the view")),
      h("div", { class: "box-ends" }, legends.map((legend, i) => h("fieldset", {}, h("legend", {}, legend), h("div", { class: "row" }, this.ends[i][0], "to", this.ends[i][1])))),
      this.unit,
      this.selecting.fieldset,
      h("div", { class: "row" },
        h("div", { class: "field" }, h("label", { for: "edit-opacity" }, "Least opacity, 0 to 0.99"), this.opacity),
        h("div", { class: "field" }, this.sizeLabel, this.size),
        h("div", { class: "field" }, h("label", { for: "edit-look" }, "What is left out is"), this.look)),
      h("p", { class: "hint" }, "This model is kept. What opacity and size do is measured on up to 16 held-out photos. They show what a box or a selection leaves out, so they do not measure the quality of a crop."),
      h("div", { class: "foot" }, this.state, h("div", { class: "row" }, this.measureButton, this.makeButton, this.undoButton)));
  }

  /** @param {View} view */
  attach(view) {
    this.view = view;
    if (!this.began) this.fit(view);
    this.began = true;
    this.handles?.dispose();
    this.handles = new BoxHandles(view, (box, done) => {
      this.box = box;
      if (done) this.change();
      else this.draw();
    });
    this.selecting.attach(view);
    this.chosen = this.snapshot();
    this.draw();
  }

  /** Lay the box around what lies before the camera. @param {View} view */
  fit(view) {
    const { width, height } = view.getCamera();
    this.box = (view.points && boxOf(view.points, view.focus, REACH * view.distance)) ?? boxAround(view.focus, SHARE * view.distance * Math.tan(view.fovY / 2) * Math.min(1, width / height));
  }

  /** Show all Gaussians, as what an edit leaves out is judged one by one. @param {View} view */
  async showWhole(view) {
    try {
      await view.loadWhole();
    } catch (error) {
      this.state.replaceChildren(noticeOf(/** @type {Error} */ (error)));
      return;
    }
    if (view !== this.view) return;
    if (!this.before.length) {
      this.fit(view);
      this.chosen = this.snapshot();
    }
    this.selecting.choose(this.selecting.chosen);
  }

  /** @param {boolean} on */
  turn(on) {
    this.on = on;
    this.panel.hidden = !on;
    if (on && this.view?.inParts) void this.showWhole(this.view);
    if (!on) this.selecting.take(null);
    this.draw();
  }

  /** Length in the shown unit of 1 in the model. */
  get factor() {
    return this.stage.presentation.scale?.factor ?? 1;
  }

  snapshot() {
    return JSON.stringify({ box: this.box, crop: this.crop.checked, opacity: this.opacity.value, size: this.size.value, selection: this.selecting.chosen });
  }

  /** Take over what was chosen, and keep what was before it. */
  change() {
    const now = this.snapshot();
    if (this.chosen && now !== this.chosen) this.before.push(this.chosen);
    this.chosen = now;
    this.draw();
  }

  undo() {
    const chosen = this.before.pop();
    if (!chosen) return;
    this.chosen = chosen;
    const { box, crop, opacity, size, selection } = JSON.parse(chosen);
    this.box = box;
    this.crop.checked = crop;
    [this.opacity.value, this.size.value] = [opacity, size];
    this.selecting.choose(selection);
    this.draw();
    if (!this.before.length) this.opacity.focus();
  }

  /** Take over an end of the box as it was typed. @param {number} axis @param {string} end "from" or "to" */
  typed(axis, end) {
    const [field, other] = end === "from" ? this.ends[axis] : [...this.ends[axis]].reverse();
    const value = field.value === "" ? NaN : Number(field.value) / this.factor;
    const [from, to] = end === "from" ? [value, this.box.max[axis]] : [this.box.min[axis], value];
    // As people read them: the other end is shown rounded.
    const valid = Number.isFinite(value) && Number(field.value) !== Number(other.value);
    this.state.replaceChildren(valid ? "" : h("p", { class: "error" }, `Give the box along ${AXES[axis]} as two different numbers.`));
    if (valid) {
      const [min, max] = [/** @type {Vec} */ ([...this.box.min]), /** @type {Vec} */ ([...this.box.max])];
      [min[axis], max[axis]] = [Math.min(from, to), Math.max(from, to)];
      this.box = { min, max };
    }
    this.change();
  }

  draw() {
    const { factor, on, crop } = this;
    const unit = this.stage.presentation.scale?.unit;
    this.handles?.show(on && crop.checked ? this.box : null);
    const text = (/** @type {number} */ value) => String(Number((value * factor).toPrecision(4)));
    this.ends.forEach(([from, to], axis) => {
      [from.value, to.value] = [text(this.box.min[axis]), text(this.box.max[axis])];
      from.disabled = to.disabled = !crop.checked;
    });
    this.unit.textContent = unit ? `Lengths are in ${unit}.` : "Lengths are in units of the model. Measure sets another unit.";
    this.sizeLabel.textContent = `Largest size, in ${unit ?? "units"}`;
    this.selecting.farLabel.textContent = `Only up to a distance, in ${unit ?? "units"}`;
    this.undoButton.disabled = !this.before.length;
    const [opacity, size] = [Number(this.opacity.value) || 0, Number(this.size.value) / factor || 0];
    this.view?.leaveOut(on && this.look.value !== "shown" ? {
      box: crop.checked ? this.box : null, opacity, size: size > 0 ? size : Infinity, hidden: this.look.value === "hidden", mask: this.selecting.mask,
    } : null);
  }

  /** Why there is nothing to ask the server for, a sentence; it leads to the field that is to be changed. */
  problem() {
    if (!this.view) return LOADING;
    const wrong = [this.opacity, this.size].find((field) => !field.checkValidity());
    for (const field of [this.opacity, this.size]) field.setAttribute("aria-invalid", String(field === wrong));
    wrong?.focus();
    if (wrong === this.opacity) return "The least opacity is a number from 0 to 0.99.";
    if (wrong) return "The largest size is a number over 0, or left empty.";
    if (this.crop.checked || Number(this.opacity.value) > 0 || Number(this.size.value) > 0 || this.selecting.request) return "";
    this.crop.focus();
    return "Nothing would change: keep only the box, select something, or give a least opacity or a largest size.";
  }

  /** Ask the server for the edit. @param {boolean} preview */
  async run(preview) {
    const problem = this.problem();
    if (problem) {
      this.state.replaceChildren(h("p", { class: "error" }, problem));
      return;
    }
    const selection = this.selecting.request;
    const edit = {
      ...(selection ? { selection } : {}),
      ...(this.crop.checked ? { box: this.box } : {}),
      ...(Number(this.opacity.value) > 0 ? { min_opacity: Number(this.opacity.value) } : {}),
      ...(Number(this.size.value) > 0 ? { max_size: Number(this.size.value) / this.factor } : {}),
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
  const gone = `${number(done.gaussians_before - done.gaussians)} of ${count(done.gaussians_before, "Gaussian")}`;
  const error = done.psnr === null ? "there are no photos to measure it on"
    : done.crops ? "the photos show what is left out, so they do not measure what is left"
    : `${done.psnr_before.toFixed(2)} dB before, ${done.psnr.toFixed(2)} dB after`;
  return done.model ? `The new model has ${count(done.gaussians, "Gaussian")}, without ${gone}: ${error}.`
    : `${gone} would be left out, and ${number(done.gaussians)} would stay: ${error}.`;
}
