/**
 * A model in levels of detail, which PlayCanvas draws from the parts that are there.
 *
 * @import {Source} from "./source.js"
 * @import {Splats} from "./splats.js"
 */
import { Chunks } from "./chunks.js";
import { INDEX, Pieces } from "./pieces.js";

/** Updates after a frame, without drawing, in which levels are chosen; PlayCanvas does that in every tenth. */
const UPDATES = 12;
/** Frames that are drawn at most until PlayCanvas says that nothing is to come, where nothing is being loaded. */
const LOOKS = 5;
/** Over the size of the scene: how far the camera moves until levels are chosen anew, and up to where they are fine. */
const STEP = 0.02;
const NEAR = 0.25;
/** What the view says of parts that were given up. */
const ROUGH = "A part of the model is shown without its details. Reload the page to ask for it again.";

export class Parts {
  /**
   * Read the index of a model.
   * @param {Splats} splats  that are to draw it
   * @param {Source} source @param {(done: number, total: number) => void} [progress]
   */
  static async open(splats, source, progress) {
    const pieces = await Pieces.open(source);
    const url = URL.createObjectURL(new Blob([/** @type {BlobPart} */ (pieces.index)]));
    try {
      const asset = new splats.pc.Asset(INDEX, "gsplat", { url: `${url}#/${INDEX}`, filename: INDEX });
      if (splats.app) await splats.added(asset, () => asset.resource.numSplats);
      return new Parts(splats, asset, pieces, progress);
    } finally {
      URL.revokeObjectURL(url);
    }
  }

  /** @param {Splats} splats @param {any} asset  the index @param {Pieces} pieces @param {(done: number, total: number) => void} [progress] */
  constructor(splats, asset, pieces, progress) {
    this.splats = splats;
    this.asset = asset;
    /** Whether nothing of it is to be seen yet. */
    this.early = true;
    /** Updates that are still to be made, and frames that were drawn to learn whether something is to come. */
    this.updates = 0;
    this.looks = 0;
    /** The request for the next update; 0 where there is none. */
    this.updating = 0;
    this.chunks = new Chunks(pieces, {
      read: (sog) => splats.asset("sog", new Response(/** @type {BodyInit} */ (sog))),
      drop: (chunk) => splats.drop(chunk),
      loaded: () => {
        this.looks = 0;
        progress?.(pieces.loaded, 0);
        splats.again();
      },
      failed: (error) => splats.trouble(error ? `${ROUGH} ${error.message}` : ""),
    });
    if (asset.resource) asset.resource.octree.assetLoader = this.chunks;
    progress?.(pieces.loaded, 0);
  }

  /** Wait for the coarsest level. @param {any} entity  that draws it */
  async firstPicture(entity) {
    const size = this.asset.resource.aabb.halfExtents.length();
    this.splats.app.scene.gsplat.lodUpdateDistance = STEP * size;
    entity.gsplat.lodBaseDistance = NEAR * size;
    this.splats.again();
    await this.chunks.first;
    this.early = this.splats.sorted = false;
  }

  /** The positions of the Gaussians of a chunk of the coarsest level, x, y and z in turn. @returns {Float32Array | null} */
  get sample() {
    return this.chunks.scene?.resource.centers ?? null;
  }

  /** Look after a frame what is to be loaded for it. */
  drawn() {
    this.updates = UPDATES;
    if (!this.updating) this.update();
  }

  /** Choose what is loaded and drawn, until all of it is there. */
  update() {
    this.updating = 0;
    const { splats, chunks } = this;
    if (!splats.app || splats.parts !== this) return;
    splats.app.tick(performance.now());
    cancelAnimationFrame(splats.app.frameRequestId);
    this.updates -= 1;
    if (splats.settled) this.looks = 0;
    if (this.updates > 0 || chunks.pending) this.updating = requestAnimationFrame(() => this.update());
    else if (!splats.settled && (this.looks += 1) < LOOKS) splats.again();
  }
}
