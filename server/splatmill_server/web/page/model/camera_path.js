// A camera path through views: put together here, shown in the scene, kept with the model, and followed by videos.

import { send } from "../api.js";
import { at } from "../address.js";
import { h, toggle } from "../dom.js";
import { noticeOf } from "../shell.js";
import { LOADING } from "../viewer/errors.js";

/**
 * @import {Stage} from "./stage.js"
 * @import {View} from "../viewer.js"
 * @import {Vec} from "../viewer/pose.js"
 * @typedef {{camera_to_world: number[][], fov_y_deg: number}} Keyframe
 * @typedef {{keyframes: Keyframe[], closed: boolean}} Path
 */

/** Views of a path that are drawn, and that playing shows in a second. */
const DRAWN = 120;
const PER_SECOND = 24;

export class CameraPath {
  /** @param {Stage} stage */
  constructor(stage) {
    this.stage = stage;
    /** @type {View | null} */
    this.view = null;
    this.on = false;
    const kept = stage.presentation.camera_path;
    /** @type {Keyframe[]} */
    this.keyframes = kept?.keyframes ?? [];
    /** Places along the path, for the line in the scene. @type {Vec[]} */
    this.line = [];
    this.button = toggle("Camera path", (on) => this.turn(on));
    this.closed = h("input", { type: "checkbox", id: "path-closed", checked: kept?.closed === true, onchange: () => void this.changed() });
    this.list = h("ol", { class: "kept", "aria-label": "Views of the path" });
    this.state = h("div", { role: "status" });
    this.playButton = h("button", { type: "button", onclick: () => void this.play() }, "Play");
    this.panel = h("section", { class: "panel card", hidden: true, "aria-label": "Camera path" },
      h("h2", {}, "Camera path"),
      h("div", { class: "row" },
        h("button", { type: "button", class: "primary", onclick: () => this.add() }, "Add this view"),
        this.playButton,
        h("a", { class: "button quiet", href: "#orbit" }, "Make a video of it")),
      this.list,
      h("div", { class: "row" }, this.closed, h("label", { for: "path-closed" }, "Lead back to the first view")),
      this.state,
      h("p", { class: "hint" }, "The camera passes each view, with the same time from one to the next. The path is kept with the model."));
  }

  /** @param {View} view */
  attach(view) {
    this.view = view;
    this.draw();
  }

  /** @param {boolean} on */
  turn(on) {
    this.on = on;
    this.panel.hidden = !on;
    if (on && this.path && !this.line.length) void this.trace();
    this.draw();
  }

  /** The path; null of fewer than two views. @returns {Path | null} */
  get path() {
    return this.keyframes.length > 1 ? { keyframes: this.keyframes, closed: this.closed.checked } : null;
  }

  /** The view as it is; null while it is loaded. @returns {Keyframe | null} */
  here() {
    const camera = this.view?.getCamera();
    if (camera) return { camera_to_world: camera.camera_to_world, fov_y_deg: camera.fov_y_deg ?? 50 };
    this.state.replaceChildren(h("p", { class: "error" }, LOADING));
    return null;
  }

  add() {
    const view = this.here();
    if (!view) return;
    this.keyframes = [...this.keyframes, view];
    void this.changed();
  }

  /** @param {number} index */
  replace(index) {
    const view = this.here();
    if (!view) return;
    this.keyframes = this.keyframes.map((each, i) => (i === index ? view : each));
    void this.changed();
  }

  /** @param {number} index */
  remove(index) {
    this.keyframes = this.keyframes.filter((_, i) => i !== index);
    void this.changed();
  }

  /** Keep the path with the model, and draw it. */
  async changed() {
    this.draw();
    try {
      await this.stage.save({ camera_path: this.path });
      this.state.replaceChildren(this.path ? "" : h("p", { class: "hint" }, "A path has two views at least."));
      await this.trace();
    } catch (error) {
      this.state.replaceChildren(noticeOf(/** @type {Error} */ (error)));
    }
  }

  /** The views along the path, which the server computes as it does for videos. @param {number} count @returns {Promise<Keyframe[]>} */
  async along(count) {
    return this.path ? (await send("POST", at("/v1/camera-paths"), { path: this.path, count })).views : [];
  }

  async trace() {
    this.line = (await this.along(DRAWN)).map(({ camera_to_world: m }) => /** @type {Vec} */ ([m[0][3], m[1][3], m[2][3]]));
    this.draw();
  }

  /** The views as the overlay draws cameras. */
  get cameras() {
    return this.on ? this.keyframes.map((view, index) => ({ name: `View ${index + 1}`, camera: { ...view, width: 4, height: 3 }, color: "#ffb000" })) : [];
  }

  draw() {
    this.view?.mark({ paths: this.on && this.line.length ? [{ points: this.line }] : [] });
    this.stage.toggleCameras(this.stage.showing.cameras);
    this.playButton.disabled = !this.path;
    this.list.replaceChildren(...this.keyframes.map((view, index) => h("li", {},
      h("span", {}, `View ${index + 1}`),
      h("button", { type: "button", class: "quiet small", "aria-label": `Look from view ${index + 1}`, onclick: () => this.look(view) }, "Look from here"),
      h("button", { type: "button", class: "quiet small", "aria-label": `Replace view ${index + 1} by this view`, onclick: () => this.replace(index) }, "Replace by this view"),
      h("button", { type: "button", class: "quiet small", "aria-label": `Delete view ${index + 1}`, onclick: () => this.remove(index) }, "Delete"))));
  }

  /** @param {Keyframe} view */
  look(view) {
    this.view?.setCamera({ ...view, width: 4, height: 3 });
  }

  /** Move the view along the path once, until somebody moves it. */
  async play() {
    const { view } = this;
    if (!view || !this.path) return;
    const seconds = 2 * (this.keyframes.length - (this.closed.checked ? 0 : 1));
    try {
      const views = await this.along(Math.min(1000, seconds * PER_SECOND));
      let going = true;
      view.addEventListener("hand", () => {
        going = false;
      }, { once: true });
      const began = performance.now();
      const step = () => {
        const index = Math.floor(((performance.now() - began) / 1000) * PER_SECOND);
        if (!going || !view.surface) return;
        this.look(views[Math.min(index, views.length - 1)]);
        if (index < views.length - 1) requestAnimationFrame(step);
      };
      step();
    } catch (error) {
      this.state.replaceChildren(noticeOf(/** @type {Error} */ (error)));
    }
  }
}
