/**
 * Loads the chunks of a model in levels of detail for PlayCanvas, which asks for them as the camera moves: it takes the
 * place of the loader that PlayCanvas has for folders on a server.
 *
 * @import {Pieces} from "./pieces.js"
 */

/** Chunks that are loaded at once. */
const AT_ONCE = 2;

export class Chunks {
  /**
   * @param {Pieces} pieces
   * @param {object} on
   * @param {(sog: Uint8Array) => Promise<any>} on.read  makes an asset of PlayCanvas of a .sog
   * @param {(asset: any) => void} on.drop  ends an asset
   * @param {() => void} on.loaded  called when a chunk is there, which the next frame shows
   * @param {(error: Error | null) => void} on.failed  called when a chunk was given up, in whose place a coarser level is
   *   drawn, and with null when all of these are there after all
   */
  constructor(pieces, on) {
    this.pieces = pieces;
    this.on = on;
    /** The assets of those that are there, by address. @type {Map<string, any>} */
    this.assets = new Map();
    /** Those that wait, and how urgent each is. @type {Map<string, number>} */
    this.waiting = new Map();
    /** @type {Set<string>} */
    this.loading = new Set();
    /** Those that were given up. @type {Set<string>} */
    this.missing = new Set();
    /** Those of which `failed` was called. @type {Set<string>} */
    this.reported = new Set();
    /** Whether none is loaded any more. */
    this.ended = false;
    /** Called when the network is there again. */
    this.again = () => {
      this.missing.clear();
      this.on.loaded();
    };
    addEventListener("online", this.again);
    /** The first chunk of the coarsest level that was there. @type {any} */
    this.scene = null;
    /** @type {() => void} */
    this.begun = () => {};
    /** @type {(error: Error) => void} */
    this.lost = () => {};
    /** Settles once it is there, or was given up. @type {Promise<void>} */
    this.first = new Promise((resolve, reject) => {
      [this.begun, this.lost] = [resolve, reject];
    });
    this.first.catch(() => {}); // whoever waits for it learns of it
  }

  /** How many are loaded or wait. */
  get pending() {
    return this.loading.size + this.waiting.size;
  }

  /** @param {string} url @param {number} [priority]  the more, the sooner; left out, as it was */
  load(url, priority) {
    if (this.ended || this.assets.has(url) || this.loading.has(url) || this.missing.has(url)) return;
    this.waiting.set(url, this.surrounds(url) ? Infinity : (priority ?? this.waiting.get(url) ?? 0));
    queueMicrotask(() => this.next()); // PlayCanvas names all that a frame needs, one after the other
  }

  /** @param {string} url */
  surrounds(url) {
    return folderOf(url) === this.pieces.surroundings;
  }

  /** Whether one that waited does not any more. @param {string} url */
  dequeue(url) {
    return this.waiting.delete(url);
  }

  /** What PlayCanvas draws; of the surroundings nothing before the scene is there. @param {string} url */
  getResource(url) {
    return this.scene || !this.surrounds(url) ? this.assets.get(url)?.resource : undefined;
  }

  /** @param {string} url */
  unload(url) {
    this.waiting.delete(url);
    this.loading.delete(url);
    this.missing.delete(url);
    this.arrived(url);
    const asset = this.assets.get(url);
    this.assets.delete(url);
    if (asset) this.on.drop(asset);
    this.next();
  }

  destroy() {
    this.ended = true;
    this.pieces.end();
    removeEventListener("online", this.again);
    this.begun();
    this.waiting.clear();
    this.loading.clear();
    for (const asset of this.assets.values()) this.on.drop(asset);
    this.assets.clear();
  }

  next() {
    while (this.loading.size < AT_ONCE && this.waiting.size) {
      const [url, priority] = [...this.waiting].reduce((a, b) => (b[1] > a[1] ? b : a));
      const soon = this.scene || priority === Infinity || this.pieces.coarsest.has(folderOf(url));
      if (!soon && this.loading.size) return; // nothing takes bytes from the first picture
      this.waiting.delete(url);
      this.loading.add(url);
      void this.fetch(url);
    }
  }

  /** @param {string} url */
  async fetch(url) {
    const folder = folderOf(url);
    const coarse = this.pieces.coarsest.has(folder);
    let asset = null;
    try {
      asset = await this.on.read(await this.pieces.chunk(folder));
    } catch (error) {
      this.lose(url, /** @type {Error} */ (error), coarse);
      return;
    }
    if (this.loading.delete(url)) {
      this.assets.set(url, asset);
      if (coarse) {
        this.scene ??= asset;
        this.begun();
      }
      this.arrived(url);
      this.on.loaded();
    } else {
      this.on.drop(asset); // it was not wanted any more
    }
    this.next();
  }

  /** Take back what was said of a chunk, which is there or not wanted any more. @param {string} url */
  arrived(url) {
    if (!this.ended && this.reported.delete(url) && !this.reported.size) this.on.failed(null);
  }

  /** Give up a chunk, and all where the server refuses them. @param {string} url @param {Error} error @param {boolean} coarse */
  lose(url, error, coarse) {
    if (this.loading.delete(url)) {
      this.missing.add(url);
      if (/** @type {any} */ (error).reason === "refused") {
        this.ended = true;
        this.waiting.clear();
      }
      if (coarse) this.lost(error);
      if (this.scene) {
        this.reported.add(url);
        this.on.failed(error);
      }
    }
    this.next();
  }
}

/** The folder in the archive of the meta.json at an address, which stands after the # of the index's. @param {string} url */
function folderOf(url) {
  return url.slice(url.indexOf("#/") + 2, url.lastIndexOf("/") + 1);
}
