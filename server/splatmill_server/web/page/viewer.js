/**
 * The viewer of models: splats in WebGL, or pictures by the server where a browser has none, with one interface.
 *
 *     const view = await open(container, { url: "/v1/models/ID/files/model.ply", model: "/v1/models/ID", cameras });
 *     view.frame(cameras[0]);
 *     await view.replace({ bytes });        // the camera stays
 *     view.showCameras([{ name, camera, color }]);
 *     const point = await view.pointAt(x, y); // in the coordinates of the model
 *     const file = await view.picture();
 *     view.addEventListener("move", () => view.getCamera());
 *     view.dispose();
 *
 * @import {Camera, Pose, Vec} from "./viewer/pose.js"
 * @import {Source} from "./viewer/source.js"
 * @import {LeftOut} from "./viewer/left_out.js"
 * @import {Line, ShownCamera} from "./viewer/overlay.js"
 */
import { bytes } from "./format.js";
import { depthOfPixel } from "./viewer/depth.js";
import { Pictures } from "./viewer/pictures_view.js";
import { Controls, help } from "./viewer/controls.js";
import { ViewerError } from "./viewer/errors.js";
import { Overlay } from "./viewer/overlay.js";
import { add, denseMiddle, dot, length, lookingAt, matrixOf, poseOf, projected, sub, surroundings, tangentsOf, times } from "./viewer/pose.js";
import { Splats, hasWebGL } from "./viewer/splats.js";

export { ViewerError };

/** Most pixels of the canvas per CSS pixel, and most pixels of the canvas: both bound the work of the graphics card. */
const MAX_RATIO = 2;
const MAX_PIXELS = 2560 * 1600;
/** Vertical field of view in degrees where no camera gives one. */
const FOV = 50;
/** Distances of the clipping planes, over the distance of the farthest camera from the cameras' mean. */
const NEAR = 0.002;
const FAR = 1e4;
/** Depth of the drawn frusta, over the same distance. */
const FRUSTUM = 0.07;
/** Cosine of the angle to the vertical below which a view looks straight down or up. */
const STEEP = 0.97;

/** Milliseconds in which the view turns to a point that was double-clicked. */
const TURN_MS = 350;

/**
 * @typedef {Object} Options
 * @property {string} [url]  address of a file of splats: .ply, compressed .ply or .sog
 * @property {(say: (text: string) => void, begun: Promise<unknown>) => Promise<Source>} [find]  finds the file, in place of an
 *   address; `begun` settles once the engine and the picture are loaded
 * @property {ArrayBuffer | Uint8Array | Blob} [bytes]  its bytes, in place of an address
 * @property {boolean} [levels]  whether it is a .lod.zip, whose parts are loaded one after the other
 * @property {Source} [whole]  the model in one file, where `find` may give one in parts
 * @property {string} [model]  address of a stored model, as /v1/models/{id}: the server renders it where there is no WebGL
 * @property {Camera[]} [cameras]  of the photos: they tell where up is, where to look, and how far away to be. Without
 *   any, -y is up, and the dense middle of the Gaussians is seen from the side
 * @property {import("./viewer/pose.js").Vec | null} [up]  the upward direction where it is known, in a scene whose origin
 *   is what `cameras` look at
 * @property {Camera} [camera]  to start from, exactly; left out, upright from the side of one of `cameras` whose view is
 *   close to the middle of all
 * @property {string} [poster]  address of a picture as `camera` sees it, shown until the model is drawn
 * @property {"webgl" | "pictures" | "depth"} [kind]  the kind of view; left out, webgl where the browser has it
 * @property {"black" | "white"} [background]  colour behind the model; left out, black
 * @property {boolean} [antialias]  whether the model was trained with antialiasing
 * @property {number} [roam]  how far the camera may leave the cameras' mean, over the farthest camera's distance from it
 * @property {string} [label]  what is seen, for people who do not see it
 */

/**
 * Show a model in an element, which needs a size of its own.
 * @param {HTMLElement} container @param {Options} options
 * @returns {Promise<View>}  rejects with a ViewerError, whose message is a sentence to show
 */
export async function open(container, options) {
  const view = new View(container, options);
  try {
    await view.begin();
  } catch (error) {
    view.dispose();
    throw error;
  }
  return view;
}

/**
 * A view. Events: `move` (the camera moved), `hand` (somebody moves it), `frame` (one was drawn), `pick` (x, y),
 * `pick-camera` (name), `trouble`.
 */
