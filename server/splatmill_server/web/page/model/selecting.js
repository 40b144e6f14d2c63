// The brush and the lasso of "Crop and clean": what is drawn on the view becomes the strokes of a selection.

import { h, toggle } from "../dom.js";
import { number } from "../format.js";
import { matrixOf } from "../viewer/pose.js";
import { maskOf, within } from "../viewer/selection.js";
import { Drawing } from "./drawing.js";

/**
 * @import {View} from "../viewer.js"
 * @import {Stroke} from "../viewer/selection.js"
 * @typedef {{strokes: number[], inverted: boolean}} Chosen  strokes: places in the list of all that were drawn
 */

/** Strokes of a selection, and points of a stroke, as the server allows. */
const MOST_STROKES = 64;
const MOST_POINTS = 256;
/** Coordinates of strokes are rounded to a millionth of the distance: a pixel is over a thousandth. */
const DIGITS = 1e6;

export class Selecting {
  /**
   * @param {object} on
   * @param {() => void} on.began  called when the brush or the lasso is first taken
   * @param {() => void} on.changed  called when another selection was drawn
   * @param {() => number} on.factor  length in the shown unit of 1 in the model
   */
  constructor(on) {
    this.on = on;
    /** @type {View | null} */
    this.view = null;
    /** @type {"brush" | "lasso" | null} */
    this.tool = null;
    /** @type {Drawing | null} */
    this.drawing = null;
    /** All strokes that were drawn, also those that were taken back. @type {Stroke[]} */
    this.drawn = [];
    /** @type {Chosen} */
    this.chosen = { strokes: [], inverted: false };
    /** The Gaussians of strokes, of the model that the view shows. @type {Map<number, Uint32Array>} */
    this.inside = new Map();
    /** @type {Float32Array | null} */
    this.centers = null;
    /** The mask of what is chosen. @type {{of: Chosen, mask: Uint8Array, selected: number} | null} */
    this.made = null;
    this.brush = toggle("Brush", (on) => this.take(on ? "brush" : null));
    this.lasso = toggle("Lasso", (on) => this.take(on ? "lasso" : null));
    this.does = h("select", { id: "select-does" }, h("option", { value: "add" }, "adds to the selection"), h("option", { value: "subtract" }, "takes out of it"));
    this.width = h("input", { id: "select-width", type: "range", min: 4, max: 150, value: 30 });
    this.far = h("input", { id: "select-far", type: "number", min: 0, step: "any", placeholder: "no limit", class: "narrow-field" });
    this.farLabel = h("label", { for: "select-far" });
    this.state = h("p", { class: "hint", "aria-live": "polite" });
    this.fieldset = h("fieldset", { class: "stack" }, h("legend", {}, "Select on the view what is left out"),
      h("div", { class: "row" }, this.brush, this.lasso,
        h("button", { type: "button", onclick: () => this.atTheMiddle() }, "Select in the middle"),
        h("button", { type: "button", class: "quiet", onclick: () => this.invert() }, "Invert"),
        h("button", { type: "button", class: "quiet", onclick: () => this.clear() }, "Clear")),
      h("div", { class: "row" },
        h("div", { class: "field" }, h("label", { for: "select-does" }, "Drawing"), this.does),
        h("div", { class: "field" }, h("label", { for: "select-width" }, "Width of the brush"), this.width),
        h("div", { class: "field" }, this.farLabel, this.far)),
      this.state);
  }

  /** @param {View} view */
  attach(view) {
    this.view = view;
    this.drawing = new Drawing(view, {
      radius: () => (this.tool === "brush" ? Number(this.width.value) / 2 : null),
      drawn: (line, other) => this.add(line, other),
    });
    this.take(this.tool);
  }

  /** @param {"brush" | "lasso" | null} tool */
  take(tool) {
    if (tool && !this.tool && !this.drawn.length) this.on.began();
    this.tool = tool;
    for (const [button, name] of /** @type {const} */ ([[this.brush, "brush"], [this.lasso, "lasso"]])) button.setAttribute("aria-pressed", String(tool === name));
    this.drawing?.show(tool !== null);
    if (tool) this.say(tool === "brush" ? "Paint on the view. Shift, the right button or two fingers still move the scene." : "Draw around what is to go. Shift, the right button or two fingers still move the scene.");
  }

  /** Stamp the brush onto the middle of the view, as the keyboard does. */
  atTheMiddle() {
    const { view } = this;
    if (!view || this.refuses()) return;
    if (!this.drawn.length) this.on.began();
    const { width, height } = view.getCamera();
    this.add([[width / 2, height / 2]], false, Number(this.width.value) / 2);
  }

