// The file of a model that the viewer loads, made by the server when it is first asked for.

import { request } from "../api.js";

/** The format with the fewest bytes among those that the viewer draws; it costs about 0.03 dB. */
export const SMALL_FORMAT = "sog";

/** @param {string} address of a model, as /v1/models/ID */
export function smallFile(address) {
  return `${address}/download/${SMALL_FORMAT}`;
}

/** Let the server make the file where it is not there. Returns whether it is there then. @param {string} address of a model */
export function makeSmallFile(address) {
  return request("HEAD", smallFile(address)).then(() => true, () => false);
}
