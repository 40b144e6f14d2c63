// The files that were given: which of them belong to the capture, under which names, and what is known of each.

import { namesIn } from "./zip.js";
import { byCodePoint, holdsCameras, sort, suffix, withoutTop } from "./kinds.js";
import { onMasks, places, remarks } from "./remarks.js";
import { verdicts } from "./looking/verdicts.js";

/**
 * @typedef {object} Item
 * @property {number} id
 * @property {string} path as it was given, and unique
 * @property {File} file
 * @property {import("./kinds.js").Role | null} role null for a file that is not used
 * @property {string} name in the capture
 * @property {"photo" | "video" | "archive" | "mask" | "pose" | "scan" | "ignored"} kind
 * @property {boolean} named whether it is a mask that a frame of a transforms file names
 * @property {boolean} left whether a person has left it out
 * @property {string | null} digest
 * @property {"waiting" | "read" | "unreadable" | "unchecked"} state
 * @property {number} width
 * @property {number} height
 * @property {import("./looking/measure.js").Measures | null} measures
 * @property {import("./looking/verdicts.js").Verdict | null} panorama
 * @property {Uint32Array | null} levels number of pixels of each level of a mask; null while not known
 * @property {string | null} thumbnail address
 * @property {Blob | null} picture what lies there
 * @property {string | null} lost why its bytes cannot be read
 * @property {string[] | null} inside names of the files in an archive; null where they are not known
 * @property {import("./looking/verdicts.js").Verdict} verdict
 * @property {boolean} stored whether the capture holds it
 * @property {import("../api.js").Problem | null} problem why the server refused it
 */

/** @typedef {{role: string, name: string, size: number, sha256: string}} Held a file of a capture */

export class Items {
  /**
   * @param {import("./kinds.js").Accepted} accepted
   * @param {number} maxPixels
   */
  constructor(accepted, maxPixels) {
    this.accepted = accepted;
    this.limits = { minSide: accepted.min_photo_side, maxPixels };
    /** @type {Map<string, Item>} */
    this.byPath = new Map();
    /** @type {import("./documents.js").Documents} */
    this.documents = new Map();
    /** @type {Map<string, string[]>} names of the files in each zip, by its path */
    this.lists = new Map();
    this.count = 0;
    /** @type {string | null} why the files cannot be one capture */
    this.problem = null;
    /** Why these photos are too few for a scene, a sentence; "" where nothing is known against it. */
    this.lacking = "";
    /** @type {string[]} sentences about files that are not used, or are used otherwise than may be expected */
    this.said = [];
  }

  /** All items in order of their paths. */
  get all() {
    return [...this.byPath.values()];
  }

  /** The items that are to be sent. */
  get used() {
    return this.all.filter((item) => item.role !== null && !item.left);
  }

  /** The photos, left out or not, in order of name. */
  get photos() {
    return this.all.filter((item) => item.kind === "photo");
  }

  /**
   * Add files; returns the new ones. A file that was given before is not added again; another one under the same path gets
   * a path of its own, because phones call each photo image.jpg.
   * @param {import("./given.js").Given[]} given
   * @param {import("./documents.js").Documents} documents the transforms files among them
   * @param {Map<string, string[]>} lists names of the files in each zip among them, by its path
   */
  add(given, documents, lists) {
    for (const [path, document] of documents) this.documents.set(path, document);
    for (const [path, inside] of lists) this.lists.set(path, inside);
    const added = [];
    for (const { path, file } of given) {
      const free = this.free(path, file);
      if (free === null) continue;
      /** @type {Item} */
      const item = {
        id: ++this.count, path: free, file, role: null, name: free, kind: "ignored", named: false, left: false, digest: null, state: "waiting", width: 0, height: 0,
        measures: null, levels: null, panorama: null, thumbnail: null, picture: null, lost: null, inside: null, verdict: { kind: "waiting", text: "" }, stored: false, problem: null,
      };
      this.byPath.set(free, item);
      added.push(item);
    }
    this.sort();
    return added;
  }

  /** @param {string} path @param {File} file @returns {string | null} null if the file is there already */
  free(path, file) {
    const ending = suffix(path);
    const stem = path.slice(0, path.length - ending.length);
    for (let number = 1; ; number++) {
      const free = number === 1 ? path : `${stem}-${number}${path.slice(stem.length)}`;
      const known = this.byPath.get(free);
      if (!known) return free;
      if (known.file.size === file.size && known.file.lastModified === file.lastModified) return null;
    }
  }

  clear() {
    for (const item of this.all) if (item.thumbnail) URL.revokeObjectURL(item.thumbnail);
    this.byPath.clear();
    this.documents.clear();
    this.lists.clear();
  }

