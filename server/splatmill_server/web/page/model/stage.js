// The viewer of the model's page with its tools.

import { send } from "../api.js";
import { byId, h, toggle } from "../dom.js";
import { openModel } from "../opening.js";
import { noticeOf, notify } from "../shell.js";
import { GRADIENT } from "../viewer/depth.js";
import { help } from "../viewer/controls.js";
import { savePicture } from "../viewer/presented.js";
import { Turning } from "../viewer/turning.js";
import { Annotate } from "./annotate.js";
import { CameraPath } from "./camera_path.js";
import { Edit } from "./edit.js";
import { Measure } from "./measure.js";
import { timeLapse } from "./time_lapse.js";
import { Visitors } from "./visitors.js";

/**
 * @import {Aim} from "./aim.js"
 * @import {Shown} from "./model.js"
 * @import {View} from "../viewer.js"
 */

/** Share of the far shell's distance that the camera may go to, and radius around the cameras that hiding it leaves. */
const ROAM = 0.7;
const INSIDE = 0.4;
/** How far the camera may go where there is no shell, over the farthest camera's distance from the middle. */
const ROAM_FREELY = 20;

export class Stage {
  /** @param {Shown} shown */
  constructor(shown) {
    this.shown = shown;
    this.presentation = shown.presentation;
    /** @type {Turning | null} */
    this.turning = null;
    /** @type {View | null} */
    this.view = null;
    const { plan, facts } = shown.report;
    /** Distance of the far shell over that of the farthest camera; 0 where there is none. */
    this.shell = plan?.far_shell ? Number(facts?.shell_distance) || 0 : 0;
    this.showing = { cameras: false, hidden: false };
    /** Name of the photo from whose place the view looks; "" once it was moved. */
    this.photo = "";
    this.note = byId("viewer-note");
    this.kind = h("select", { "aria-label": "Kind of view", onchange: () => this.switchTo(this.kind.value) },
      h("option", { value: "webgl" }, "3D"), h("option", { value: "pictures" }, "Pictures by the server"), h("option", { value: "depth" }, "Depth"));
    this.camerasButton = toggle("Cameras", (on) => this.toggleCameras(on));
    this.farButton = toggle("Hide far background", (on) => this.hideFar(on));
    this.turnButton = toggle("Turn slowly", (on) => this.turning?.turn(on));
    this.measure = new Measure(this);
    this.annotate = new Annotate(this);
    this.visitors = new Visitors(this);
    this.path = new CameraPath(this);
    this.edit = new Edit(this);
    this.scale = h("div", { class: "depth-scale number", hidden: true });
    byId("toolbar").append(this.kind,
      h("button", { type: "button", onclick: () => this.view?.goHome() }, "Start view"),
      shown.cameras.length ? this.camerasButton : "",
      this.shell ? this.farButton : "",
      this.turnButton,
      this.measure.button,
      this.measure.showButton,
      this.annotate.button,
      this.edit.button,
      this.path.button,
      this.visitors.button,
      h("button", { type: "button", onclick: () => void this.savePicture() }, "Save a picture"),
      document.fullscreenEnabled ? h("button", { type: "button", class: "push", onclick: () => void byId("viewer").requestFullscreen() }, "Full screen") : "");
    for (const { button, panel } of [this.measure, this.annotate, this.edit, this.path, this.visitors]) {
      button.addEventListener("click", () => !panel.hidden && panel.scrollIntoView({ block: "nearest" })); // on phones it lies below
    }
    byId("panels").append(this.scale, this.measure.panel, this.annotate.panel, this.edit.panel, this.path.panel, this.visitors.panel);
  }