export class View extends EventTarget {
  /** @param {HTMLElement} container @param {Options} options */
  constructor(container, options) {
    super();
    this.container = container;
    this.options = options;
    /** @type {Vec} */
    this.up = [0, -1, 0];
    /** @type {Vec} */
    this.focus = [0, 0, 0];
    /** @type {Vec} */
    this.middle = [0, 0, 0];
    this.spread = 1;
    /** @type {{center: Vec, radius: number} | null} */
    this.limit = null;
    /** @type {Pose} */
    this.pose = lookingAt([0, 0, -3], this.focus, this.up);
    this.distance = 3;
    /** Half the width and height at distance 1 that have to be seen. */
    this.tangents = { x: 0, y: Math.tan((FOV * Math.PI) / 360) };
    /** Radius around the cameras' mean outside of which Gaussians are not drawn; null draws all. @type {number | null} */
    this.visible = null;
    /** @type {"webgl" | "pictures" | "depth"} */
    this.kind = "webgl";
    /** Why there is no WebGL view, a sentence; empty where there is one or none was asked for. */
    this.whyNot = "";
    this.frames = 0;
    this.pending = 0;
    this.resized = true;
    this.ratio = 1;
    /** Whether clicks mark points, so that a double click does not turn the view. */
    this.aims = false;
    this.home = this.pose;
    this.homeDistance = this.distance;
    this.homeTangents = this.tangents;
    /** @type {Splats | Pictures | null} */
    this.surface = null;
    /** @type {Promise<void> | undefined} */
    this.loadingWhole = undefined;

    this.element = document.createElement("div");
    this.element.className = "view";
    this.element.tabIndex = 0;
    this.element.setAttribute("role", "application");
    this.element.setAttribute("aria-roledescription", "3D view");
    this.element.setAttribute("aria-label", `${options.label ?? "The scene"}. ${help()}`);
    this.canvas = document.createElement("canvas");
    const over = document.createElement("canvas");
    this.overlay = new Overlay(over);
    this.poster = document.createElement("img");
    this.poster.alt = "";
    this.poster.decoding = "sync"; // otherwise the view is empty for one frame after it replaces the page's own picture
    this.poster.addEventListener("error", () => this.poster.remove());
    /** What of the model is missing, in words. */
    this.warning = "";
    /** What is being loaded, or why nothing is shown, in words. */
    this.said = document.createElement("p");
    this.said.className = "said";
    this.said.setAttribute("role", "status");
    this.element.append(this.canvas, over, this.said);
    if (options.poster) {
      this.poster.src = options.poster;
      this.element.append(this.poster);
    }
    container.append(this.element);
    this.controls = new Controls(this.element, this, {
      moved: () => {
        this.dispatchEvent(new Event("hand"));
        this.moved();
      },
      home: () => this.goHome(),
      picked: (x, y) => this.picked(x, y),
      twice: (x, y) => void this.lookAtPlace(x, y),
    });
    this.watch = new ResizeObserver(() => {
      this.resized = true;
      this.again();
    });
    this.watch.observe(this.element);
    if (options.cameras?.length) this.surround(options.cameras);
    if (options.camera) {
      this.setCamera(options.camera);
      this.tangents = tangentsOf(options.camera); // all that its picture shows is to be seen
      this.settle();
    }
  }

  /** Take over where the scene is from the cameras of its photos, and look at it unless somebody has moved the camera. @param {Camera[]} cameras @param {Options["up"]} [up] */
  surround(cameras, up = this.options.up) {
    const { pose, distance, tangents, home } = this;
    const { up: upward, focus, middle, spread } = surroundings(cameras, up);
    [this.up, this.focus, this.middle] = [upward, focus, middle];
    this.spread = spread || length(sub(focus, middle)) || 1;
    this.limit = this.options.roam ? { center: middle, radius: this.options.roam * this.spread } : null;
    this.overlay.size = FRUSTUM * this.spread;
    this.frame(mostCentral(cameras, focus));
    if (pose !== home) Object.assign(this, { pose, distance, tangents });
  }

