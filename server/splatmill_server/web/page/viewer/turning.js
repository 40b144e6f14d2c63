/**
 * Turns a view slowly about the point in front of it, until somebody moves it.
 *
 * @import {View} from "../viewer.js"
 */

/** Radians a second: a turn in 40 seconds. */
const SPEED = (2 * Math.PI) / 40;
/** Most seconds between two steps that count, so that a tab that comes back does not jump. */
const LONGEST = 0.1;

export class Turning {
  /** @param {View} view @param {(on: boolean) => void} changed  called when it begins and ends */
  constructor(view, changed = () => {}) {
    this.view = view;
    this.changed = changed;
    this.on = false;
    view.addEventListener("hand", () => this.turn(false));
    view.element.addEventListener("pointerdown", () => this.turn(false));
  }

  /** @param {boolean} on */
  turn(on) {
    if (on === this.on) return;
    this.on = on;
    this.changed(on);
    let last = performance.now();
    /** @param {number} now */
    const step = (now) => {
      if (!this.on || !this.view.surface) return;
      this.view.controls.turn(-SPEED * Math.min(LONGEST, Math.max(0, now - last) / 1000), 0);
      last = now;
      this.view.moved();
      requestAnimationFrame(step);
    };
    if (on) requestAnimationFrame(step);
  }
}
