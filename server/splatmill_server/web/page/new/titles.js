// What settings are called on the pages.

/** Those whose name says too little to somebody who has never trained a scene. @type {Record<string, string>} */
const TITLES = { within: "Time for everything", time_budget: "Time for training alone" };

/** @type {Record<string, string>} */
const ABBREVIATIONS = { psnr: "PSNR", sfm: "SfM", sh: "SH" };

/** The name of a setting in words. @param {string} name */
export function titleOf(name) {
  if (name in TITLES) return TITLES[name];
  const words = name.split("_").map((word) => ABBREVIATIONS[word] ?? word).join(" ");
  return words.replace(/^./, (letter) => letter.toUpperCase());
}
