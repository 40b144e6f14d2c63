// A sheet over a view on which lines are drawn by pointer: with a brush, or closed ones.

/**
 * @import {View} from "../viewer.js"
 * @typedef {[number, number]} Place  CSS pixels of the view
 */

/** Least distance of two points of a line, pixels. */
const STEP = 3;
const COLOR = "#ff8a3c";

export class Drawing {
  /**
   * @param {View} view
   * @param {object} on
   * @param {() => number | null} on.radius  of the brush in pixels; null for closed lines
   * @param {(line: Place[], other: boolean) => void} on.drawn  other: Alt was held
   */
  constructor(view, on) {
    this.view = view;
    this.on = on;
    /** The line that is being drawn, and its pointer. @type {{id: number, line: Place[], first: PointerEvent} | null} */
    this.held = null;
    this.sheet = document.createElement("canvas");
    this.sheet.className = "sheet";
    const listen = (/** @type {string} */ type, /** @type {(event: PointerEvent) => void} */ act) => this.sheet.addEventListener(type, (event) => act(/** @type {PointerEvent} */ (event)));
    listen("pointerdown", (event) => this.down(event));
    listen("pointermove", (event) => this.move(event));
    listen("pointerup", (event) => this.up(event));
    listen("pointercancel", () => this.end());
    listen("pointerleave", () => !this.held && this.draw([]));
    listen("dblclick", (event) => event.stopPropagation());
  }

  /** @param {boolean} on */
  show(on) {
    if (on) this.view.element.append(this.sheet);
    else this.sheet.remove();
    this.end();
  }

  /** @param {PointerEvent} event */
  down(event) {
    if (this.held) {
      // Two fingers move the scene: the view gets the first one too.
      const { first } = this.held;
      this.end();
      this.view.controls.down(first);
      return;
    }
    if (event.button !== 0 || event.shiftKey || this.view.controls.pointers.size) return;
    event.stopPropagation();
    this.view.element.focus({ preventScroll: true });
    this.sheet.setPointerCapture(event.pointerId);
    this.held = { id: event.pointerId, line: [this.place(event)], first: event };
    this.draw(this.held.line);
  }

  /** @param {PointerEvent} event */
  move(event) {
    const { held } = this;
    if (!held) {
      if (event.pointerType !== "touch") this.draw([this.place(event)]);
      return;
    }
    if (event.pointerId !== held.id) return;
    event.stopPropagation();
    const place = this.place(event);
    const last = held.line[held.line.length - 1];
    if (Math.hypot(place[0] - last[0], place[1] - last[1]) < STEP) return;
    held.line.push(place);
    this.draw(held.line);
  }

  /** @param {PointerEvent} event */
  up(event) {
    const { held } = this;
    if (!held || event.pointerId !== held.id) return;
    event.stopPropagation();
    this.end();
    this.on.drawn(held.line, event.altKey);
  }

  end() {
    this.held = null;
    this.draw([]);
  }

  /** @param {MouseEvent} event @returns {Place} */
  place(event) {
    const box = this.sheet.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  }

  /** @param {Place[]} line */
  draw(line) {
    const { sheet } = this;
    const context = sheet.getContext("2d");
    if (!context) return;
    [sheet.width, sheet.height] = [sheet.clientWidth, sheet.clientHeight]; // it is empty then
    if (!line.length) return;
    const radius = this.on.radius();
    context.beginPath();
    context.moveTo(...line[0]);
    for (const place of line.slice(1)) context.lineTo(...place);
    context.strokeStyle = context.fillStyle = COLOR;
    [context.lineCap, context.lineJoin] = ["round", "round"];
    if (radius === null) {
      context.lineWidth = 2;
      context.closePath();
      context.stroke();
      context.globalAlpha = 0.25;
      context.fill("evenodd");
    } else {
      context.lineWidth = 2 * radius;
      context.globalAlpha = 0.5;
      if (line.length > 1) context.stroke();
      else {
        context.arc(...line[0], radius, 0, 2 * Math.PI);
        context.fill();
      }
    }
  }
}
