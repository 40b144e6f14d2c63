// The verdict on each photo, from what was measured on all of them. A verdict is advice: nothing is left out by itself.

import { distance } from "./measure.js";

/**
 * What is known of a photo.
 * @typedef {object} Seen
 * @property {string} name
 * @property {string | null} digest SHA-256 in hex; null while it is not known
 * @property {"waiting" | "read" | "unreadable" | "unchecked"} state unchecked: this browser cannot decode the format
 * @property {number} width pixels, upright; 0 while not known
 * @property {number} height
 * @property {import("./measure.js").Measures | null} measures
 * @property {Verdict | null} panorama
 */

/**
 * @typedef {object} Verdict
 * @property {"waiting" | "good" | "hint" | "bad" | "unchecked"} kind bad: leaving it out is advised
 * @property {string} text what was seen
 */

/**
 * @typedef {object} Limits
 * @property {number} minSide pixels
 * @property {number} maxPixels
 */

/** Photos without which there is no usual blur to compare with. */
const ENOUGH = 5;

/** Standard deviations above the median at which a photo counts as blurred, where deviations are estimated robustly. */
const DEVIATIONS = 4;

/** Least difference of the blur measure that counts, so that photos that are all alike are not told apart. */
const LEAST_BLUR = 0.08;

/** Grey level of 255 that nine tenths of a dark photo stay below, and that nine tenths of a bright one exceed. */
const DARK = 36;
const BRIGHT = 240;

/** Cells of 256 in which the hashes of two nearly equal photos differ at most. */
export const NEAR = 10;

/** Photos before a photo that it is compared with: nearly equal ones were taken one after the other. */
const LOOKED_BACK = 12;

/** Share of the usual number of pixels below which a photo is small beside the others. */
const SMALL = 0.3;

/**
 * Return the verdict of each photo, in their order.
 * @param {Seen[]} photos in order of name
 * @param {Limits} limits
 * @returns {Verdict[]}
 */
export function verdicts(photos, limits) {
  const read = photos.flatMap((photo) => (photo.state === "read" && photo.measures ? [{ photo, measures: photo.measures }] : []));
  const blurred = aboveUsual(read.map(({ measures }) => measures.blur));
  const dark = exceptions(read, ({ measures }) => measures.dark < DARK);
  const bright = exceptions(read, ({ measures }) => measures.bright > BRIGHT);
  const pixels = median(read.map(({ photo }) => photo.width * photo.height));
  const position = new Map(read.map(({ photo }, index) => [photo, index]));
  /** @type {Map<string, string>} */
  const firstOf = new Map();
  return photos.map((photo) => {
    const twin = photo.digest === null ? undefined : firstOf.get(photo.digest);
    if (photo.digest !== null && twin === undefined) firstOf.set(photo.digest, photo.name);
    if (photo.state === "waiting") return { kind: "waiting", text: "Being checked" };
    if (twin !== undefined) return bad(`The same file as ${twin}.`);
    if (photo.state === "unreadable") return bad("The file is damaged: it cannot be read as a picture.");
    if (photo.width && Math.min(photo.width, photo.height) < limits.minSide) {
      return bad(`Too small: ${photo.width} × ${photo.height} pixels. The shorter side needs at least ${limits.minSide}.`);
    }
    if (photo.width * photo.height > limits.maxPixels) {
      return bad(`Too large: ${photo.width} × ${photo.height} pixels.`);
    }
    const { measures, panorama } = photo;
    if (panorama?.kind === "bad") return panorama;
    if (photo.state === "unchecked" || !measures) return { kind: "unchecked", text: "The server checks it: this browser does not show the format." };
    if (dark(photo)) return bad("Too dark: hardly anything can be seen.");
    if (bright(photo)) return bad("Too bright: most of it is white.");
    if (ENOUGH <= read.length && blurred(measures.blur)) return bad("Blurred, compared with the other photos.");
    if (ENOUGH <= read.length && photo.width * photo.height < SMALL * pixels) {
      return bad(`Small beside the others: ${photo.width} × ${photo.height} pixels. It may be a preview or cut out.`);
    }
    const at = position.get(photo) ?? 0;
    const near = read.slice(Math.max(0, at - LOOKED_BACK), at).find((other) => alike(other.photo, photo, other.measures, measures));
    if (near) return { kind: "hint", text: `Almost the same view as ${near.photo.name}.` };
    return panorama ?? { kind: "good", text: "Good" };
  });
}

/** @param {string} text @returns {Verdict} */
function bad(text) {
  return { kind: "bad", text };
}

/**
 * Return whether a value stands out above the others: by DEVIATIONS, where a deviation is 1.4826 times the median distance
 * from the median, as it is for a normal distribution.
 * @param {number[]} values
 */
function aboveUsual(values) {
  const middle = median(values);
  const spread = 1.4826 * median(values.map((value) => Math.abs(value - middle)));
  const limit = middle + Math.max(DEVIATIONS * spread, LEAST_BLUR);
  return (/** @type {number} */ value) => value > limit;
}

/**
 * Return whether a photo has a trait that most of the photos do not have: a scene in front of white is no mistake.
 * @template {{photo: Seen}} T
 * @param {T[]} read
 * @param {(one: T) => boolean} has
 */
function exceptions(read, has) {
  const photos = new Set(read.filter(has).map(({ photo }) => photo));
  return (/** @type {Seen} */ photo) => photos.has(photo) && 2 * photos.size <= Math.max(read.length, 2);
}

/**
 * @param {Seen} one
 * @param {Seen} other
 * @param {import("./measure.js").Measures} first
 * @param {import("./measure.js").Measures} second
 */
function alike(one, other, first, second) {
  const shape = (/** @type {Seen} */ seen) => seen.width / seen.height;
  return Math.abs(shape(one) / shape(other) - 1) < 0.01 && distance(first.hash, second.hash) <= NEAR;
}

/** @param {number[]} values */
export function median(values) {
  if (values.length === 0) return 0;
  const sorted = [...values].sort((one, other) => one - other);
  const middle = sorted.length >> 1;
  return sorted.length % 2 ? sorted[middle] : (sorted[middle - 1] + sorted[middle]) / 2;
}
