// A stored model in the viewer: its picture at once, and then the model from the smallest file that the viewer draws.

import { get, request } from "./api.js";
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
 * @param {boolean} [model.waits] whether to wait until the server has made the smallest file, where it has not yet
 * @param {import("./viewer.js").Options} options others than those for the source and the cameras
 */
export function openModel(box, { address, files, cameras, waits = false }, options) {
  // The worker takes the picture from where the first held-out photo was taken, or else the first photo of all.
  const shown = cameras.find(({ split }) => split === "test") ?? cameras[0];
  const poster = shown && files.some(({ name }) => name === "preview.jpg");
  return open(box, {
    ...options,
    model: address,
    cameras: cameras.map(({ camera }) => camera),
    ...(poster ? { camera: shown.camera, poster: `${address}/files/preview.jpg` } : {}),
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
