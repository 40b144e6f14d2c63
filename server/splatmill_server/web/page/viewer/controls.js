/**
 * Moves a camera by mouse, touch and keyboard: orbit about the point in front of it, pan, zoom and fly.
 *
 * @import {Pose, Vec} from "./pose.js"
 */
import { add, dot, length, sub, times, turnedAbout } from "./pose.js";
import { enterable } from "./touch.js";

/** Radians of orbit for a drag over the whole height of the view. */
const TURN = Math.PI;
/** Factor of the distance to the pivot for a wheel movement of 100 pixels, which is one notch of most mice. */
const NOTCH = 1.15;
/** Radians and shares of the distance a second, while a key is held. */
const KEY_TURN = 1.2;
const KEY_MOVE = 0.8;
/** Smallest angle between the viewing direction and the vertical, radians. */
const POLE = 0.05;
/** Pixels that a pointer may move between down and up for a click. */
const STILL = 4;

/** What the keys do: [what, amount]; the amounts are shares of KEY_TURN and KEY_MOVE. */
const KEYS = new Map(
  /** @type {[string, [("yaw"|"pitch"|"zoom"|"right"|"down"|"forward"), number]][]} */ ([
    ["ArrowLeft", ["yaw", 1]],
    ["ArrowRight", ["yaw", -1]],
    ["ArrowUp", ["pitch", -1]],
    ["ArrowDown", ["pitch", 1]],
    ["+", ["zoom", 1]],
    ["=", ["zoom", 1]],
    ["-", ["zoom", -1]],
    ["w", ["forward", 1]],
    ["s", ["forward", -1]],
    ["a", ["right", -1]],
    ["d", ["right", 1]],
    ["q", ["down", 1]],
    ["e", ["down", -1]],
  ]),
);

const BY_HAND =
  "Drag or arrow keys: turn. Wheel, pinch or + and -: nearer and farther. Right button, Shift or two fingers: move " +
  "sideways. Double click: turn about that point. W A S D Q E: fly. Home: back to the start.";
const BY_FINGERS = "One finger: turn. Pinch: nearer and farther. Two fingers: move sideways. Double tap: turn about that point.";

/** Whether this is a phone or a tablet, whose views fingers move. */
export function hasTouch() {
  return matchMedia("(pointer: coarse)").matches;
}

/** How a view is moved, by mouse and keys or by fingers. */
export function help() {
  return hasTouch() ? BY_FINGERS : BY_HAND;
}

/**
 * @typedef {Object} Movable  what is moved
 * @property {Pose} pose
 * @property {number} distance  from the camera to the pivot, along the viewing direction
 * @property {Vec} up
 * @property {{center: Vec, radius: number} | null} limit  the sphere that the camera stays in
 */

export class Controls {
  /**
   * @param {HTMLElement} element  gets the pointers and the keys
   * @param {Movable} movable
   * @param {{moved: () => void, home: () => void, picked: (x: number, y: number) => void, twice?: (x: number, y: number) => void}} on
   *   moved: after each change of the pose. home: the key Home. picked, twice: a click and a double click, in CSS pixels of
   *   the element.
   */
  constructor(element, movable, on) {
    this.element = element;
    this.movable = movable;
    this.on = on;
    /** @type {Map<number, {x: number, y: number}>} */
    this.pointers = new Map();
    /** @type {Set<string>} */
    this.held = new Set();
    /** @type {{x: number, y: number} | null} */
    this.start = null;
    this.timer = 0;
    this.last = 0;
    this.ended = new AbortController();
    const signal = this.ended.signal;
    this.enter = enterable(element, signal);
    element.addEventListener("pointerdown", (event) => this.down(event), { signal });
    element.addEventListener("pointermove", (event) => this.move(event), { signal });
    element.addEventListener("pointerup", (event) => this.up(event, true), { signal });
    element.addEventListener("pointercancel", (event) => this.up(event, false), { signal });
    element.addEventListener("dblclick", (event) => this.on.twice?.(...this.place(event)), { signal });
    element.addEventListener("wheel", (event) => this.wheel(event), { signal, passive: false });
    element.addEventListener("contextmenu", (event) => event.preventDefault(), { signal });
    element.addEventListener("keydown", (event) => this.keyDown(event), { signal });
    element.addEventListener("keyup", (event) => this.keyUp(event), { signal });
    element.addEventListener("blur", () => this.held.clear(), { signal });
  }

  dispose() {
    this.ended.abort();
    cancelAnimationFrame(this.timer);
  }

  /** @param {PointerEvent} event */
  down(event) {
    this.element.setPointerCapture(event.pointerId);
    this.pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    this.start = this.pointers.size === 1 ? { x: event.clientX, y: event.clientY } : null;
  }

