/**
 * Draws Gaussians with PlayCanvas on a WebGL canvas. A frame is drawn when one is asked for, and when the splats have
 * been sorted anew, so that a view that nobody moves costs nothing.
 *
 * @import {LeftOut} from "./left_out.js"
 * @import {Parts} from "./parts.js"
 * @import {Pose, Vec} from "./pose.js"
 * @import {Source} from "./source.js"
 */
import { ViewerError } from "./errors.js";
import { MODIFIER, parametersOf } from "./left_out.js";
import { ROW } from "./selection.js";
import { opened } from "./source.js";

/** A mask without any Gaussian. */
const NOTHING = new Uint8Array(ROW);

/** More levels than a model has: the coarsest is drawn until finer ones are there. */
const ALL_LEVELS = 100;
/** Name of a uniform: the centre and radius of the sphere outside of which nothing is drawn; radius 0 draws all. */
const SPHERE = "visible_sphere";

/** Whether this browser draws with WebGL 2. */
export function hasWebGL() {
  const canvas = document.createElement("canvas");
  const gl = canvas.getContext("webgl2");
  gl?.getExtension("WEBGL_lose_context")?.loseContext();
  return gl !== null;
}

export class Splats {
  /**
   * @param {HTMLCanvasElement} canvas
   * @param {{antialias?: boolean, background?: [number, number, number], again: () => void, drawn: () => void, trouble: (message: string) => void}} options
   *   antialias: whether the model was trained with antialiasing. again: called when another frame has to be drawn.
   *   drawn: called when a frame shows a model. trouble: called with a sentence when a part of a model is given up.
   * @returns {Promise<Splats>}
   */
  static async open(canvas, options) {
    let pc;
    try {
      pc = await import("playcanvas");
    } catch (error) {
      throw new ViewerError(
        "no_engine",
        "The 3D engine of this page could not be loaded. The server was installed without it: `make install` fetches it.",
        { cause: error },
      );
    }
    let device;
    try {
      device = await pc.createGraphicsDevice(canvas, { deviceTypes: [pc.DEVICETYPE_WEBGL2], antialias: false });
    } catch (error) {
      throw new ViewerError("no_webgl", "This browser has no WebGL, which drawing in 3D needs.", { cause: error });
    }
    return new Splats(pc, canvas, device, options);
  }

  /** @param {any} pc @param {HTMLCanvasElement} canvas @param {any} device @param {any} options */
  constructor(pc, canvas, device, options) {
    this.pc = pc;
    this.canvas = canvas;
    this.again = options.again;
    this.drawn = options.drawn;
    this.trouble = options.trouble;
    this.sorted = false;
    /** Whether the last frame has all details that are to be seen from where it was drawn. */
    this.settled = false;
    const settings = new pc.AppOptions();
    settings.graphicsDevice = device;
    settings.componentSystems = [pc.CameraComponentSystem, pc.GSplatComponentSystem];
    // A .sog is a bundle of images, which are read as textures.
    settings.resourceHandlers = [pc.GSplatHandler, pc.TextureHandler];
    this.app = new pc.AppBase(canvas);
    this.app.init(settings);
    this.app.autoRender = false;
    const [r, g, b] = options.background ?? [0, 0, 0];
    // Without an app, an entity belongs to the last one of the page, which may be that of another view.
    this.eye = new pc.Entity("camera", this.app);
    this.eye.addComponent("camera", { clearColor: new pc.Color(r, g, b, 1), toneMapping: pc.TONEMAP_NONE });
    this.app.root.addChild(this.eye);
    // Exact pictures before fast ones: colours follow every movement, and small Gaussians are drawn too.
    const gsplat = this.app.scene.gsplat;
    gsplat.colorUpdateAngle = 0;
    gsplat.minPixelSize = 0;
    gsplat.useTonemap = false;
    gsplat.useFog = false;
    gsplat.antiAlias = options.antialias ?? false;
    gsplat.dataFormat = pc.GSPLATDATA_LARGE;
    gsplat.lodUnderfillLimit = ALL_LEVELS;
    changeShaders(pc, device);
    gsplat.material.update();
    this.app.start();
    cancelAnimationFrame(this.app.frameRequestId);
    this.app.scene.on("gsplat:sorted", () => {
      this.sorted = true;
      this.again();
    });
    this.app.systems.gsplat.on("frame:request", () => this.again());
    this.app.systems.gsplat.on("frame:ready", (/** @type {any} */ _camera, /** @type {any} */ _layer, /** @type {boolean} */ ready, /** @type {number} */ pending) => {
      this.settled = ready && pending === 0;
    });
    device.on("devicerestored", () => this.again());
    /** @type {any} */
    this.splats = null;
    /** @type {any} */
    this.picker = null;
    /** @type {LeftOut | null} */
    this.limits = null;
    /** The mask in `texture`. @type {Uint8Array | null} */
    this.mask = null;
    /** @type {any} */
    this.texture = null;
    this.gaussians = 0;
    this.loads = 0;
    /** The parts of a model in levels of detail; null where the model is loaded whole. @type {Parts | null} */
    this.parts = null;
  }

