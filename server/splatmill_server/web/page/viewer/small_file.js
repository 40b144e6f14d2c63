// The file of a model that the viewer loads, made by the server when it is first asked for.

/** @import {Source} from "./source.js" */

import { get, request } from "../api.js";

/** The format with the fewest bytes among those that the viewer draws whole; it costs about 0.03 dB. */
const WHOLE = "sog";
/** Levels of detail, which the viewer loads in parts. */
const IN_PARTS = "lod.zip";
/** Gaussians from which a model is loaded in parts. As a .sog, it would have over 5 MB. */
const MANY = 2 ** 18;

/** @param {number} gaussians of a model */
export function smallFormat(gaussians) {
  return gaussians > MANY ? IN_PARTS : WHOLE;
}

/** @param {string} address of a model, as /v1/models/ID @param {number} gaussians @returns {Source} */
export function smallFile(address, gaussians) {
  const format = smallFormat(gaussians);
  return format === WHOLE ? wholeFile(address) : { url: `${address}/download/${format}`, levels: true };
}

/** @param {string} address of a model @returns {Source} */
export function wholeFile(address) {
  return { url: `${address}/download/${WHOLE}` };
}

/**
 * Let the server make the file where it is not there. Returns whether it is there then.
 * @param {string} address of a model @param {number} gaussians
 */
export function makeSmallFile(address, gaussians) {
  return request("HEAD", smallFile(address, gaussians).url ?? "").then(() => true, () => false);
}

/** Let the server make the file before anybody asks for it. @param {string} address of a model */
export async function prepareSmallFile(address) {
  const model = await get(address).catch(() => null); // whoever opens the model asks again
  if (model) await makeSmallFile(address, model.gaussians);
}
