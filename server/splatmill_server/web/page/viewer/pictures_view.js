/**
 * The view without WebGL: pictures of a stored model by the server's renderer, `GET /v1/models/{id}/render`. While the
 * camera moves they are small; when it rests, one of full size follows. One request is in flight at a time.
 *
 * @import {Pose} from "./pose.js"
 */
import { matrixOf } from "./pose.js";
import { depthColors, readArray } from "./depth.js";

/** Longer side of a picture while the camera moves, and most for one at rest, pixels. */
const MOVING = 320;
const RESTING = 1280;
/** Milliseconds without a movement after which a picture of full size is requested. */
const REST = 250;
/** Milliseconds to wait after a refusal that names no time. */
const RETRY = 2000;

/** @typedef {{pose: Pose, tan: number}} Shot  a pose, and half the height of its picture at distance 1 */

export class Pictures {
  /**
   * @param {HTMLCanvasElement} canvas
   * @param {{model: string, depth?: boolean, background?: string, failed: (message: string) => void,
   *   range?: (near: number, far: number) => void}} options
   *   model: address of the model, as /v1/models/{id}. depth: show the distance in place of the colour.
   *   failed: gets a sentence when no picture comes, and an empty one when one comes again.
   *   range: gets the distances that the ends of the colour scale stand for.
   */
  constructor(canvas, options) {
    this.canvas = canvas;
    this.options = options;
    this.size = { width: 1, height: 1 };
    /** @type {Shot | null} */
    this.wanted = null;
    this.shown = "";
    this.busy = false;
    this.timer = 0;
    this.moved = 0;
    this.ended = new AbortController();
    this.pictures = 0;
    this.gaussians = 0;
    this.settled = true;
  }

  /** The stored model is shown, whatever the source; a changed one is found by its ETag. */
  async load() {
    this.shown = "";
    if (this.wanted) this.next();
  }

  /** @param {number} width @param {number} height */
  resize(width, height) {
    this.size = { width, height };
    const before = this.canvas.width > 1 ? createCopy(this.canvas) : null;
    this.canvas.width = width;
    this.canvas.height = height;
    if (before) this.canvas.getContext("2d")?.drawImage(before, 0, 0, width, height);
  }

  /** @param {Pose} pose @param {number} fovY  radians */
  draw(pose, fovY) {
    this.wanted = { pose, tan: Math.tan(fovY / 2) };
    this.moved = performance.now();
    this.next();
  }

  /** Request what is wanted and not yet shown. */
  next() {
    if (this.busy || !this.wanted || this.ended.signal.aborted) return;
    clearTimeout(this.timer);
    const rest = this.moved + REST - performance.now();
    const side = rest > 0 ? MOVING : RESTING;
    const query = this.query(this.wanted, side);
    if (query === this.shown) {
      // A small picture of this view is there. The large one waits until the camera rests.
      if (rest > 0) this.timer = window.setTimeout(() => this.next(), rest);
      return;
    }
    this.busy = true;
    this.fetch(query)
      .then((wait) => {
        this.busy = false;
        if (wait === 0) this.next();
        else this.timer = window.setTimeout(() => this.next(), wait);
      })
      .catch(() => (this.busy = false));
  }

  /** @param {Shot} shot @param {number} side */
  query({ pose, tan }, side) {
    const scale = Math.min(1, side / Math.max(this.size.width, this.size.height));
    const width = Math.max(1, Math.round(this.size.width * scale));
    const height = Math.max(1, Math.round(this.size.height * scale));
    const fields = new URLSearchParams({
      width: `${width}`,
      height: `${height}`,
      fov_y_deg: `${(2 * Math.atan(tan) * 180) / Math.PI}`,
      ...(this.options.depth
        ? { output: "depth", format: "npy" }
        : { format: "jpeg", quality: side === MOVING ? "75" : "92", background: this.options.background ?? "black" }),
      camera_to_world: matrixOf(pose).flat().join(","),
    });
    return `${fields}`;
  }

  /**
   * Fetch one picture and show it.
   * @param {string} query
   * @returns {Promise<number>} milliseconds to wait before the next request
   */
  async fetch(query) {
    let answer, body;
    try {
      answer = await fetch(`${this.options.model}/render?${query}`, { signal: this.ended.signal });
      body = await answer.blob();
    } catch (error) {
      if (this.ended.signal.aborted) throw error;
      this.options.failed("The server could not be reached for a picture; another attempt follows.");
      return RETRY;
    }
    if (!answer.ok) {
      const problem = await new Response(body).json().catch(() => ({}));
      this.options.failed(problem.detail ?? `The server answered ${answer.status} in place of a picture.`);
      if (answer.status !== 503 && answer.status !== 429 && answer.status !== 504) {
        this.shown = query; // the same request would fail again
        return 0;
      }
      return 1000 * Number(answer.headers.get("Retry-After")) || RETRY;
    }
    const context = this.canvas.getContext("2d");
    if (this.options.depth) {
      const { data, shape } = readArray(await body.arrayBuffer());
      const { pixels, near, far } = depthColors(data);
      const picture = await createImageBitmap(new ImageData(pixels, shape[1], shape[0]));
      context?.drawImage(picture, 0, 0, this.canvas.width, this.canvas.height);
      this.options.range?.(near, far);
    } else {
      const picture = await createImageBitmap(body);
      context?.drawImage(picture, 0, 0, this.canvas.width, this.canvas.height);
      picture.close();
    }
    this.options.failed("");
    this.shown = query;
    this.pictures += 1;
    this.canvas.dataset.shown = query;
    return 0;
  }

  dispose() {
    clearTimeout(this.timer);
    this.ended.abort();
  }
}

/** @param {HTMLCanvasElement} canvas */
function createCopy(canvas) {
  const copy = document.createElement("canvas");
  [copy.width, copy.height] = [canvas.width, canvas.height];
  copy.getContext("2d")?.drawImage(canvas, 0, 0);
  return copy;
}