  /** Decide again what each file is; more files may change that. */
  sort() {
    const sorted = sort(this.byPath.keys(), this.accepted, this.documents, this.lists);
    this.problem = sorted.problem;
    for (const item of this.all) item.named = sorted.named.has(item.path);
    this.said = [...places(sorted), ...remarks(sorted, this.accepted)];
    const order = new Map(sorted.files.map(({ path, role, name }) => [path, { role, name }]));
    const before = this.byPath;
    this.byPath = new Map();
    for (const path of [...order.keys(), ...[...before.keys()].filter((path) => !order.has(path))]) {
      const item = /** @type {Item} */ (before.get(path));
      const place = order.get(path);
      item.role = place?.role ?? null;
      item.name = place?.name ?? path;
      item.kind = this.kindOf(item);
      this.byPath.set(path, item);
    }
    this.chooseScan();
  }

  /** Take the first file of points by its path, where there are photos, for one to start from. */
  chooseScan() {
    const [scan, ...others] = this.all.filter((item) => item.role === null && this.accepted.points.includes(suffix(item.path)))
      .sort((one, other) => byCodePoint(one.path, other.path));
    if (!scan || !this.all.some((item) => item.role === "images")) return;
    Object.assign(scan, { role: "poses", name: scan.path.slice(scan.path.lastIndexOf("/") + 1).normalize("NFC"), kind: "scan" });
    if (others.length) this.said.push(`One file of points is used. These are not: ${others.map(({ path }) => path).join(", ")}.`);
  }

  /** The name of the file of points that the training starts from, where there is one. */
  get scan() {
    return this.used.find((item) => item.kind === "scan")?.name ?? null;
  }

  /** @param {Item} item @returns {Item["kind"]} */
  kindOf(item) {
    if (item.role === null) return "ignored";
    if (item.role !== "images") return item.role === "masks" ? "mask" : "pose";
    const ending = suffix(item.path);
    return this.accepted.photos.includes(ending) ? "photo" : this.accepted.videos.includes(ending) ? "video" : "archive";
  }

  /** Give each photo that is not left out its verdict, and say whether they are enough. @param {Held[]} held files that the capture holds */
  judge(held) {
    const photos = this.photos.filter((item) => !item.left);
    verdicts(photos, this.limits).forEach((verdict, index) => {
      const item = photos[index];
      item.verdict = item.lost ? { kind: "bad", text: item.lost } : verdict;
    });
    this.lacking = this.tooFew(held);
    if (!this.lacking) return;
    for (const item of photos) if (item.verdict.kind === "good") item.verdict = { kind: "hint", text: "More photos are needed." };
  }

  /** @param {Held[]} held */
  tooFew(held) {
    const { photos, posed } = this.size(held, Infinity);
    if (posed || photos === null) return "";
    const digests = this.used.flatMap(({ kind, digest }) => (kind === "photo" && digest !== null ? [digest] : []));
    const different = photos - (digests.length - new Set(digests).size);
    const least = this.accepted.min_photos;
    if (different >= least) return "";
    const few = different === 0 ? "There is no photo among these files" : different === 1 ? "One photo is too few" : `${different} photos are too few`;
    return `${few}. A scene needs at least ${least} that show the same things from different places; 20 or more make a good one.`;
  }

  /** Sentences about files that are not used, and about masks. */
  get remarks() {
    const used = this.used;
    const scan = this.scan ? [`The training starts from the points of ${this.scan} as well as from those of the photos.`] : [];
    return [...(this.problem ? [this.problem] : []), ...scan, ...this.said, ...onMasks(used.filter(({ kind }) => kind === "mask"), used.filter(({ kind }) => kind === "photo").map(({ name }) => name), this.accepted)];
  }

  /** Read the list of an archive. @param {Item} item */
  async open(item) {
    try {
      item.inside = await namesIn(item.file);
    } catch {
      item.inside = null; // the server says what is wrong with it
    }
  }

  /**
   * How many photos a job will have, whether their number is certain, and whether cameras come with them.
   * @param {Held[]} held files that the capture holds
   * @param {number} frames photos that are taken from a video
   * @returns {{photos: number | null, exact: boolean, posed: boolean}} `photos` is null where an archive does not tell
   */
  size(held, frames) {
    const items = this.used;
    const own = new Set(items.map((item) => `${item.role}/${item.name}`));
    const others = held.filter((file) => !own.has(`${file.role}/${file.name}`));
    let photos = 0;
    let exact = true;
    const isPose = (/** @type {{role: string | null, name: string}} */ file) => holdsCameras(file, this.accepted);
    let posed = others.some(isPose) || items.some(isPose);
    let known = !others.some(({ role, name }) => role === "images" && (name === this.accepted.example || this.accepted.archives.includes(suffix(name))));
    for (const name of [...items, ...others].filter((file) => file.role === "images").map((file) => suffix(file.name))) {
      if (this.accepted.photos.includes(name)) photos++;
      else exact = false;
      if (this.accepted.videos.includes(name)) photos += frames;
    }
    for (const { inside } of items.filter((item) => item.kind === "archive")) {
      if (inside === null) known = false;
      const sorted = sort(withoutTop(inside ?? []), this.accepted);
      photos += sorted.files.filter((file) => file.role === "images").length;
      posed ||= sorted.files.some(isPose);
    }
    return { photos: known ? photos : null, exact: exact && known && photos > 0, posed };
  }
}
