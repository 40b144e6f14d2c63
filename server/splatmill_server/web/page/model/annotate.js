// Annotations: texts at points of the scene, which are kept with the model and shown to visitors.

import { h } from "../dom.js";
import { Annotations } from "../viewer/annotations.js";
import { Aim } from "./aim.js";

/**
 * @import {Stage} from "./stage.js"
 * @import {View} from "../viewer.js"
 * @import {Vec} from "../viewer/pose.js"
 */

export class Annotate extends Aim {
  /** @param {Stage} stage */
  constructor(stage) {
    super(stage, "Annotate");
    /** @type {Vec | null} */
    this.point = null;
    /** @type {Annotations | null} */
    this.pins = null;
    this.text = h("input", { id: "annotation", maxlength: 500, autocomplete: "off" });
    this.list = h("ol", { class: "kept", "aria-label": "Annotations" });
    this.panel.addEventListener("submit", (event) => {
      event.preventDefault();
      void this.add();
    });
    this.panel.append(
      h("h2", {}, "Annotate"),
      this.state,
      h("div", { class: "row" }, this.middleButton),
      h("div", { class: "row" },
        h("div", { class: "field wide" }, h("label", { for: "annotation" }, "Text"), this.text),
        h("button", { type: "submit" }, "Add")),
      this.list,
      h("p", { class: "hint" }, "Annotations are kept with the model, and links to it show them."));
    this.state.textContent = "Click a point in the view, and write what there is.";
  }

  get annotations() {
    return this.stage.presentation.annotations ?? [];
  }

  /** @param {View} view */
  attach(view) {
    this.pins?.dispose();
    this.pins = new Annotations(view);
    super.attach(view);
  }

  /** @param {Vec} point */
  marked(point) {
    this.point = point;
    this.state.textContent = "The point is marked.";
    this.draw();
    this.text.focus({ preventScroll: true });
  }

  draw() {
    if (this.on) this.view?.mark({ points: this.point ? [this.point] : [] });
    else if (!this.stage.measure.on) this.view?.mark({ points: [] });
    this.pins?.show(this.annotations);
    this.list.replaceChildren(...this.annotations.map(({ point, text }, index) => h("li", {},
      h("span", {}, `${index + 1}. ${text}`),
      h("button", { type: "button", class: "quiet small", "aria-label": `Show annotation ${index + 1}`, onclick: () => this.show(point, index) }, "Show"),
      h("button", { type: "button", class: "quiet small", "aria-label": `Delete annotation ${index + 1}`, onclick: () => void this.remove(index) }, "Delete"))));
  }

  /** @param {Vec} point @param {number} index */
  show(point, index) {
    this.view?.lookAt(point);
    this.pins?.open(index);
  }

  async add() {
    const text = this.text.value.trim();
    if (!this.point) return this.refuse("Mark a point first: it is where the text belongs.", this.middleButton);
    if (!text) return this.refuse("Write what there is at the point.", this.text);
    this.text.removeAttribute("aria-invalid");
    const annotations = [...this.annotations, { point: this.point, text }];
    await this.save({ annotations }, `Annotation ${annotations.length} is kept with the model.`);
    if (this.annotations.length !== annotations.length) return; // it was refused
    this.point = null;
    this.text.value = "";
    this.draw();
  }

  /** @param {number} index */
  remove(index) {
    return this.save({ annotations: this.annotations.filter((_, each) => each !== index) }, "The annotation is deleted.");
  }
}
