// A stored model in the viewer: its picture at once, and then the model from the smallest file that the viewer draws.

import { get, request } from "./api.js";
import { POSTER, PREVIEW, pictureOf } from "./picture.js";
import { open } from "./viewer.js";

/** Bytes of a model.ply that is loaded as it is: a smaller file of it would hardly be seen sooner. */
const SMALL = 200e3;

/** The format with the fewest bytes among those that the viewer draws; it costs about 0.03 dB. */
const SMALLEST = "sog";

/**
 * Show a model in an element, which needs a size of its own.
 * @param {HTMLElement} box
 * @param {object} model
 * @param {string} model.address that of the model, as /v1/models/ID
 * @param {{name: string}[]} model.files
 * @param {any[]} model.cameras those of the photos
 * @param {import("./viewer/presented.js").Presentation} model.presentation how its owner wants it to be shown
 * @param {boolean} [model.waits] whether to wait until the server has made the smallest file, where it has not yet
 * @param {import("./viewer.js").Options} options others than those for the source and the cameras
 */
export function openModel(box, { address, files, cameras, presentation, waits = false }, options) {
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
    camera,
    poster,
    find: (say) => smallest(address, waits, say),
  });
}

/**
 * The file of a model to load.
 * @param {string} address @param {boolean} waits @param {(text: string) => void} say
 * @returns {Promise<import("./viewer/source.js").Source>}
 */
async function smallest(address, waits, say) {
  const whole = { url: `${address}/files/model.ply` };
  /** @type {any[]} */
  const formats = (await get(`${address}/formats`)).formats;
  const size = (/** @type {string} */ wanted) => formats.find(({ format }) => format === wanted)?.bytes ?? null;
  const small = { url: `${address}/download/${SMALLEST}` };
  if (size("ply") <= SMALL) return whole;
  if (size(SMALLEST) !== null) return small;
  const made = request("HEAD", small.url);
  if (!waits) {
    made.catch(() => {}); // it is for the next visit
    return whole;
  }
  say("The server makes a small file of the model, once for all visitors.");
  try {
    await made;
    return small;
  } catch {
    return { ...whole, what: "the whole model, since the server could not make a small file of it" };
  }
}
