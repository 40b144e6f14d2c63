// The worker that examines one file at a time: digest, size, thumbnail and measures.

import { sha256 } from "./digest.js";
import { MEASURED_SIDE, levels, measure } from "./measure.js";
import { SIZE, XMP_BYTES, panoramaOf } from "./panorama.js";

/** Pixels of the longest side of a thumbnail. */
const THUMBNAIL = 240;

/** Bytes above which a photo is not decoded here: four bytes for each of its pixels would take too much memory. */
const LARGEST = 60e6;

/**
 * @typedef {object} Looked
 * @property {number} id
 * @property {string | null} digest null if the file could not be read
 * @property {"read" | "unreadable" | "unchecked"} state
 * @property {number} width
 * @property {number} height
 * @property {import("./measure.js").Measures | null} measures
 * @property {Uint32Array | null} levels number of pixels of each level of a mask
 * @property {import("./verdicts.js").Verdict | null} panorama what is to be known of it as a panorama
 * @property {Blob | null} thumbnail
 * @property {string} [error] why the file could not be read at all
 */

/** @param {MessageEvent<{id: number, file: File, kind: string, shown: boolean, library: string}>} message */
async function onMessage({ data: { id, file, kind, shown, library } }) {
  /** @type {Looked} */
  const looked = { id, digest: null, state: "unchecked", width: 0, height: 0, measures: null, levels: null, panorama: null, thumbnail: null };
  try {
    looked.digest = await sha256(file, library);
    if (["photo", "mask"].includes(kind) && file.size <= LARGEST && "OffscreenCanvas" in globalThis) await decode(file, kind, shown, looked);
  } catch (error) {
    looked.error = String(error);
  }
  postMessage(looked);
}

/**
 * @param {File} file
 * @param {string} kind photo or mask
 * @param {boolean} shown whether browsers decode this format
 * @param {Looked} looked
 */
async function decode(file, kind, shown, looked) {
  /** @type {ImageBitmap} */
  let picture;
  try {
    picture = await createImageBitmap(file);
  } catch {
    if (shown) looked.state = "unreadable";
    return;
  }
  try {
    looked.width = picture.width;
    looked.height = picture.height;
    const canvas = drawn(picture, MEASURED_SIDE);
    const pixels = context(canvas).getImageData(0, 0, canvas.width, canvas.height);
    if (kind === "mask") looked.levels = levels(pixels.data);
    else {
      looked.measures = measure(pixels.data, canvas.width, canvas.height);
      const ends = await new Blob([file.slice(0, XMP_BYTES), file.slice(-XMP_BYTES)]).text();
      looked.panorama = panoramaOf(ends, picture.width, picture.height, () => {
        const [width, height] = SIZE;
        return context(drawn(picture, width)).getImageData(0, 0, width, height).data;
      });
    }
    looked.thumbnail = await drawn(canvas, THUMBNAIL).convertToBlob({ type: "image/webp", quality: 0.8 });
    looked.state = "read";
  } finally {
    picture.close();
  }
}

/**
 * Return a picture drawn with at most `side` pixels on its longest side.
 * @param {ImageBitmap | OffscreenCanvas} picture
 * @param {number} side
 */
function drawn(picture, side) {
  const factor = Math.min(1, side / Math.max(picture.width, picture.height));
  const canvas = new OffscreenCanvas(Math.max(1, Math.round(picture.width * factor)), Math.max(1, Math.round(picture.height * factor)));
  const drawing = context(canvas);
  drawing.imageSmoothingQuality = "high";
  drawing.drawImage(picture, 0, 0, canvas.width, canvas.height);
  return canvas;
}

/** @param {OffscreenCanvas} canvas */
function context(canvas) {
  return /** @type {OffscreenCanvasRenderingContext2D} */ (canvas.getContext("2d", { willReadFrequently: true }));
}

addEventListener("message", onMessage);
