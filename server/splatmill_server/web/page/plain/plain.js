// Pages without anything of their own to load: the glossary, and what stands at an address without a page.

import { QUALITY } from "../figures.js";
import { startShell } from "../shell.js";

await startShell({ open: true, visitor: true });
const words = document.getElementById("quality-words");
if (words) {
  const ranges = [...QUALITY].reverse().map(([least, word], i) => (i ? `from ${least} dB on it is ${word}` : `a picture of less than ${QUALITY[QUALITY.length - 2][0]} dB is ${word}`));
  words.textContent = `${ranges.slice(0, -1).join(", ")}, and ${ranges.at(-1)}`;
}
