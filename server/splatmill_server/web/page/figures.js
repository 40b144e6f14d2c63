// How large and how good a model is, in words that a link explains.

import { term } from "./dom.js";
import { decibels, number } from "./format.js";

/** @param {{gaussians: number, psnr?: number | null}} model @returns {(Node | string)[]} */
export function figures({ gaussians, psnr }) {
  const size = [number(gaussians), " ", term("Gaussians", "gaussian"), " · "];
  if (psnr === null || psnr === undefined) return [...size, "its quality was not measured"];
  return [...size, term(decibels(psnr), "quality"), " on photos that it has not seen"];
}