  /** @param {PointerEvent} event */
  move(event) {
    const before = this.pointers.get(event.pointerId);
    if (!before) return;
    const dx = event.clientX - before.x;
    const dy = event.clientY - before.y;
    if (this.pointers.size >= 2) {
      const other = [...this.pointers].find(([id]) => id !== event.pointerId)?.[1] ?? before;
      const was = Math.hypot(before.x - other.x, before.y - other.y);
      const is = Math.hypot(event.clientX - other.x, event.clientY - other.y);
      this.pan(dx / this.pointers.size, dy / this.pointers.size);
      if (was > 1 && is > 1) this.zoom(was / is);
    } else if (event.shiftKey || event.buttons & 6) {
      this.pan(dx, dy);
    } else {
      const turn = TURN / Math.max(1, this.element.clientHeight);
      this.turn(-dx * turn, -dy * turn);
    }
    this.pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    if (this.start && Math.hypot(event.clientX - this.start.x, event.clientY - this.start.y) > STILL) this.start = null;
    this.changed();
  }

  /** @param {PointerEvent} event @param {boolean} released */
  up(event, released) {
    this.pointers.delete(event.pointerId);
    if (released && this.start && event.button === 0) {
      if (event.pointerType === "touch") this.enter();
      this.on.picked(...this.place(event));
    }
    this.start = null;
  }

  /** Where an event is, in CSS pixels of the element. @param {MouseEvent} event @returns {[number, number]} */
  place(event) {
    const box = this.element.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  }

  /** @param {WheelEvent} event */
  wheel(event) {
    event.preventDefault();
    const pixels = event.deltaY * (event.deltaMode === 1 ? 33 : 1);
    this.zoom(NOTCH ** (Math.max(-300, Math.min(300, pixels)) / 100));
    this.changed();
  }

  /** @param {KeyboardEvent} event */
  keyDown(event) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
    if (key === "Home") {
      event.preventDefault();
      this.on.home();
    } else if (KEYS.has(key)) {
      event.preventDefault();
      if (this.held.has(key)) return;
      this.held.add(key);
      this.last = performance.now();
      // The first step comes at once, so that a key that is tapped moves the camera too.
      this.keyStep(1 / 20);
      cancelAnimationFrame(this.timer);
      this.timer = requestAnimationFrame((now) => this.keysHeld(now));
    }
  }

  /** @param {KeyboardEvent} event */
  keyUp(event) {
    this.held.delete(event.key.length === 1 ? event.key.toLowerCase() : event.key);
  }

  /** @param {number} now */
  keysHeld(now) {
    if (!this.held.size) return;
    this.keyStep(Math.min(0.1, Math.max(0, now - this.last) / 1000));
    this.last = now;
    this.timer = requestAnimationFrame((then) => this.keysHeld(then));
  }

  /** @param {number} seconds */
  keyStep(seconds) {
    const { movable } = this;
    for (const key of this.held) {
      const [what, amount] = /** @type {[string, number]} */ (KEYS.get(key));
      const turn = amount * KEY_TURN * seconds;
      const step = amount * KEY_MOVE * seconds * movable.distance;
      if (what === "yaw") this.turn(-turn, 0);
      else if (what === "pitch") this.turn(0, turn);
      else if (what === "zoom") this.zoom(Math.exp(-amount * KEY_MOVE * seconds));
      else this.shift(times(movable.pose[/** @type {"right" | "down" | "forward"} */ (what)], step));
    }
    this.changed();
  }

  /**
   * Orbit about the pivot. @param {number} yaw  radians about the vertical @param {number} pitch  radians
   */
  turn(yaw, pitch) {
    const { movable } = this;
    const pivot = add(movable.pose.position, times(movable.pose.forward, movable.distance));
    const vertical = dot(movable.pose.down, movable.up) <= 0 ? movable.up : times(movable.up, -1);
    let pose = turnedAbout(movable.pose, pivot, vertical, yaw);
    // No pitch goes over the pole, where left and right would change places.
    const tilted = turnedAbout(pose, pivot, pose.right, pitch);
    const angle = Math.acos(Math.max(-1, Math.min(1, dot(tilted.forward, vertical))));
    const sameSide = dot(tilted.down, vertical) < 0;
    if (sameSide && angle > POLE && angle < Math.PI - POLE) pose = tilted;
    movable.pose = pose;
  }

  /** @param {number} factor  of the distance to the pivot */
  zoom(factor) {
    const { movable } = this;
    const distance = Math.max(movable.distance * factor, 1e-4);
    const position = add(movable.pose.position, times(movable.pose.forward, movable.distance - distance));
    if (this.allowed(position)) {
      movable.pose = { ...movable.pose, position };
      movable.distance = distance;
    }
  }

  /** Move with the scene under the pointer. @param {number} dx @param {number} dy  CSS pixels */
  pan(dx, dy) {
    const { movable } = this;
    const scale = movable.distance / Math.max(1, this.element.clientHeight);
    this.shift(add(times(movable.pose.right, -dx * scale), times(movable.pose.down, -dy * scale)));
  }

  /** @param {Vec} by */
  shift(by) {
    const position = add(this.movable.pose.position, by);
    if (this.allowed(position)) this.movable.pose = { ...this.movable.pose, position };
  }

  /** Whether the camera may be at a position: inside of the limit, or nearer to it than before. @param {Vec} position */
  allowed(position) {
    const { limit, pose } = this.movable;
    if (!limit) return true;
    const away = length(sub(position, limit.center));
    return away <= limit.radius || away < length(sub(pose.position, limit.center));
  }

  changed() {
    this.on.moved();
  }
}