  /**
   * Show another model; the one before stays until it is there.
   * @param {Source} source
   * @param {(done: number, total: number) => void} [progress]  bytes loaded, and all bytes, 0 where they are not known
   */
  async load(source, progress) {
    const { pc, app } = this;
    const parts = source.levels ? await (await import("./parts.js")).Parts.open(this, source, progress) : null;
    const asset = parts?.asset ?? (await this.whole(source, progress));
    if (!this.app) {
      parts?.chunks.destroy();
      return;
    }
    const { splats: before, parts: others } = this;
    const splats = (this.splats = new pc.Entity("splats", app));
    splats.addComponent("gsplat", { asset });
    app.root.addChild(splats);
    this.leaveOut(this.limits);
    [this.parts, this.gaussians] = [parts, asset.resource.gsplatData?.numSplats ?? asset.resource.numSplats];
    try {
      await parts?.firstPicture(splats);
    } catch (error) {
      if (this.app) {
        this.end(splats);
        [this.splats, this.parts] = [before, others];
      }
      throw error;
    }
    if (!this.app) return;
    if (before) this.end(before);
    this.again();
  }

  /** @param {any} splats  an entity with a model */
  end(splats) {
    const asset = this.app.assets.get(splats.gsplat.asset);
    splats.destroy();
    this.drop(asset);
  }

  /** @param {any} asset */
  drop(asset) {
    this.app?.assets.remove(asset);
    asset.unload();
  }

  /** The asset of a model that is loaded whole. @param {Source} source @param {(done: number, total: number) => void} [progress] */
  async whole(source, progress) {
    const { format, contents } = await opened(source);
    return this.app && this.asset(format, contents, progress);
  }

  /**
   * The asset of a file that is there.
   * @param {string} format @param {Response} contents
   * @param {(done: number, total: number) => void} [progress]
   */
  async asset(format, contents, progress) {
    // PlayCanvas keeps what it loads by its address, so that each model needs another one.
    const url = `model-${(this.loads += 1)}.${format}`;
    const asset = new this.pc.Asset(url, "gsplat", { url, filename: url, contents });
    if (progress) asset.on("progress", progress);
    return this.added(asset, () => asset.resource.gsplatData.numSplats);
  }

  /** Load an asset, which has Gaussians. @param {any} asset @param {() => number} count */
  async added(asset, count) {
    try {
      await loaded(this.app.assets, asset);
      if (this.app && !(count() > 0)) throw new ViewerError("empty", "The model has no Gaussians, so there is nothing to draw.");
    } catch (error) {
      this.drop(asset);
      throw error;
    }
    return asset;
  }

  /** The positions of all Gaussians, x, y and z in turn; null where the model is not loaded whole. @returns {Float32Array | null} */
  get points() {
    return this.app?.assets.get(this.splats?.gsplat.asset)?.resource.centers ?? null;
  }

  /** The positions of Gaussians that are spread as all are: of all, or of a chunk. @returns {Float32Array | null} */
  get sample() {
    return this.points ?? this.parts?.sample ?? null;
  }

  /** Show what an edit would leave out, dimmed or not at all; null shows everything as ever. @param {LeftOut | null} limits */
  leaveOut(limits) {
    const changed = limits !== null || this.limits !== null;
    this.limits = limits;
    const component = this.splats?.gsplat;
    if (!component || !changed) return;
    component.setWorkBufferModifier(limits && { glsl: MODIFIER });
    if (limits) component.setParameter("left_out_mask", this.textureOf(limits.mask ?? NOTHING));
    for (const [name, value] of Object.entries(limits ? parametersOf(limits) : {})) component.setParameter(name, value);
    component.workBufferUpdate = this.pc.WORKBUFFER_UPDATE_ONCE;
  }

  /** The texture of a mask, which takes the place of the one before. @param {Uint8Array} mask  in rows of ROW */
  textureOf(mask) {
    const { pc, app } = this;
    if (this.mask !== mask) {
      this.texture?.destroy();
      this.texture = pc.Texture.createDataTexture2D(app.graphicsDevice, "mask", ROW, mask.length / ROW, pc.PIXELFORMAT_R8, [mask]);
      this.mask = mask;
    }
    return this.texture;
  }

  /** @param {number} width @param {number} height  of the drawing buffer, in pixels */
  resize(width, height) {
    this.app.graphicsDevice.setResolution(width, height);
  }