  async begin() {
    const { options } = this;
    const kind = options.kind ?? "webgl";
    /** The model that `open` was asked for. @type {Source} */
    this.source = options;
    /** @type {Promise<Source> | undefined} */
    let source;
    if (kind === "webgl") {
      this.say("Loading the viewer");
      try {
        if (!hasWebGL()) throw new ViewerError("no_webgl", "This browser has no WebGL, which drawing in 3D needs.");
        const engine = Splats.open(this.canvas, {
          antialias: options.antialias,
          background: options.background === "white" ? [1, 1, 1] : [0, 0, 0],
          again: () => this.again(),
          drawn: () => this.poster.remove(),
          trouble: (message) => this.warn(message),
        });
        const begun = Promise.allSettled([engine, options.poster ? this.poster.decode() : null]);
        source = options.find?.((text) => this.say(text), begun);
        source?.catch(() => {}); // it is waited for below, unless the engine fails first
        this.surface = await engine;
      } catch (error) {
        if (!(error instanceof ViewerError) || !options.model) throw error;
        this.whyNot = `${error.message} The server renders pictures instead.`;
      }
    }
    if (!this.surface) {
      if (!options.model) throw new ViewerError("no_webgl", "Only a stored model can be shown without WebGL.");
      this.kind = kind === "depth" ? "depth" : "pictures";
      this.surface = new Pictures(this.canvas, {
        model: options.model,
        depth: this.kind === "depth",
        background: options.background,
        failed: (message) => {
          this.say(message);
          if (!message) this.poster.remove();
          this.dispatchEvent(new CustomEvent("trouble", { detail: message }));
        },
        range: (near, far) => this.dispatchEvent(new CustomEvent("range", { detail: { near, far } })),
      });
    }
    this.element.dataset.kind = this.kind;
    if (source && this.kind === "webgl") this.source = await source;
    this.say("");
    if (this.source.url || this.source.bytes || this.kind !== "webgl") await this.load(this.source);
    if (!options.camera && !options.cameras?.length && this.surface instanceof Splats) this.frameMiddle(this.surface.sample);
    this.again();
  }

  /**
   * Show another model, or this one as it is now; the camera stays.
   * @param {Source} source
   */
  async replace(source) {
    await this.load(source);
    this.again();
  }

  /** @param {Source} source */
  async load(source) {
    let told = this.surface instanceof Splats && source.url;
    const loading = `Loading ${source.what ?? "the model"}`;
    if (told) this.say(loading);
    try {
      await this.surface?.load(source, (done, total) => {
        if (told) this.say(`${loading}: ${bytes(done)}${total ? ` of ${bytes(total)}` : ""}`);
      });
    } finally {
      if (told) this.say("");
      told = undefined; // of a model in levels of detail, parts arrive later
    }
  }

  /** Say in the view what is being done; "" ends it. @param {string} text */
  say(text) {
    this.said.textContent = text || this.warning;
  }

  /** Say what is missing, until it is there (""). @param {string} text */
  warn(text) {
    const shown = [this.warning, ""].includes(this.said.textContent ?? "");
    this.warning = text;
    if (text || shown) this.say(text);
  }

  /** How many Gaussians are drawn; 0 where the server draws them. */
  get gaussians() {
    return this.surface?.gaussians ?? 0;
  }

  /** The positions of the Gaussians that are drawn, x, y and z in turn; null where the server draws them. */
  get points() {
    return this.surface instanceof Splats ? this.surface.points : null;
  }

  /** Whether the parts of the model are loaded as they are seen, so that the positions of all Gaussians are not known. */
  get inParts() {
    return this.surface instanceof Splats && this.surface.parts !== null;
  }

  /** Load all of a model that is shown in parts, and show it so from now on. */
  async loadWhole() {
    const { whole } = this.options;
    if (!this.inParts || !whole) return;
    await (this.loadingWhole ??= this.replace(whole).finally(() => {
      this.loadingWhole = undefined;
    }));
    this.source = whole;
  }

  /** Distance from the camera beyond which nothing is drawn. */
  get visibleDistance() {
    return this.visible === null ? Infinity : length(sub(this.pose.position, this.middle)) + this.visible;
  }

  /** The vertical field of view that shows what has to be seen, radians. */
  get fovY() {
    const aspect = this.canvas.clientWidth / Math.max(1, this.canvas.clientHeight) || 1;
    return 2 * Math.atan(Math.max(this.tangents.y, this.tangents.x / aspect));
  }

