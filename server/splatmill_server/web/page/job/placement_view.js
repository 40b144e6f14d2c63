// Cameras and points as structure from motion places them, from any side. It is drawn in 2D, so it needs no WebGL.

import { Controls, help } from "../viewer/controls.js";
import { Overlay } from "../viewer/overlay.js";
import { add, dot, length, lookingAt, mean, poseOf, sub, surroundings, times, unit } from "../viewer/pose.js";

/** @import {Camera, Pose, Vec} from "../viewer/pose.js" */
/** @import {ShownCamera} from "../viewer/overlay.js" */

/** Vertical field of view, radians. */
const FOV = 0.9;
/** Depth of the frusta, over the distance of the farthest camera from the cameras' mean. */
const FRUSTUM = 0.12;
/** Distance from which the scene is seen first, over the distance of the farthest camera from what is looked at. */
const AWAY = 2.4;

export class PlacementView {
  /** @param {HTMLElement} container an element with a size of its own */
  constructor(container) {
    this.element = document.createElement("div");
    this.element.className = "view placement";
    this.element.tabIndex = 0;
    this.element.setAttribute("role", "application");
    this.element.setAttribute("aria-roledescription", "3D view");
    this.points = document.createElement("canvas");
    const over = document.createElement("canvas");
    this.element.append(this.points, over);
    container.append(this.element);
    this.overlay = new Overlay(over);
    /** @type {{positions: Float64Array, colors: string[]}} */
    this.cloud = { positions: new Float64Array(), colors: [] };
    /** @type {Pose} */
    this.pose = lookingAt([0, 0, -3], [0, 0, 0], [0, -1, 0]);
    this.distance = 3;
    /** @type {Vec} */
    this.up = [0, -1, 0];
    /** @type {{center: Vec, radius: number} | null} */
    this.limit = null;
    /** @type {Vec} */
    this.focus = [0, 0, 0];
    this.spread = 0;
    /** @type {Vec} */
    this.side = [0, 0, -1];
    this.moved = false;
    this.pending = 0;
    this.controls = new Controls(this.element, this, {
      moved: () => { this.moved = true; this.again(); },
      home: () => { this.moved = false; this.frame(); },
      picked: () => {},
    });
    this.watch = new ResizeObserver(() => this.again());
    this.watch.observe(this.element);
  }

  /**
   * Show cameras and points. The camera of the view stays where somebody has moved it, relative to the scene.
   * @param {any} placement of `/v1/jobs/{id}/cameras`
   * @param {ShownCamera[]} cameras
   */
  show(placement, cameras) {
    const count = placement.points.length;
    this.cloud = {
      positions: Float64Array.from(placement.points.flat()),
      colors: placement.colors.length === count
        ? placement.colors.map((/** @type {number[]} */ [r, g, b]) => `rgb(${r} ${g} ${b})`)
        : [],
    };
    this.overlay.cameras = cameras;
    const specs = cameras.map(({ camera }) => camera);
    if (specs.length) this.settle(specs, placement.up);
    this.element.setAttribute("aria-label", `${cameras.length} cameras and ${placement.points_total} points. ${help()}`);
    this.element.dataset.cameras = String(cameras.length);
    this.again();
  }

  /** Take over where the scene is now. @param {Camera[]} cameras @param {any} known  what is up, where that is known */
  settle(cameras, known) {
    const { up, focus } = surroundings(cameras, known);
    const spread = Math.max(...cameras.map((camera) => length(sub(poseOf(camera).position, focus)))) || 1;
    if (this.moved && this.spread > 0) {
      // A mapper may have scaled its world meanwhile.
      const scale = spread / this.spread;
      this.pose = { ...this.pose, position: add(focus, times(sub(this.pose.position, this.focus), scale)) };
      this.distance *= scale;
    }
    [this.up, this.focus, this.spread] = [up, focus, spread];
    this.overlay.size = FRUSTUM * spread;
    this.side = this.sideOf(cameras);
    if (!this.moved) this.frame();
  }

  /**
   * The horizontal direction from which most photos were taken; that of the first one where they surround the scene.
   * @param {Camera[]} cameras
   */
  sideOf(cameras) {
    const level = (/** @type {Vec} */ position) => {
      const offset = sub(position, this.focus);
      return sub(offset, times(this.up, dot(offset, this.up)));
    };
    const positions = cameras.map((camera) => poseOf(camera).position);
    const common = level(mean(positions));
    const { down, forward } = poseOf(cameras[0]);
    const steep = Math.abs(dot(forward, this.up)) > Math.SQRT1_2;
    return unit(length(common) > 0.3 * this.spread ? common : level(positions[0]), steep ? down : times(forward, -1));
  }

  /** Look at all of it from behind the cameras and above. */
  frame() {
    const direction = unit(add(this.side, times(this.up, 0.55)));
    this.pose = lookingAt(add(this.focus, times(direction, AWAY * this.spread)), this.focus, this.up);
    this.distance = AWAY * this.spread;
    this.again();
  }

  again() {
    if (!this.pending) this.pending = requestAnimationFrame(() => this.draw());
  }

  draw() {
    this.pending = 0;
    const [width, height] = [this.element.clientWidth, this.element.clientHeight];
    const context = this.points.getContext("2d");
    if (!width || !height || !context) return;
    const ratio = Math.min(devicePixelRatio || 1, 2);
    for (const canvas of [this.points, this.overlay.canvas]) {
      const [w, h] = [Math.round(width * ratio), Math.round(height * ratio)];
      if (canvas.width !== w || canvas.height !== h) [canvas.width, canvas.height] = [w, h];
    }
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, width, height);
    const focal = height / 2 / Math.tan(FOV / 2);
    this.drawPoints(context, focal, width, height);
    this.overlay.draw(this.pose, focal, ratio);
  }

  /** @param {CanvasRenderingContext2D} context @param {number} focal @param {number} width @param {number} height */
  drawPoints(context, focal, width, height) {
    const { right, down, forward, position: eye } = this.pose;
    const { positions, colors } = this.cloud;
    context.fillStyle = "rgb(200 205 212)";
    for (let i = 0; i < positions.length / 3; i++) {
      const [x, y, z] = [positions[3 * i] - eye[0], positions[3 * i + 1] - eye[1], positions[3 * i + 2] - eye[2]];
      const depth = x * forward[0] + y * forward[1] + z * forward[2];
      if (!(depth > 1e-9)) continue;
      const column = width / 2 + (focal * (x * right[0] + y * right[1] + z * right[2])) / depth;
      const row = height / 2 + (focal * (x * down[0] + y * down[1] + z * down[2])) / depth;
      if (column < 0 || row < 0 || column > width || row > height) continue;
      if (colors.length) context.fillStyle = colors[i];
      context.fillRect(column - 1, row - 1, 2, 2);
    }
  }

  dispose() {
    cancelAnimationFrame(this.pending);
    this.watch.disconnect();
    this.controls.dispose();
    this.element.remove();
  }
}
