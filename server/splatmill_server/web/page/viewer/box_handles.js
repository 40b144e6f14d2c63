/**
 * A box in a view, whose six sides are moved by handles: with a pointer, or with the arrow keys.
 *
 * @import {View} from "../viewer.js"
 * @import {Vec} from "./pose.js"
 * @typedef {{min: Vec, max: Vec}} Box
 */
import { add, sub } from "./pose.js";

/** Share of the length of the box along an axis by which an arrow key moves a side. */
const KEY_STEP = 0.02;
/** Least length of a side over the greatest length of the box: a box never turns inside out. */
const LEAST = 1e-3;
const AXES = ["x", "y", "z"];
/** Points that a box is laid around at most and at least, the share of them beyond each side, and the room left over its length. */
const MOST_POINTS = 50_000;
const FEWEST = 10;
const OUTLIERS = 0.005;
const ROOM = 0.03;

export class BoxHandles {
  /**
   * @param {View} view
   * @param {(box: Box, done: boolean) => void} changed  done: the side was let go
   */
  constructor(view, changed) {
    this.view = view;
    this.changed = changed;
    /** @type {Box | null} */
    this.box = null;
    this.element = document.createElement("div");
    this.element.className = "handles";
    view.element.after(this.element);
    this.sides = [0, 1, 2].flatMap((axis) => [0, 1].map((end) => ({ axis, end, handle: this.make(axis, end) })));
    view.addEventListener("frame", () => this.place());
  }

  /** Show a box; null hides it. @param {Box | null} box */
  show(box) {
    this.box = box;
    this.view.mark({ box });
    this.place();
  }

  /** @param {number} axis @param {number} end */
  make(axis, end) {
    const handle = document.createElement("button");
    handle.type = "button";
    handle.className = `box-handle axis-${AXES[axis]}`;
    handle.textContent = AXES[axis];
    handle.setAttribute("aria-label", `Side of the box at the ${end ? "end" : "start"} of ${AXES[axis]}; arrow keys move it`);
    /** @type {{x: number, y: number, box: Box} | null} */
    let held = null;
    handle.addEventListener("pointerdown", (event) => {
      if (!this.box) return;
      handle.setPointerCapture(event.pointerId);
      held = { x: event.clientX, y: event.clientY, box: this.box };
    });
    handle.addEventListener("pointermove", (event) => {
      if (!held) return;
      this.move(held.box, axis, end, this.along(held.box, axis, end, event.clientX - held.x, event.clientY - held.y), false);
    });
    for (const type of ["pointerup", "pointercancel"]) {
      handle.addEventListener(type, () => {
        if (held && this.box) this.changed(this.box, true);
        held = null;
      });
    }
    handle.addEventListener("keydown", (event) => {
      const sign = { ArrowRight: 1, ArrowUp: 1, ArrowLeft: -1, ArrowDown: -1 }[event.key];
      if (!sign || !this.box) return;
      event.preventDefault();
      this.move(this.box, axis, end, sign * KEY_STEP * (this.box.max[axis] - this.box.min[axis]), true);
    });
    this.element.append(handle);
    return handle;
  }

  /** The middle of a side. @param {Box} box @param {number} axis @param {number} end @returns {Vec} */
  middle({ min, max }, axis, end) {
    const at = (/** @type {number} */ i) => (i === axis ? (end ? max[i] : min[i]) : (min[i] + max[i]) / 2);
    return [at(0), at(1), at(2)];
  }

  /**
   * How far a movement on the screen goes along an axis, at a side.
   * @param {Box} box @param {number} axis @param {number} end @param {number} dx @param {number} dy  CSS pixels
   */
  along(box, axis, end, dx, dy) {
    const from = this.middle(box, axis, end);
    const small = 0.01 * (box.max[axis] - box.min[axis]);
    const to = /** @type {Vec} */ (from.map((value, i) => value + (i === axis ? small : 0)));
    const [a, b] = [this.view.project(from), this.view.project(to)];
    const [x, y] = [b.x - a.x, b.y - a.y];
    const squared = x * x + y * y;
    return squared > 1e-6 ? (small * (dx * x + dy * y)) / squared : 0; // an axis that points at the camera has no direction
  }

  /** @param {Box} box @param {number} axis @param {number} end @param {number} by @param {boolean} done */
  move(box, axis, end, by, done) {
    const [min, max] = [/** @type {Vec} */ ([...box.min]), /** @type {Vec} */ ([...box.max])];
    const least = LEAST * Math.max(...sub(max, min));
    if (end) max[axis] = Math.max(max[axis] + by, min[axis] + least);
    else min[axis] = Math.min(min[axis] + by, max[axis] - least);
    this.show({ min, max });
    this.changed({ min, max }, done);
  }

  place() {
    const { box } = this;
    const { clientWidth: width, clientHeight: height } = this.view.canvas;
    for (const { axis, end, handle } of this.sides) {
      const { x, y, depth } = box ? this.view.project(this.middle(box, axis, end)) : { x: 0, y: 0, depth: 0 };
      handle.hidden = !box || depth <= 0 || x < 0 || y < 0 || x > width || y > height;
      handle.style.translate = `${x}px ${y}px`;
    }
  }

  dispose() {
    this.element.remove();
  }
}

/**
 * The box around the points that lie up to a distance from another, but for the outermost of them on each side: single
 * Gaussians float far from all others. Null where there are too few.
 * @param {Float32Array} points  x, y and z in turn @param {Vec} middle @param {number} reach @returns {Box | null}
 */
export function boxOf(points, middle, reach) {
  /** @type {[number[], number[], number[]]} */
  const values = [[], [], []];
  const step = 3 * Math.ceil(points.length / 3 / MOST_POINTS);
  for (let i = 0; i < points.length; i += step) {
    if (Math.hypot(...middle.map((at, axis) => points[i + axis] - at)) <= reach) values.forEach((some, axis) => some.push(points[i + axis]));
  }
  const count = values[0].length;
  if (count < FEWEST) return null;
  const outside = Math.floor(OUTLIERS * count);
  const ends = values.map((some) => {
    some.sort((a, b) => a - b);
    const [low, high] = [some[outside], some[count - 1 - outside]];
    const room = ROOM * (high - low) || ROOM * reach;
    return [low - room, high + room];
  });
  return { min: /** @type {Vec} */ (ends.map(([low]) => low)), max: /** @type {Vec} */ (ends.map(([, high]) => high)) };
}

/** A box around a point. @param {Vec} middle @param {number} half  of its sides' length @returns {Box} */
export function boxAround(middle, half) {
  return { min: sub(middle, [half, half, half]), max: add(middle, [half, half, half]) };
}