  /** The camera as the API writes it, at the size of the view in CSS pixels. @returns {Camera} */
  getCamera() {
    return {
      camera_to_world: matrixOf(this.pose),
      width: Math.max(1, Math.round(this.canvas.clientWidth)),
      height: Math.max(1, Math.round(this.canvas.clientHeight)),
      fov_y_deg: (this.fovY * 180) / Math.PI,
    };
  }

  /** Look exactly as a camera does. @param {Camera} camera */
  setCamera(camera) {
    this.pose = poseOf(camera);
    this.tangents = typeof camera.fov_y_deg === "number" ? { x: 0, y: tangentsOf(camera).y } : tangentsOf(camera);
    const ahead = dot(sub(this.focus, this.pose.position), this.pose.forward);
    this.distance = ahead > 0.05 * this.spread ? ahead : Math.max(length(sub(this.focus, this.pose.position)), 1e-3);
    this.moved();
  }

  /** Look from a camera's side: upright, towards the middle of the scene. It becomes the view of `goHome`. @param {Camera} camera */
  frame(camera) {
    const { position, down } = poseOf(camera);
    this.pose = lookingAt(position, this.focus, this.up);
    // Straight from above, no side is up: what is up in the photo is.
    if (Math.abs(dot(this.pose.forward, this.up)) > STEEP) this.pose = lookingAt(position, this.focus, times(down, -1));
    this.distance = Math.max(length(sub(this.focus, this.pose.position)), 1e-3);
    this.tangents = tangentsOf(camera);
    this.settle();
    this.moved();
  }

  /** Pixels of the view, in CSS pixels, per unit of length at distance 1. */
  get focal() {
    return this.canvas.clientHeight / 2 / Math.tan(this.fovY / 2);
  }

  /** Where a point is seen, in CSS pixels, and how far ahead it is. @param {Vec} point */
  project(point) {
    return projected(this.pose, point, this.focal, this.canvas.clientWidth, this.canvas.clientHeight);
  }

  /**
   * The point of the scene that is seen at a place of the view; null where there is nothing. Of a stored model, the
   * server's renderer measures it; of others, it is the nearest Gaussian that is not transparent there.
   * @param {number} x @param {number} y  CSS pixels
   * @returns {Promise<Vec | null>}
   */
  async pointAt(x, y) {
    const { pose, focal, canvas, surface } = this;
    const [dx, dy] = [(x - canvas.clientWidth / 2) / focal, (y - canvas.clientHeight / 2) / focal];
    const drawn = () => (surface instanceof Splats ? surface.depthAt(x * this.ratio, y * this.ratio) : null);
    const { model } = this.options;
    const depth = await (model ? depthOfPixel(model, pose, dx, dy, focal) : drawn());
    if (!depth) return null;
    return add(pose.position, times(add(pose.forward, add(times(pose.right, dx), times(pose.down, dy))), depth));
  }

  /** Turn to what is seen at a place, which becomes the point that the view turns about. @param {number} x @param {number} y */
  async lookAtPlace(x, y) {
    if (this.aims) return;
    const point = await this.pointAt(x, y).catch(() => null); // without the server, nothing is turned to
    if (point) this.lookAt(point);
  }

  /** Turn to a point, which becomes the one that the view turns about. @param {Vec} point */
  lookAt(point) {
    const { position, forward } = this.pose;
    const before = add(position, times(forward, this.distance));
    const still = matchMedia("(prefers-reduced-motion: reduce)").matches;
    const began = performance.now();
    /** @param {number} now */
    const step = (now) => {
      if (this.pose.position !== position) return; // somebody has moved the camera
      const share = still ? 1 : Math.min(1, (now - began) / TURN_MS);
      const target = add(times(before, 1 - share), times(point, share));
      this.pose = { ...lookingAt(position, target, this.up), position };
      this.distance = Math.max(length(sub(target, position)), 1e-3);
      this.moved();
      if (share < 1 && this.surface) requestAnimationFrame(step);
    };
    step(began);
  }

  /** The view as a picture, without what is drawn over it. @returns {Promise<Blob>} a PNG */
  picture() {
    cancelAnimationFrame(this.pending);
    this.draw(); // what WebGL drew is there until the browser shows it
    return new Promise((resolve, reject) => {
      this.canvas.toBlob((blob) => (blob ? resolve(blob) : reject(new Error("The browser made no picture of the view."))), "image/png");
    });
  }

