/**
 * What is drawn over a view, in either kind of it: the cameras of the photos as frusta, lines, boxes and marked points.
 *
 * @import {Camera, Pose, Vec} from "./pose.js"
 */
import { add, dot, length, poseOf, projected, sub, tangentsOf, times } from "./pose.js";

/**
 * @typedef {{name: string, camera: Camera, color?: string, selected?: boolean}} ShownCamera
 *   color: of CSS; left out, that of the custom property --frustum.
 * @typedef {{points: Vec[], color?: string, label?: string}} Line  label: written at its middle
 * @typedef {{x: number, y: number, depth: number}} Seen
 */

/** Pixels between a click and a frustum's tip for the camera to be meant. */
const REACH = 14;
/** The eight corners of a box, and the pairs of them that are edges. */
const CORNERS = [0, 1, 2, 3, 4, 5, 6, 7];
const EDGES = CORNERS.flatMap((i) => [1, 2, 4].filter((bit) => !(i & bit)).map((bit) => [i, i | bit]));

export class Overlay {
  /** @param {HTMLCanvasElement} canvas  as large as the view */
  constructor(canvas) {
    this.canvas = canvas;
    /** @type {ShownCamera[]} */
    this.cameras = [];
    /** @type {Line[]} */
    this.lines = [];
    /** Ways of cameras. @type {Line[]} */
    this.paths = [];
    /** @type {Vec[]} */
    this.points = [];
    /** @type {{min: Vec, max: Vec} | null} */
    this.box = null;
    /** Depth of a frustum in units of the model. */
    this.size = 0.1;
    /** @type {{camera: ShownCamera, x: number, y: number}[]} */
    this.tips = [];
  }

  /**
   * Draw everything as a pose sees it.
   * @param {Pose} pose @param {number} focal  in CSS pixels
   * @param {number} ratio  pixels of the canvas per CSS pixel
   */
  draw(pose, focal, ratio) {
    const { canvas } = this;
    const context = canvas.getContext("2d");
    if (!context) return;
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.clearRect(0, 0, canvas.width, canvas.height);
    this.tips = [];
    if (!this.cameras.length && !this.lines.length && !this.paths.length && !this.points.length && !this.box) return;
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    const [width, height] = [canvas.width / ratio, canvas.height / ratio];
    const style = getComputedStyle(canvas);
    const plain = style.getPropertyValue("--frustum") || "#4da3ff";
    const accent = style.getPropertyValue("--mark") || "#ffb000";
    /** @param {Vec} point */
    const project = (point) => projected(pose, point, focal, width, height);
    const near = 0.02 * this.size;
    /** @param {Vec} a @param {Vec} b */
    const segment = (a, b) => {
      const clipped = inFront(pose, a, b, near);
      if (!clipped) return;
      const [from, to] = clipped.map(project);
      context.moveTo(from.x, from.y);
      context.lineTo(to.x, to.y);
    };
    /** @param {string} color @param {number} wide */
    const stroke = (color, wide) => {
      // A dark rim keeps the lines visible on any picture.
      context.strokeStyle = "rgb(0 0 0 / 45%)";
      context.lineWidth = wide + 2;
      context.stroke();
      context.strokeStyle = color;
      context.lineWidth = wide;
      context.stroke();
    };

    for (const camera of this.cameras) {
      const corners = frustum(camera.camera, this.size);
      // From where a photo was taken, its own frustum would cover the view.
      if (length(sub(corners[4], pose.position)) < this.size) continue;
      context.beginPath();
      for (let i = 0; i < 4; i++) {
        segment(corners[4], corners[i]);
        segment(corners[i], corners[(i + 1) % 4]);
      }
      stroke(camera.selected ? accent : (camera.color ?? plain), camera.selected ? 2.5 : 1.25);
      const tip = project(corners[4]);
      if (tip.depth > near) this.tips.push({ camera, x: tip.x, y: tip.y });
    }
    if (this.box) {
      const { min, max } = this.box;
      const corner = CORNERS.map(
        (i) => /** @type {Vec} */ ([0, 1, 2].map((axis) => (i & (1 << axis) ? max[axis] : min[axis]))),
      );
      context.beginPath();
      for (const [i, j] of EDGES) segment(corner[i], corner[j]);
      stroke(accent, 2);
    }
    for (const line of [...this.paths, ...this.lines]) {
      context.beginPath();
      for (let i = 1; i < line.points.length; i++) segment(line.points[i - 1], line.points[i]);
      stroke(line.color ?? accent, 2);
      if (line.label) label(context, line.label, project(times(add(line.points[0], line.points[line.points.length - 1]), 0.5)));
    }
    for (const point of this.points) {
      const at = project(point);
      if (at.depth <= near) continue;
      context.beginPath();
      context.arc(at.x, at.y, 5, 0, 2 * Math.PI);
      stroke(accent, 2);
    }
  }

  /**
   * The camera whose tip is drawn near a point; null where none is.
   * @param {number} x @param {number} y  CSS pixels
   */
  cameraAt(x, y) {
    let nearest = null;
    let least = REACH;
    for (const tip of this.tips) {
      const away = Math.hypot(tip.x - x, tip.y - y);
      if (away < least) [nearest, least] = [tip.camera, away];
    }
    return nearest;
  }
}

/**
 * The four corners of a camera's picture at a depth, in order around it, and its position.
 * @param {Camera} camera @param {number} depth
 * @returns {Vec[]}
 */
function frustum(camera, depth) {
  const pose = poseOf(camera);
  const { x, y } = tangentsOf(camera);
  const signs = [[-1, -1], [1, -1], [1, 1], [-1, 1]]; // prettier-ignore
  const corners = signs.map(([sx, sy]) =>
    add(
      add(pose.position, times(pose.forward, depth)),
      add(times(pose.right, sx * x * depth), times(pose.down, sy * y * depth)),
    ),
  );
  return [...corners, pose.position];
}

/**
 * The part of a segment that lies in front of a camera; null where none does.
 * @param {Pose} pose @param {Vec} a @param {Vec} b @param {number} near
 * @returns {[Vec, Vec] | null}
 */
function inFront(pose, a, b, near) {
  const da = dot(sub(a, pose.position), pose.forward) - near;
  const db = dot(sub(b, pose.position), pose.forward) - near;
  if (da <= 0 && db <= 0) return null;
  if (da > 0 && db > 0) return [a, b];
  const cut = add(a, times(sub(b, a), da / (da - db)));
  return da > 0 ? [a, cut] : [cut, b];
}

/** @param {CanvasRenderingContext2D} context @param {string} text @param {Seen} at */
function label(context, text, at) {
  if (at.depth <= 0) return;
  context.font = "600 14px system-ui, sans-serif";
  context.textAlign = "center";
  context.lineWidth = 4;
  context.strokeStyle = "rgb(0 0 0 / 80%)";
  context.strokeText(text, at.x, at.y - 8);
  context.fillStyle = "white";
  context.fillText(text, at.x, at.y - 8);
}
