// What a job shows while it runs: the scene in training, its cameras and points, or the newest preview picture.

import { at } from "../address.js";
import { Problem, request, whole } from "../api.js";
import { h } from "../dom.js";
import { bytes, number } from "../format.js";
import { viewerInstalled } from "../shell.js";
import { ViewerError, open } from "../viewer.js";
import { colorOf } from "./photos.js";
import { PlacementView } from "./placement_view.js";

const KINDS = /** @type {const} */ ({ scene: "Scene", cameras: "Cameras and points", picture: "Preview picture" });

/** @typedef {keyof typeof KINDS} Kind */

export class LiveScene {
  /** @param {HTMLElement} container @param {string} jobId */
  constructor(container, jobId) {
    this.address = at(`/v1/jobs/${encodeURIComponent(jobId)}`);
    /** @type {Kind | null} */
    this.kind = null;
    /** What somebody has chosen; null: the most telling kind that there is. @type {Kind | null} */
    this.chosen = null;
    /** @type {import("../viewer.js").View | null} */
    this.view = null;
    /** @type {PlacementView | null} */
    this.placementView = null;
    /** @type {any} */
    this.placement = null;
    /** @type {import("../viewer/overlay.js").ShownCamera[]} */
    this.cameras = [];
    /** Why there is no 3D view of the scene; empty while there may be one. */
    this.trouble = viewerInstalled ? "" : "The 3D viewer is not installed on this server.";
    this.tag = "";
    /** Whether the view knows the cameras. */
    this.surrounded = false;
    this.busy = false;
    this.again = false;
    this.picture = h("img", { alt: "The scene in training from the position of one photo", hidden: true });
    this.picture.addEventListener("load", () => this.arrange());
    this.picture.addEventListener("error", () => { this.picture.removeAttribute("src"); this.arrange(); });
    this.boxes = {
      scene: h("div", { class: "box", hidden: true }),
      cameras: h("div", { class: "box", hidden: true }),
      picture: h("div", { class: "box", hidden: true }, this.picture),
    };
    this.empty = h("p", { class: "waiting muted" });
    this.caption = h("p", { class: "small muted caption" });
    this.frusta = h("input", { type: "checkbox", id: "show-frusta", onchange: () => this.showFrusta() });
    this.buttons = /** @type {Record<Kind, HTMLButtonElement>} */ (Object.fromEntries(Object.entries(KINDS).map(([kind, title]) =>
      [kind, h("button", { type: "button", class: "small", "aria-pressed": "false", hidden: true, onclick: () => this.choose(/** @type {Kind} */ (kind)) }, title)])));
    this.homeButton = h("button", { type: "button", class: "small", hidden: true, onclick: () => this.view?.goHome() }, "Start view");
    this.frustaField = h("label", { class: "row small check", for: "show-frusta", hidden: true }, this.frusta, "Show the cameras");
    container.replaceChildren(
      h("div", { class: "row tools" }, h("div", { class: "row", role: "group", "aria-label": "What is shown" }, Object.values(this.buttons)), this.homeButton, this.frustaField),
      h("div", { class: "stage" }, this.empty, Object.values(this.boxes)),
      this.caption);
  }

  /** Say why the view is empty. @param {boolean} coming whether there is something, which is being loaded */
  expect(coming) {
    const text = coming ? "Loading" : "Nothing can be seen yet: cameras come first, then the scene.";
    if (this.empty.textContent !== text) this.empty.textContent = text;
  }

  /** @param {Kind} kind */
  choose(kind) {
    this.chosen = kind;
    this.arrange();
  }

  /** Whether there is something of a kind. @param {Kind} kind */
  has(kind) {
    if (kind === "scene") return this.view !== null;
    if (kind === "cameras") return this.placement !== null;
    return this.picture.hasAttribute("src") && this.picture.complete && this.picture.naturalWidth > 0;
  }

  /** Show what is chosen, or else the most telling kind. */
  arrange() {
    const there = /** @type {Kind[]} */ (["scene", "picture", "cameras"]).filter((kind) => this.has(kind));
    this.kind = this.chosen && there.includes(this.chosen) ? this.chosen : there[0] ?? null;
    for (const kind of /** @type {Kind[]} */ (Object.keys(KINDS))) {
      this.boxes[kind].hidden = kind !== this.kind;
      this.buttons[kind].hidden = !there.includes(kind);
      this.buttons[kind].setAttribute("aria-pressed", String(kind === this.kind));
    }
    this.picture.hidden = !this.has("picture");
    this.empty.hidden = this.kind !== null;
    this.homeButton.hidden = this.kind !== "scene";
    this.frustaField.hidden = this.kind !== "scene" || !this.cameras.length;
    this.showPlacement();
    this.describe();
  }