  /** Make the present view that of `goHome`. */
  settle() {
    [this.home, this.homeDistance, this.homeTangents] = [this.pose, this.distance, this.tangents];
  }

  /** Look at the dense middle of a scene without cameras from the side. @param {Float32Array | null} points */
  frameMiddle(points) {
    if (!points?.length) return;
    const { focus, reach } = denseMiddle(points);
    [this.focus, this.middle, this.spread] = [focus, focus, reach];
    this.overlay.size = FRUSTUM * reach;
    this.pose = lookingAt([focus[0], focus[1] - 0.5 * reach, focus[2] - 2.5 * reach], focus, this.up);
    this.distance = length(sub(focus, this.pose.position));
    this.settle();
    this.moved();
  }

  goHome() {
    [this.pose, this.distance, this.tangents] = [this.home, this.homeDistance, this.homeTangents];
    this.moved();
  }

  /**
   * Leave out Gaussians whose centres lie outside of a sphere around the cameras' mean, as those of the far shell do.
   * Pictures by the server show them.
   * @param {number | null} radius  over the farthest camera's distance from the mean; null shows everything
   */
  hideBeyond(radius) {
    this.visible = radius === null ? null : radius * this.spread;
    this.again();
  }

  /**
   * Show what an edit would leave out, dimmed or not at all; null shows everything as ever. Pictures by the server do not.
   * @param {LeftOut | null} limits
   */
  leaveOut(limits) {
    this.limits = limits;
    if (this.surface instanceof Splats) this.surface.leaveOut(limits);
    this.again();
  }

  /** Draw cameras as frusta. @param {ShownCamera[]} cameras */
  showCameras(cameras) {
    this.overlay.cameras = cameras;
    this.again();
  }

  /** Draw lines, marked points and a box. @param {{lines?: Line[], paths?: Line[], points?: Vec[], box?: {min: Vec, max: Vec} | null}} marks */
  mark(marks) {
    Object.assign(this.overlay, marks);
    this.again();
  }

  moved() {
    this.dispatchEvent(new Event("move"));
    this.again();
  }

  /** @param {number} x @param {number} y */
  picked(x, y) {
    const camera = this.overlay.cameraAt(x, y);
    const detail = camera ? { name: camera.name } : { x, y };
    this.dispatchEvent(new CustomEvent(camera ? "pick-camera" : "pick", { detail }));
  }

  /** Ask for a frame; several calls before it give one. */
  again() {
    if (!this.pending && this.surface) this.pending = requestAnimationFrame(() => this.draw());
  }

  draw() {
    this.pending = 0;
    const { surface, canvas, element } = this;
    const [width, height] = [element.clientWidth, element.clientHeight];
    if (!surface || !width || !height) return;
    if (this.resized) {
      this.resized = false;
      const ratio = Math.min(devicePixelRatio || 1, MAX_RATIO, Math.sqrt(MAX_PIXELS / (width * height)));
      this.ratio = ratio;
      surface.resize(Math.max(1, Math.round(width * ratio)), Math.max(1, Math.round(height * ratio)));
      [this.overlay.canvas.width, this.overlay.canvas.height] = [canvas.width, canvas.height];
    }
    const sphere = this.visible === null ? null : { center: this.middle, radius: this.visible };
    surface.draw(this.pose, this.fovY, { near: NEAR * this.spread, far: FAR * this.spread }, sphere);
    this.overlay.draw(this.pose, height / 2 / Math.tan(this.fovY / 2), this.ratio);
    this.frames += 1;
    element.dataset.frames = `${this.frames}`;
    element.dataset.settled = `${surface.settled}`;
    this.dispatchEvent(new Event("frame"));
  }

  /** Release the graphics context, the listeners and the elements. */
  dispose() {
    cancelAnimationFrame(this.pending);
    this.watch.disconnect();
    this.controls.dispose();
    this.surface?.dispose();
    this.surface = null;
    this.element.remove();
  }
}

/**
 * The camera whose axis passes nearest to a point, as an angle.
 * @param {Camera[]} cameras @param {Vec} point
 */
function mostCentral(cameras, point) {
  let best = cameras[0];
  let most = -Infinity;
  for (const camera of cameras) {
    const pose = poseOf(camera);
    const offset = sub(point, pose.position);
    const cosine = dot(offset, pose.forward) / Math.max(length(offset), 1e-12);
    if (cosine > most) [best, most] = [camera, cosine];
  }
  return best;
}