  /**
   * Add a line that was drawn.
   * @param {[number, number][]} line  in CSS pixels of the view
   * @param {boolean} other  whether it does the opposite of what is chosen
   * @param {number | null} [radius]  of the brush in pixels; null for a lasso
   */
  add(line, other, radius = this.tool === "brush" ? Number(this.width.value) / 2 : null) {
    const { view, chosen } = this;
    if (!view || this.refuses()) return;
    if (chosen.strokes.length === MOST_STROKES) {
      this.say(`A selection has at most ${MOST_STROKES} strokes. Make the new model, and go on with that.`);
      return;
    }
    if (radius === null && line.length < 3) {
      this.say("Draw a line around what is to go.");
      return;
    }
    const { width, height } = view.getCamera();
    const round = (/** @type {number} */ x) => Math.round(x * DIGITS) / DIGITS;
    const subtract = (this.does.value === "subtract") !== other;
    const far = this.limit(view);
    this.drawn.push({
      camera_to_world: matrixOf(view.pose),
      points: thinned(line, MOST_POINTS).map(([x, y]) => [round((x - width / 2) / view.focal), round((y - height / 2) / view.focal)]),
      ...(radius === null ? {} : { radius: round(radius / view.focal) }),
      ...(far === Infinity ? {} : { far }),
      // Of an inverted selection, what is taken out of the others is added.
      subtract: subtract !== chosen.inverted,
    });
    this.choose({ ...chosen, strokes: [...chosen.strokes, this.drawn.length - 1] });
  }

  /** Whether the largest distance is no number over 0; names what it has to be, and leads there. */
  refuses() {
    const { badInput } = this.far.validity;
    const wrong = badInput || (this.far.value !== "" && !(Number(this.far.value) > 0));
    this.far.setAttribute("aria-invalid", String(wrong));
    if (wrong) {
      this.say("The distance is a number over 0, or left empty.");
      this.far.focus();
    }
    return wrong;
  }

  /** Largest distance that counts: what was typed, and not beyond a far background that is hidden. @param {View} view */
  limit(view) {
    const typed = Number(this.far.value) / this.on.factor();
    return Math.min(typed > 0 ? typed : Infinity, view.visibleDistance);
  }

  invert() {
    if (this.chosen.strokes.length) this.choose({ ...this.chosen, inverted: !this.chosen.inverted });
    else this.say("Nothing is selected yet.");
  }

  clear() {
    if (this.chosen.strokes.length) this.choose({ strokes: [], inverted: false });
    else this.say("Nothing is selected.");
  }

  /** @param {Chosen} chosen */
  choose(chosen) {
    this.chosen = chosen;
    this.on.changed();
    const { centers } = this;
    if (!chosen.strokes.length) this.say("Nothing is selected.");
    else if (centers && this.made) this.say(`${number(this.made.selected)} of ${number(centers.length / 3)} Gaussians are selected.`);
    else this.say("The server counts what is selected, as this view draws no Gaussians, or has not loaded all.");
  }

  /** 255 for each Gaussian that is selected; null where nothing is, or the view draws no Gaussians. @returns {Uint8Array | null} */
  get mask() {
    const { chosen, view } = this;
    const centers = view?.points ?? null;
    if (centers !== this.centers) {
      this.centers = centers;
      this.made = null;
      this.inside.clear();
    }
    if (!centers || !chosen.strokes.length) return null;
    if (this.made?.of !== chosen) {
      const strokes = chosen.strokes.map((place) => {
        const stroke = this.drawn[place];
        const inside = this.inside.get(place) ?? within(centers, stroke);
        this.inside.set(place, inside);
        return { stroke, inside };
      });
      this.made = { of: chosen, ...maskOf(centers.length / 3, strokes, chosen.inverted) };
    }
    return this.made.mask;
  }

  /** The selection as the API takes it; null where nothing is selected. */
  get request() {
    const { strokes, inverted } = this.chosen;
    return strokes.length ? { strokes: strokes.map((place) => this.drawn[place]), inverted } : null;
  }

  /** @param {string} text */
  say(text) {
    this.state.textContent = text;
  }
}

/** At most `most` of the points of a line, the last one among them. @param {[number, number][]} line @param {number} most */
function thinned(line, most) {
  const step = Math.ceil(line.length / (most - 1));
  return step === 1 ? line : line.filter((_, index) => index % step === 0 || index === line.length - 1);
}
