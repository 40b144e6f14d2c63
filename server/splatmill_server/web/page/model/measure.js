// Measuring: two points of the scene, the distance between them, and a known distance that gives the scene its scale.

import { request, whole } from "../api.js";
import { h, toggle } from "../dom.js";
import { add, length, poseOf, sub, times } from "../viewer/pose.js";
import { readArray } from "../viewer/depth.js";
import { LOADING } from "../viewer/errors.js";

/**
 * @import {Stage} from "./stage.js"
 * @import {View} from "../viewer.js"
 * @import {Vec} from "../viewer/pose.js"
 */

export class Measure {
  /** @param {Stage} stage */
  constructor(stage) {
    this.stage = stage;
    /** @type {View | null} */
    this.view = null;
    this.on = false;
    /** @type {Vec[]} */
    this.points = [];
    this.key = `splatmill.scale.${stage.shown.model.id}`;
    /** Known units per unit of the model, and their name. @type {{factor: number, unit: string} | null} */
    this.scale = stored(this.key);
    this.button = toggle("Measure", (on) => this.turn(on));
    this.state = h("p", { role: "status" });
    this.known = h("input", { id: "known", type: "number", min: 0, step: "any", class: "narrow-field", inputmode: "decimal" });
    this.unit = h("input", { id: "unit", class: "narrow-field", maxlength: 12, value: this.scale?.unit ?? "cm" });
    this.set = h("button", { type: "submit" }, "Set the scale");
    this.middleButton = h("button", { type: "button", onclick: () => void this.mark(...this.middle()) }, "Mark the point in the middle");
    this.panel = h("form", { class: "panel card", novalidate: true, hidden: true, onsubmit: (/** @type {Event} */ event) => {
      event.preventDefault();
      this.setScale();
    } },
      h("h2", {}, "Measure"),
      this.state,
      h("div", { class: "row" },
        this.middleButton,
        h("button", { type: "button", class: "quiet", onclick: () => this.clear() }, "Start over")),
      h("div", { class: "row" },
        h("div", { class: "field" }, h("label", { for: "known" }, "Its true length"), this.known),
        h("div", { class: "field" }, h("label", { for: "unit" }, "Unit"), this.unit),
        this.set,
        h("button", { type: "button", class: "quiet", onclick: () => this.dropScale() }, "Forget the scale")),
      h("p", { class: "hint" }, "Mark two points whose distance you know, and set it: further distances are told in its unit. The scale is kept in this browser."));
    this.tell();
  }

  /** @param {View} view */
  attach(view) {
    this.view = view;
    view.addEventListener("pick", (event) => {
      const { x, y } = /** @type {CustomEvent} */ (event).detail;
      if (this.on) void this.mark(x, y);
    });
    this.draw();
  }

  /** @param {boolean} on */
  turn(on) {
    this.on = on;
    this.panel.hidden = !on;
    document.getElementById("viewer")?.classList.toggle("aims", on);
    this.draw();
  }

  /** @returns {[number, number]} */
  middle() {
    const camera = this.view?.getCamera();
    return camera ? [camera.width / 2, camera.height / 2] : [0, 0];
  }

  /** Mark the point of the scene that is seen at a place of the view. @param {number} x @param {number} y CSS pixels */
  async mark(x, y) {
    if (!this.view) {
      this.state.textContent = LOADING;
      return;
    }
    try {
      const point = await pointAt(this.stage.shown.address, this.view, x, y);
      if (!point) {
        this.state.textContent = "There is nothing of the scene at this place. Mark another one.";
        return;
      }
      this.points = this.points.length === 2 ? [point] : [...this.points, point];
      this.draw();
      this.tell();
    } catch (error) {
      this.state.textContent = /** @type {Error} */ (error).message;
    }
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
    const value = this.scale ? units * this.scale.factor : units;
    const text = Number(value.toPrecision(3)).toLocaleString("en", { maximumFractionDigits: 6 });
    return `${text} ${this.scale?.unit ?? "units"}`;
  }

  tell() {
    const { measured } = this;
    this.state.textContent = measured === null
      ? ["Click a first point in the view.", "Click a second point in the view."][this.points.length]
      : `The points are ${this.distance(measured)} apart.`;
  }

  draw() {
    const { measured } = this;
    this.view?.mark(this.on ? {
      points: this.points,
      lines: measured === null ? [] : [{ points: this.points, label: this.distance(measured) }],
    } : { points: [], lines: [] });
  }

  setScale() {
    const { measured } = this;
    const known = Number(this.known.value);
    if (measured === null || !(measured > 0)) return this.refuse("Mark two points first: their distance is what the true length belongs to.", this.middleButton);
    if (!(known > 0)) return this.refuse("Give the true length as a number over 0.", this.known);
    this.known.removeAttribute("aria-invalid");
    this.scale = { factor: known / measured, unit: this.unit.value.trim() || "units" };
    try {
      localStorage.setItem(this.key, JSON.stringify(this.scale));
    } catch {
      // Storage is off in this browser: the scale holds for this page.
    }
    this.draw();
    this.tell();
  }

  /** Say why nothing was done, and lead to what comes first. @param {string} reason @param {HTMLElement} place */
  refuse(reason, place) {
    this.state.textContent = reason;
    if (place === this.known) place.setAttribute("aria-invalid", "true");
    place.focus();
  }

  dropScale() {
    this.scale = null;
    try {
      localStorage.removeItem(this.key);
    } catch {
      // as above
    }
    this.draw();
    this.tell();
  }
}

/**
 * The point of the scene at a place of the view; null where there is none. The server renders the depth of one pixel.
 * @param {string} address @param {View} view @param {number} x @param {number} y CSS pixels
 * @returns {Promise<Vec | null>}
 */
async function pointAt(address, view, x, y) {
  const { width, height, camera_to_world, fov_y_deg } = view.getCamera();
  const focal = height / 2 / Math.tan(((fov_y_deg ?? 50) * Math.PI) / 360);
  const [dx, dy] = [(x - width / 2) / focal, (y - height / 2) / focal];
  const camera = { camera_to_world, width: 1, height: 1, fx: focal, fy: focal, cx: 0.5 - dx * focal, cy: 0.5 - dy * focal };
  const answer = await request("POST", `${address}/render`, { json: { camera, output: "depth", format: "npy" } });
  const [depth] = readArray(await whole(answer.arrayBuffer())).data;
  if (!(depth > 0)) return null;
  const pose = poseOf({ camera_to_world, width, height });
  return add(pose.position, times(add(pose.forward, add(times(pose.right, dx), times(pose.down, dy))), depth));
}

/** @param {string} key */
function stored(key) {
  try {
    const scale = JSON.parse(localStorage.getItem(key) ?? "null");
    return scale && scale.factor > 0 && typeof scale.unit === "string" ? scale : null;
  } catch {
    return null;
  }
}
