// Measuring: the distance between two points of the scene, a known distance that gives the scene its scale, and the
// measurements that are kept with the model.

import { h, toggle } from "../dom.js";
import { length, sub } from "../viewer/pose.js";
import { lengthText, measuredLines } from "../viewer/lengths.js";
import { Aim } from "./aim.js";

/**
 * @import {Stage} from "./stage.js"
 * @import {Vec} from "../viewer/pose.js"
 */

export class Measure extends Aim {
  /** @param {Stage} stage */
  constructor(stage) {
    super(stage, "Measure");
    /** @type {Vec[]} */
    this.points = [];
    this.known = h("input", { id: "known", type: "number", min: 0, step: "any", class: "narrow-field", inputmode: "decimal" });
    this.unit = h("input", { id: "unit", class: "narrow-field", maxlength: 12, value: this.scale?.unit ?? "cm" });
    this.name = h("input", { id: "measured", class: "narrow-field", maxlength: 200, autocomplete: "off" });
    /** Whether the measurements that are kept are shown while nothing is measured. */
    this.shown = true;
    this.showButton = toggle("Measurements", (on) => {
      this.shown = on;
      this.draw();
    });
    this.showButton.setAttribute("aria-pressed", "true");
    this.showButton.hidden = true;
    this.keepButton = h("button", { type: "button", onclick: () => void this.keep() }, "Keep this measurement");
    this.list = h("ul", { class: "kept", "aria-label": "Measurements" });
    this.panel.addEventListener("submit", (event) => {
      event.preventDefault();
      void this.setScale();
    });
    this.panel.append(
      h("h2", {}, "Measure"),
      this.state,
      h("div", { class: "row" },
        this.middleButton,
        h("button", { type: "button", class: "quiet", onclick: () => this.clear() }, "Start over")),
      h("div", { class: "row" },
        h("div", { class: "field" }, h("label", { for: "known" }, "Its true length"), this.known),
        h("div", { class: "field" }, h("label", { for: "unit" }, "Unit"), this.unit),
        h("button", { type: "submit" }, "Set the scale"),
        h("button", { type: "button", class: "quiet", onclick: () => void this.save({ scale: null }, "Lengths are in units of the model.") }, "Forget the scale")),
      h("div", { class: "row" },
        h("div", { class: "field" }, h("label", { for: "measured" }, "What it is (may be empty)"), this.name),
        this.keepButton),
      this.list,
      h("p", { class: "hint" }, "Mark two points whose distance you know, and set it: lengths are then shown in its unit. The scale and the measurements are kept with the model, and links to it show them."));
    this.tell();
  }

  get scale() {
    return this.stage.presentation.scale ?? null;
  }

  get measurements() {
    return this.stage.presentation.measurements ?? [];
  }

  /** @param {Vec} point */
  marked(point) {
    this.points = this.points.length === 2 ? [point] : [...this.points, point];
    this.draw();
    this.tell();
  }

  clear() {
    this.points = [];
    this.draw();
    this.tell();
  }

  /** The distance between the two points in units of the model; null without two. */
  get measured() {
    return this.points.length === 2 ? length(sub(this.points[0], this.points[1])) : null;
  }

  /** A distance in the known unit, or in units of the model. @param {number} units */
  distance(units) {
    return lengthText(units, this.scale);
  }

  tell() {
    const { measured } = this;
    this.state.textContent = measured === null
      ? ["Click a first point in the view.", "Click a second point in the view."][this.points.length]
      : `The points are ${this.distance(measured)} apart.`;
  }

  draw() {
    const { measured, measurements, scale } = this;
    const lines = this.on || this.shown ? measuredLines(measurements, scale) : [];
    if (this.on && measured !== null) lines.push({ points: this.points, label: this.distance(measured) });
    if (this.on) this.view?.mark({ points: this.points, lines });
    else this.view?.mark(this.stage.annotate.on ? { lines } : { points: [], lines });
    this.showButton.hidden = !measurements.length;
    this.list.replaceChildren(...measuredLines(measurements, scale).map(({ label }, index) => h("li", {},
      h("span", { class: "number" }, label),
      h("button", { type: "button", class: "quiet small", "aria-label": `Delete the measurement ${label}`, onclick: () => void this.remove(index) }, "Delete"))));
  }

  async setScale() {
    const { measured } = this;
    const known = Number(this.known.value);
    if (measured === null || !(measured > 0)) return this.refuse("Mark two points first: their distance is what the true length belongs to.", this.middleButton);
    if (!(known > 0)) return this.refuse("Give the true length as a number over 0.", this.known);
    this.known.removeAttribute("aria-invalid");
    await this.save({ scale: { factor: known / measured, unit: this.unit.value.trim() || "units" } }, "");
    if (!this.state.textContent) this.tell();
  }

  async keep() {
    const [from, to] = this.points;
    if (!to) return this.refuse("Mark two points first: the distance between them is what is kept.", this.middleButton);
    const measurements = [...this.measurements, { points: /** @type {[Vec, Vec]} */ ([from, to]), name: this.name.value.trim() || null }];
    await this.save({ measurements }, "The measurement is kept with the model.");
    if (this.measurements.length !== measurements.length) return; // it was refused
    this.points = [];
    this.name.value = "";
    this.draw();
  }

  /** @param {number} index */
  remove(index) {
    return this.save({ measurements: this.measurements.filter((_, each) => each !== index) }, "The measurement is deleted.");
  }
}