  /** Open the view of a kind, with the camera of the one before. @param {"webgl" | "pictures" | "depth"} kind */
  async open(kind = "webgl") {
    const { shown } = this;
    const camera = this.view?.getCamera();
    this.view?.dispose();
    this.view = null;
    try {
      this.view = await openModel(byId("viewer"), { ...shown, presentation: this.presentation, gaussians: shown.model.gaussians, files: shown.model.files }, {
        kind,
        antialias: antialias(shown.report),
        background: shown.background,
        roam: this.shell ? ROAM * this.shell : ROAM_FREELY,
        label: shown.model.name || "The model",
      });
    } catch (error) {
      byId("viewer").append(noticeOf(/** @type {Error} */ (error)));
      return;
    }
    const { view } = this;
    this.kind.value = view.kind;
    if (camera) view.setCamera(camera);
    view.addEventListener("move", () => {
      if (!this.photo) return;
      this.photo = "";
      this.tell();
    });
    view.addEventListener("range", (event) => this.showScale(/** @type {CustomEvent} */ (event).detail));
    view.addEventListener("pick-camera", (event) => {
      const { name } = /** @type {CustomEvent} */ (event).detail;
      const photo = shown.cameras.find((entry) => entry.name === name);
      const keyframe = this.path.cameras.find((entry) => entry.name === name);
      if (photo) this.lookFrom(photo);
      else if (keyframe) view.setCamera(keyframe.camera);
    });
    this.turnButton.setAttribute("aria-pressed", "false");
    this.turning = new Turning(view, (on) => this.turnButton.setAttribute("aria-pressed", String(on)));
    this.scale.hidden = view.kind !== "depth";
    this.measure.attach(view);
    this.annotate.attach(view);
    this.path.attach(view);
    this.aim(null);
    this.edit.attach(view);
    this.toggleCameras(this.showing.cameras);
    this.hideFar(this.showing.hidden);
    this.farButton.hidden = view.kind !== "webgl";
    if (!this.lapse) {
      this.lapse = timeLapse(shown, this);
      if (this.lapse) byId("panels").prepend(this.lapse.element);
    }
    this.lapse?.available(view.kind === "webgl");
    byId("viewer").dataset.ready = view.kind;
  }

  /** Let clicks mark points where a tool wants them, which is one at a time. @param {Aim | null} tool that was turned on or off */
  aim(tool) {
    const tools = [this.measure, this.annotate];
    for (const other of tools) if (tool?.on && other !== tool && other.on) other.button.click();
    const on = tools.some((each) => each.on);
    byId("viewer").classList.toggle("aims", on);
    if (this.view) this.view.aims = on;
  }

  /** Change how the model is shown to people. @param {Partial<import("../viewer/presented.js").Presentation>} change */
  async save(change) {
    this.presentation = await send("PATCH", `${this.shown.address}/presentation`, change);
  }

  async savePicture() {
    try {
      if (this.view) await savePicture(this.view, this.shown.model.name || this.shown.model.id);
    } catch (error) {
      notify(/** @type {Error} */ (error));
    }
  }

  /** @param {string} kind */
  async switchTo(kind) {
    await this.open(/** @type {"webgl" | "pictures" | "depth"} */ (kind));
    this.view?.element.focus({ preventScroll: true });
  }

  /** @param {any} entry of the cameras */
  lookFrom(entry) {
    this.view?.setCamera(entry.camera);
    this.selected = this.photo = entry.name;
    this.toggleCameras(this.showing.cameras);
    byId("viewer").scrollIntoView({ block: "nearest" });
  }

  /** Say below the view what it shows, or else how it is moved. */
  tell() {
    this.note.textContent = this.photo ? `The view of ${this.photo}.`
      : this.showing.cameras ? "Blue: trained on. Orange: held out. Click the tip of a camera to look from there."
        : this.view?.whyNot || help();
  }

  /** @param {boolean} on */
  toggleCameras(on) {
    this.showing.cameras = on;
    const photos = on ? this.shown.cameras.map((entry) => ({
      name: entry.name, camera: entry.camera, selected: entry.name === this.selected,
      color: entry.split === "test" ? "#f0a061" : "#8fb2ff",
    })) : [];
    this.view?.showCameras([...photos, ...this.path.cameras]);
    this.tell();
  }

  /** @param {boolean} on */
  hideFar(on) {
    this.showing.hidden = on;
    this.view?.hideBeyond(on ? INSIDE * this.shell : null);
  }

  /** @param {{near: number, far: number}} range */
  showScale({ near, far }) {
    const bar = h("i");
    bar.style.background = GRADIENT;
    this.scale.replaceChildren(h("span", {}, this.measure.distance(near)), bar, h("span", {}, this.measure.distance(far)));
  }
}

/** Whether the plan of a report says that the model was trained with antialiasing. @param {any} report */
function antialias(report) {
  const decision = report.plan?.antialias;
  return Boolean(decision?.value ?? decision);
}