  /**
   * Draw a frame.
   * @param {Pose} pose @param {number} fovY  vertical field of view, radians
   * @param {{near: number, far: number}} clip  distances of the clipping planes
   * @param {{center: Vec, radius: number} | null} sphere  draw only Gaussians whose centres lie in it; null draws all
   */
  draw(pose, fovY, { near, far }, sphere) {
    const { pc, app, eye } = this;
    const scope = app.graphicsDevice.scope;
    scope.resolve(SPHERE).setValue(sphere ? [...sphere.center, sphere.radius] : [0, 0, 0, 0]);
    const { right, down, forward, position } = pose;
    const world = new pc.Mat4();
    // PlayCanvas's cameras have OpenGL axes: y up, z backward.
    world.set([
      ...right, 0,
      ...down.map((x) => -x), 0,
      ...forward.map((x) => -x), 0,
      ...position, 1,
    ]); // prettier-ignore
    eye.setPosition(...position);
    eye.setRotation(new pc.Quat().setFromMat4(world));
    eye.camera.fov = (fovY * 180) / Math.PI;
    eye.camera.nearClip = near;
    eye.camera.farClip = far;
    app.renderNextFrame = true;
    app.tick(performance.now());
    cancelAnimationFrame(app.frameRequestId); // the viewer decides when the next frame is drawn
    if (this.sorted && !this.parts?.early) this.drawn();
    this.parts?.drawn();
  }

  /**
   * How far ahead the nearest Gaussian is that is seen at a pixel; null where there is none.
   * @param {number} x @param {number} y  pixels of the canvas
   * @returns {Promise<number | null>}
   */
  async depthAt(x, y) {
    const { app, pc, canvas, eye } = this;
    this.picker ??= new pc.Picker(app, canvas.width, canvas.height, true);
    this.picker.resize(canvas.width, canvas.height);
    this.picker.prepare(eye.camera, app.scene);
    const point = await this.picker.getWorldPointAsync(x, y);
    return point ? point.sub(eye.getPosition()).dot(eye.forward) : null;
  }

  dispose() {
    this.picker?.destroy();
    this.texture?.destroy();
    const { app } = this;
    this.app = null;
    app?.destroy();
  }
}

/**
 * Load an asset of PlayCanvas. Of a .sog, the images are assets too, and PlayCanvas continues without those that fail.
 * @param {any} assets @param {any} asset
 */
async function loaded(assets, asset) {
  let problem = "";
  const failed = (/** @type {unknown} */ error, /** @type {any} */ part) => {
    if (part.type === "texture") problem ||= `${part.name}: ${error}`;
    else if (part === asset) problem ||= `${error}`;
  };
  assets.on("error", failed);
  try {
    await new Promise((resolve) => {
      asset.once("load", resolve);
      asset.once("error", resolve);
      assets.add(asset);
      assets.load(asset);
    });
  } finally {
    assets.off("error", failed);
  }
  if (!problem) return;
  const why = `its file is damaged, incomplete or without Gaussians (${problem})`;
  throw new ViewerError("unreadable", `The model could not be read: ${why}.`);
}

/**
 * Change PlayCanvas' shaders in two ways.
 *
 * Gaussians are drawn as they were trained: PlayCanvas lets them end at 2.8 standard deviations and lowers the whole
 * curve, so that it is zero there, which costs two to three dB against our renderer (docs/web.md). Here they end where
 * their opacity falls under 1/255.
 *
 * Those outside of a sphere can be left out. A far plane does not do it: PlayCanvas draws what lies beyond onto it.
 * @param {any} pc @param {any} device
 */
function changeShaders(pc, device) {
  const chunks = pc.ShaderChunks.get(device, pc.SHADERLANGUAGE_GLSL);
  for (const [chunk, before, after] of [
    ["gsplatPS", "(exp(x * -4.0) - EXP4) * INV_EXP4", "exp(x * -4.0)"],
    ["gsplatPS", "A > 1.0", "A > 1.5"],
    ["gsplatCommonVS", "min(1.0, sqrt(max(0.0, log(alpha / alphaClipValue))) * 0.5)", "sqrt(max(0.0, log(alpha / alphaClipValue))) * 0.5"],
    ["gsplatVS", "void main(void) {", `uniform vec4 ${SPHERE};\nvoid main(void) {`],
    ["gsplatVS", "if (!initCenter(modelCenter, center)) {",
      `if (${SPHERE}.w > 0.0 && distance(modelCenter, ${SPHERE}.xyz) > ${SPHERE}.w || !initCenter(modelCenter, center)) {`],
  ]) {
    const source = chunks.get(chunk);
    // The lock file fixes the version of PlayCanvas; a newer one with other shaders has to be looked at.
    if (!source?.includes(before)) throw new Error(`PlayCanvas ${pc.version}: no ${before} in its shader ${chunk}.`);
    chunks.set(chunk, source.replace(before, after));
  }
}
