// Whether photos seem to show one place from several sides, by their thumbnails. It is advice in words, and stops nothing.

import { count } from "../../format.js";
import { distance } from "./measure.js";
import { NEAR, median } from "./verdicts.js";

/**
 * @import {Item} from "../items.js"
 * @import {Link} from "./compare.js"
 */

/** Photos that are compared at most. Of more, runs of RUN that follow each other: neighbours overlap, and others need not. */
const MOST = 48;
const RUN = 4;

/**
 * Features that two thumbnails share where they show the same things. Of nine photos with nothing in common, no two share more
 * than four; in six captures each photo shares ten or more with another.
 */
const LINKED = 5;

/** Photos of a group that is named as one. */
const GROUP = 3;

/** Share of pairs with nearly the same view above which all photos are said to show it. */
const SAME = 0.8;

/** Blur above which photos are blurred in themselves: captures have medians up to 0.40, under a Gaussian of 2 pixels 0.64 or more. */
const BLURRED = 0.58;

/** Photos that a sentence names. */
const NAMED = 3;

export class Overlap {
  /** @param {() => void} changed called when photos were compared */
  constructor(changed) {
    this.changed = changed;
    /** @type {string[]} */
    this.sentences = [];
    /** Which photos were compared. */
    this.key = "";
    /** @type {Worker | null} */
    this.worker = null;
  }

  /** Compare photos once all of them are examined, unless they are those of the last time. @param {Item[]} photos */
  consider(photos) {
    const examined = photos.filter((photo) => photo.measures && photo.picture);
    const waits = photos.some((photo) => photo.state === "waiting" && !photo.lost);
    const chosen = waits || examined.length < GROUP ? [] : sample(examined);
    const key = chosen.map(({ id }) => id).join(" ");
    if (key === this.key) return;
    this.key = key;
    this.worker?.terminate();
    this.worker = null;
    const plain = chosen.length ? [...inThemselves(chosen)] : [];
    this.sentences = plain;
    if (!chosen.length || plain.length) return; // photos that are all alike, or blurred, are not said to share nothing
    this.worker = new Worker(new URL("./compare.js", import.meta.url), { type: "module" });
    this.worker.addEventListener("message", ({ data }) => {
      this.worker?.terminate();
      this.worker = null;
      this.sentences = together(chosen, data, chosen.length === photos.length);
      this.changed();
    });
    this.worker.postMessage(chosen.map(({ picture }) => picture));
  }

  /** Whether photos were compared, and no others are now. */
  get compared() {
    return this.key !== "" && this.worker === null;
  }
}

/** @param {Item[]} photos in order of name */
export function sample(photos) {
  if (photos.length <= MOST) return photos;
  const runs = MOST / RUN;
  return Array.from({ length: MOST }, (_, k) => photos[Math.round((Math.floor(k / RUN) * (photos.length - RUN)) / (runs - 1)) + (k % RUN)]);
}

/** What is wrong with all photos, each by itself. @param {Item[]} photos */
function* inThemselves(photos) {
  const measures = photos.flatMap((photo) => (photo.measures ? [photo.measures] : []));
  if (median(measures.map(({ blur }) => blur)) > BLURRED) {
    yield "These photos all look blurred. The scene will be blurred too, or not come about: hold the camera still, or give it more light.";
  }
  const pairs = measures.flatMap((one, i) => measures.slice(0, i).map((other) => distance(one.hash, other.hash) <= NEAR));
  if (pairs.filter(Boolean).length > SAME * pairs.length) {
    yield "These photos show nearly the same view. A scene needs photos from different places: walk around it.";
  }
}

/**
 * What photos lack that is to be had of them together.
 * @param {Item[]} photos  those that were compared
 * @param {Link[]} links  between each two of them
 * @param {boolean} all  whether there are no others
 * @returns {string[]}
 */
export function together(photos, links, all) {
  const groups = groupsOf(photos.length, links);
  const alone = groups.filter((group) => group.length === 1).map(([index]) => photos[index].name);
  if (2 * alone.length >= photos.length) {
    return [`These photos seem to have nothing in common: ${alone.length} of the ${photos.length} that were compared share no details with another. Each should overlap the next by two thirds.`];
  }
  if (!all) return [];
  const sentences = [];
  const large = groups.filter((group) => group.length >= GROUP);
  if (large.length > 1) {
    sentences.push(`These photos seem to show ${large.length} places that have nothing in common: ${large.map((group) => count(group.length, "photo")).join(", ").replace(/, ([^,]*)$/, " and $1")}, such as ${large.map(([index]) => photos[index].name).join(" and ")}. If they are one place, add photos of what lies between.`);
  }
  if (alone.length) {
    const others = alone.length - NAMED;
    const names = others > 0 ? `${alone.slice(0, NAMED).join(", ")} and ${others} more` : alone.join(", ");
    sentences.push(`${count(alone.length, "photo")} ${alone.length === 1 ? "seems" : "seem"} to share no details with the others: ${names}.`);
  }
  return sentences;
}

/** The groups of pictures that are linked, each in order, the largest first. @param {number} number @param {Link[]} links */
function groupsOf(number, links) {
  const group = Array.from({ length: number }, (_, index) => index);
  for (const [i, j, features] of links) {
    if (features < LINKED || group[i] === group[j]) continue;
    const [from, to] = [group[j], group[i]];
    group.forEach((one, index) => one === from && (group[index] = to));
  }
  return [...new Set(group)].map((one) => group.flatMap((other, index) => (other === one ? [index] : []))).sort((a, b) => b.length - a.length);
}
