// The units of a scene in tiles: how many of each kind are done, which are worked on and where, and which failed.

import { h } from "../dom.js";
import { number, seconds } from "../format.js";

/** The kinds of units, in the order in which they are done. @type {[string, string][]} */
const KINDS = [["photos", "Photos"], ["features", "Features of photos"], ["pairs", "Pairs of photos"], ["matches", "Matches of pairs"],
  ["mapping", "Parts of the mapping"], ["cameras", "Cameras"], ["coarse", "Coarse model"], ["tile", "Tiles"], ["seam", "Last steps of tiles"], ["scene", "Whole scene"]];
/** Those that are left out where no unit of the kind has begun: the cameras are given, or one unit finds them. */
const OPTIONAL = ["features", "pairs", "matches", "mapping"];
/** Those of which there are as many as tiles. */
const OF_TILES = ["tile", "seam"];
/** Names that are written out; of others, their number is. */
const MOST_NAMES = 6;

/** The table of all units. @param {Map<string, any>} units the last event of each */
export function unitParts(units) {
  const events = [...units.values()];
  const { tiles } = events[0];
  return h("div", { class: "scroll" }, h("table", { class: "table" },
    h("thead", {}, h("tr", {},
      h("th", { scope: "col" }, "Part"),
      h("th", { scope: "col", class: "number" }, "Done"),
      h("th", { scope: "col" }, "In work or failed"),
      h("th", { scope: "col", class: "number" }, "Gaussians"),
      h("th", { scope: "col", class: "number" }, "Time of one"))),
    h("tbody", {}, KINDS.flatMap(([kind, title]) => {
      const those = events.filter(({ unit }) => unit === kind || unit.startsWith(`${kind}-`));
      if (!those.length && OPTIONAL.includes(kind)) return [];
      const done = those.filter(({ state }) => state === "done");
      const several = OF_TILES.includes(kind) ? `${number(done.length)} of ${number(tiles)}` : number(done.length);
      const one = !OF_TILES.includes(kind) && those.every(({ unit }) => unit === kind);
      return [h("tr", {},
        h("th", { scope: "row" }, title),
        h("td", { class: "number" }, one ? (done.length ? "✓" : "") : several),
        h("td", {}, work(those)),
        h("td", { class: "number" }, figure(done.reduce((sum, { gaussians }) => sum + (gaussians ?? 0), 0), number)),
        h("td", { class: "number" }, figure(mean(done), seconds)))];
    }))));
}

/** What is worked on, and what failed. @param {any[]} units */
function work(units) {
  const words = { running: "", elsewhere: " on other workers", failed: " failed" };
  return Object.entries(words).flatMap(([state, where]) => {
    const names = units.filter((unit) => unit.state === state).map(({ unit }) => unit.replace(/^(features|matches|mapping|tile|seam)-/, ""));
    if (!names.length) return [];
    const several = names.every((name) => /^[0-9]+$/.test(name));
    const listed = !several ? (state === "running" ? "yes" : "") : names.length > MOST_NAMES ? number(names.length) : names.join(", ");
    return [`${listed}${where}`.trim()];
  }).join("; ");
}

/** Mean seconds of the units that say theirs. @param {any[]} units */
function mean(units) {
  const known = units.map(({ seconds: spent }) => spent).filter((spent) => typeof spent === "number");
  return known.length ? known.reduce((sum, spent) => sum + spent, 0) / known.length : 0;
}

/** @param {number} value @param {(value: number) => string} text */
function figure(value, text) {
  return value ? text(value) : "";
}
