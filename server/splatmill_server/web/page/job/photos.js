// Which photos are used and how, which are not and why, and which do not agree with the others.

import { h } from "../dom.js";
import { count, number } from "../format.js";

/** What a photo is to the job, in words. job.css has a colour for each kind that has a camera. */
export const KINDS = /** @type {const} */ ({
  train: "trained on",
  test: "held out, to measure the error",
  doubtful: "not in agreement with the others",
  unused: "not used",
});

const SHOWN = 200;

/**
 * The kind of each photo with a camera.
 * @param {any} placement of `/v1/jobs/{id}/cameras`
 * @param {{photo: string, why: string}[]} misfits of the report; empty before there is one
 * @returns {Map<string, {kind: keyof typeof KINDS, why: string}>}
 */
export function kindsOf(placement, misfits) {
  const kinds = new Map();
  for (const { name, split } of placement.cameras) {
    const misfit = misfits.find(({ photo }) => photo === name);
    kinds.set(name, misfit ? { kind: "doubtful", why: misfit.why } : { kind: split === "test" ? "test" : "train", why: "" });
  }
  return kinds;
}

/** The colour of a kind's frusta. @param {HTMLElement} place any element of the page @param {keyof typeof KINDS} kind */
export function colorOf(place, kind) {
  return getComputedStyle(place).getPropertyValue(`--frustum-${kind}`).trim() || "gray";
}

/**
 * The section about photos: counts, a legend of the colours, and reasons.
 * @param {any} placement
 * @param {Map<string, {kind: keyof typeof KINDS, why: string}>} kinds
 * @returns {HTMLElement[]}
 */
export function photoParts(placement, kinds) {
  const unused = placement.unused ?? [];
  const counts = new Map();
  for (const { kind } of kinds.values()) counts.set(kind, (counts.get(kind) ?? 0) + 1);
  if (unused.length) counts.set("unused", unused.length);
  const doubtful = [...kinds].filter(([, { kind }]) => kind === "doubtful").map(([name, { why }]) => ({ name, why }));
  const parts = [];
  if (placement.final) {
    parts.push(h("ul", { class: "legend" }, [...counts].map(([kind, count]) =>
      h("li", { "data-kind": kind }, h("span", { class: "swatch", "aria-hidden": "true" }), `${number(count)} ${KINDS[/** @type {keyof typeof KINDS} */ (kind)]}`))));
  } else {
    parts.push(h("p", {}, `${count(placement.cameras.length, "camera")} and ${count(placement.points_total, "point")} are placed so far.`));
  }
  if (unused.length) parts.push(h("h3", {}, "Photos that are not used"), table(unused));
  if (doubtful.length) parts.push(h("h3", {}, "Photos that do not agree with the others"), table(doubtful));
  if (placement.final && !unused.length && !doubtful.length) parts.push(h("p", { class: "muted" }, "All photos are used."));
  return parts;
}

/** @param {{name: string, why: string}[]} rows */
function table(rows) {
  const more = rows.length - SHOWN;
  return h("div", {},
    h("div", { class: "scroll", tabindex: 0, role: "region", "aria-label": "Photos and reasons" },
      h("table", { class: "table" },
        h("thead", {}, h("tr", {}, h("th", { scope: "col" }, "Photo"), h("th", { scope: "col" }, "Reason"))),
        h("tbody", {}, rows.slice(0, SHOWN).map(({ name, why }) => h("tr", {}, h("th", { scope: "row" }, name), h("td", {}, why)))))),
    more > 0 && h("p", { class: "muted" }, `And ${number(more)} more.`));
}
