// The worker that compares thumbnails, each with each: how many features two of them share.

import { featuresOf } from "./features.js";
import { shared } from "./matches.js";

/** @typedef {[number, number, number]} Link  two pictures, and how many features they share */

/** @param {MessageEvent<Blob[]>} message */
async function onMessage({ data: thumbnails }) {
  /** @type {import("./features.js").Features[]} */
  const features = [];
  for (const thumbnail of thumbnails) {
    const picture = await createImageBitmap(thumbnail);
    const { width, height } = picture;
    const drawing = /** @type {OffscreenCanvasRenderingContext2D} */ (new OffscreenCanvas(width, height).getContext("2d", { willReadFrequently: true }));
    drawing.drawImage(picture, 0, 0);
    picture.close();
    const { data } = drawing.getImageData(0, 0, width, height);
    const grey = Float32Array.from({ length: width * height }, (_, at) => 0.299 * data[4 * at] + 0.587 * data[4 * at + 1] + 0.114 * data[4 * at + 2]);
    features.push(featuresOf(grey, width, height));
  }
  /** @type {Link[]} */
  const links = [];
  features.forEach((one, i) => features.slice(0, i).forEach((other, j) => links.push([j, i, shared(other, one)])));
  postMessage(links);
}

addEventListener("message", onMessage);
