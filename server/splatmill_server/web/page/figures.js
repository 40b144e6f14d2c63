// How large and how good a model is, in words that a link explains.

import { term } from "./dom.js";
import { decibels, number } from "./format.js";

/** What a PSNR on held-out photos means, from the best on: the least dB, and words. docs/report.md explains them. */
export const QUALITY = /** @type {const} */ ([
  [30, "hard to tell from the photos"], [25, "good"], [20, "recognisable"], [-Infinity, "rough"],
]);

/** @param {number} psnr dB */
export function qualityOf(psnr) {
  return QUALITY.find(([least]) => psnr >= least)?.[1] ?? "";
}

/** @param {{gaussians: number, psnr?: number | null}} model @returns {(Node | string)[]} */
export function figures({ gaussians, psnr }) {
  const size = [number(gaussians), " ", term("Gaussians", "gaussian"), " · "];
  if (psnr === null || psnr === undefined) return [...size, "its quality was not measured"];
  return [...size, `${qualityOf(psnr)}, `, term(decibels(psnr), "quality"), " on photos that it has not seen"];
}
