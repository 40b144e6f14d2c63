// A tool of the viewer that marks points of the scene: by clicks, or by keyboard at the middle of the view.

import { h, toggle } from "../dom.js";
import { LOADING } from "../viewer/errors.js";

/**
 * @import {Stage} from "./stage.js"
 * @import {View} from "../viewer.js"
 * @import {Vec} from "../viewer/pose.js"
 */

export class Aim {
  /** @param {Stage} stage @param {string} name of the tool */
  constructor(stage, name) {
    this.stage = stage;
    /** @type {View | null} */
    this.view = null;
    this.on = false;
    this.button = toggle(name, (on) => this.turn(on));
    this.state = h("p", { role: "status" });
    this.middleButton = h("button", { type: "button", onclick: () => void this.mark(...this.middle()) }, "Mark the point in the middle");
    this.panel = h("form", { class: "panel card", novalidate: true, hidden: true, "aria-label": name });
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
    this.stage.aim(this);
    this.draw();
  }

  /** Show in the view what the tool has. */
  draw() {}

  /** Take a point that was marked. @param {Vec} _point */
  marked(_point) {}

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
      const point = await this.view.pointAt(x, y);
      if (point) this.marked(point);
      else this.state.textContent = "There is nothing of the scene at this place. Mark another one.";
    } catch (error) {
      this.state.textContent = /** @type {Error} */ (error).message;
    }
  }

  /** Say why nothing was done, and lead to what comes first. @param {string} reason @param {HTMLElement} place */
  refuse(reason, place) {
    this.state.textContent = reason;
    if (place instanceof HTMLInputElement) place.setAttribute("aria-invalid", "true");
    place.focus();
  }

  /**
   * Save a change of how the model is shown, and say what was done, or why it was not.
   * @param {Partial<import("../viewer/presented.js").Presentation>} change @param {string} done
   */
  async save(change, done) {
    try {
      await this.stage.save(change);
      this.state.textContent = done;
    } catch (error) {
      this.state.textContent = /** @type {Error} */ (error).message;
    }
    this.draw();
  }
}