  describe() {
    const parts = [];
    if (this.kind === "scene" && this.event) {
      const { step, gaussians, shown, bytes: size } = this.event;
      parts.push(`The scene after ${number(step)} steps: ${number(gaussians)} Gaussians, ${bytes(size)}, still without the gloss of surfaces.`);
      if (shown < 0.9 * gaussians) parts.push(`The ${number(shown)} that cover the most are shown.`);
    }
    if (this.kind === "picture") parts.push("The newest picture that the training made of itself.", this.trouble);
    this.caption.textContent = parts.filter(Boolean).join(" ");
  }

  /** @param {any} placement @param {Map<string, {kind: any}>} kinds */
  setPlacement(placement, kinds) {
    this.placement = placement.cameras.length ? placement : null;
    this.cameras = placement.cameras.map((/** @type {any} */ { name, camera }) => ({ name, camera, color: colorOf(this.empty, kinds.get(name)?.kind ?? "train") }));
    this.stale = true;
    this.surround();
    this.arrange();
    this.showFrusta();
  }

  /** Let the cameras say where the scene is seen from, once. A snapshot may come before them, as after a reload. */
  surround() {
    if (!this.view || this.surrounded || !this.cameras.length) return;
    this.surrounded = true;
    this.view.surround(this.cameras.map(({ camera }) => camera), this.placement?.up);
  }

  showPlacement() {
    if (this.kind !== "cameras" || !this.placement) return;
    this.placementView ??= new PlacementView(this.boxes.cameras);
    if (this.stale) this.placementView.show(this.placement, this.cameras);
    this.stale = false;
  }

  showFrusta() {
    this.view?.showCameras(this.frusta.checked ? this.cameras : []);
  }

  /** @param {number} count number of previews so far */
  newPreview(count) {
    // The number makes the address new, since browsers show a picture that they hold without asking for it again.
    this.picture.src = `${this.address}/preview?number=${count}`;
  }

  /** Fetch and show the newest snapshot, and once more if another was announced meanwhile. @param {any} event */
  async newSnapshot(event) {
    if (this.trouble) return;
    this.announced = event;
    this.again = true;
    if (this.busy) return;
    this.busy = true;
    try {
      while (this.again) {
        this.again = false;
        await this.fetchSnapshot();
      }
    } finally {
      this.busy = false;
    }
  }

  async fetchSnapshot() {
    const event = this.announced;
    let answer, snapshot;
    try {
      answer = await request("GET", `${this.address}/snapshot`, { headers: this.tag ? { "If-None-Match": this.tag } : {} });
      snapshot = await whole(answer.arrayBuffer());
    } catch (error) {
      if (error instanceof Problem && [0, 404, 503].includes(error.status)) return; // it expired, or the next one follows
      throw error;
    }
    if (answer.status === 304) return;
    this.tag = answer.headers.get("ETag") ?? "";
    try {
      await this.draw(snapshot);
    } catch (error) {
      if (!(error instanceof ViewerError)) throw error;
      this.trouble = error.message;
    }
    this.event = event;
    this.arrange();
  }

  stand() {
    this.boxes.scene.dataset.pose = this.view?.getCamera().camera_to_world.flat().map((x) => x.toPrecision(5)).join(" ");
  }

  /** @param {ArrayBuffer} snapshot */
  async draw(snapshot) {
    const source = { bytes: snapshot };
    if (this.view) {
      await this.view.replace(source);
    } else {
      this.boxes.scene.hidden = false; // the viewer takes its size from the box
      const cameras = this.cameras.map(({ camera }) => camera);
      this.view = await open(this.boxes.scene, { ...source, cameras, up: this.placement?.up, label: "The scene in training" });
      this.surrounded = cameras.length > 0;
      this.surround();
      this.surrounded = this.cameras.length > 0;
      // Where the camera stands can be read off the page: it must not change with a snapshot.
      this.view.addEventListener("move", () => this.stand());
      this.stand();
      this.showFrusta();
    }
    this.boxes.scene.dataset.snapshots = String(Number(this.boxes.scene.dataset.snapshots ?? 0) + 1);
  }
}
