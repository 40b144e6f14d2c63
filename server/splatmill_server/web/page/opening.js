// A stored model in the viewer: its picture at once, and then the model from the smallest file that the viewer draws.

import { get } from "./api.js";
import { POSTER, PREVIEW, pictureOf } from "./picture.js";
import { makeSmallFile, smallFile, smallFormat, wholeFile } from "./viewer/small_file.js";
import { open } from "./viewer.js";

/** Bytes of a model.ply that is loaded as it is: a smaller file of it would hardly be seen sooner. */
const SMALL = 200e3;
/** Milliseconds that are waited without a word. */
const SOON = 1000;

/**
 * Show a model in an element, which needs a size of its own.
 * @param {HTMLElement} box
 * @param {object} model
 * @param {string} model.address that of the model, as /v1/models/ID
 * @param {number} model.gaussians how many it has
 * @param {{name: string}[]} model.files
 * @param {any[]} model.cameras those of the photos
 * @param {any} model.up what is up, as /v1/models/ID/cameras says it
 * @param {import("./viewer/presented.js").Presentation} model.presentation how its owner wants it to be shown
 * @param {import("./viewer.js").Options} options others than those for the source and the cameras
 */
export function openModel(box, { address, gaussians, files, cameras, up, presentation }, options) {
  // The worker takes the picture from where the first held-out photo was taken, or else the first photo of all.
  const first = (cameras.find(({ split }) => split === "test") ?? cameras[0])?.camera;
  const picture = pictureOf(files);
  const camera = presentation.start_view ?? (picture ? first : undefined);
  // The picture from the start view is the only one that a start view has.
  const poster = camera && picture === (presentation.start_view ? POSTER : PREVIEW) ? `${address}/files/${picture}` : undefined;
  return open(box, {
    background: presentation.background,
    ...options,
    model: address,
    cameras: cameras.map(({ camera }) => camera),
    up,
    camera,
    poster,
    whole: { ...wholeFile(address), what: "the whole model, which edits are shown on; the server makes its file once" },
    find: (say, begun) => smallest(address, gaussians, say, begun),
  });
}

/**
 * The file of a model to load. Where the server still has to make the smallest one, it is waited for, but no longer than
 * model.ply would take to load: so the scene is there in at most twice the time of the better choice.
 * @param {string} address @param {number} gaussians @param {(text: string) => void} say
 * @param {Promise<unknown>} begun settles once the viewer's engine and the picture are loaded, which shows how fast files come
 * @returns {Promise<import("./viewer/source.js").Source>}
 */
async function smallest(address, gaussians, say, begun) {
  const whole = { url: `${address}/files/model.ply` };
  const small = smallFile(address, gaussians);
  /** @type {any[]} */
  const formats = (await get(`${address}/formats`)).formats;
  const size = (/** @type {string} */ wanted) => formats.find(({ format }) => format === wanted)?.bytes ?? null;
  if (size("ply") <= SMALL) return whole;
  if (size(smallFormat(gaussians)) !== null) return small;
  const made = makeSmallFile(address, gaussians);
  if (small.levels && size(smallFormat(0)) !== null) return wholeFile(address); // the levels are for the next visit
  await begun;
  const patience = size("ply") / speed();
  if (patience > SOON) say("The server makes a small file of the model, once for all visitors.");
  return Promise.race([
    made.then((is) => is ? small : { ...whole, what: "the whole model, since the server could not make a small file of it" }),
    new Promise((resolve) => setTimeout(resolve, patience)).then(() => whole), // what is made is for the next visit
  ]);
}

/** Bytes per millisecond with which the largest file came that this page has loaded, or Infinity where all were at hand. */
function speed() {
  const files = /** @type {PerformanceResourceTiming[]} */ (performance.getEntriesByType("resource"));
  const largest = files.reduce((most, file) => file.transferSize > (most?.transferSize ?? 0) ? file : most, files[0]);
  return largest?.transferSize ? largest.transferSize / (largest.responseEnd - largest.responseStart) : Infinity;
}
