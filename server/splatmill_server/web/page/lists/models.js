// The list of models with their pictures, and what they occupy in storage.

import { at } from "../address.js";
import { get, modelAddress } from "../api.js";
import { putInBin } from "../bin.js";
import { append, byId, h, when } from "../dom.js";
import { qualityOf } from "../figures.js";
import { bytes, decibels, nameOf, number } from "../format.js";
import { exampleOffer } from "../example.js";
import { starButton, tagLinks } from "../labels.js";
import { listing } from "./listing.js";
import { pictureOf } from "../picture.js";
import { openSharing } from "../sharing.js";
import { startShell } from "../shell.js";
import { showBin } from "./bin_table.js";

/** @param {any} model */
function entry(model) {
  const name = nameOf(model, "Model");
  const picture = pictureOf(model.files);
  return h("li", { class: "tile" },
    picture
      ? h("img", { class: "poster", src: `/v1/models/${model.id}/files/${picture}`, alt: "", loading: "lazy" })
      : h("div", { class: "poster none", "aria-hidden": "true" }, "no picture"),
    h("div", { class: "body" },
      h("a", { class: "whole", href: `/models/${model.id}` }, name),
      h("p", { class: "figures" }, `${(model.psnr ?? null) === null ? "quality not measured" : `${qualityOf(model.psnr)}, ${decibels(model.psnr)}`} · ${number(model.gaussians)} Gaussians · ${bytes(model.bytes)}`),
      tagLinks(model, "/models"),
      h("div", { class: "foot" },
        h("span", {}, when(model.created_at)),
        h("span", { class: "actions push" },
          starButton(modelAddress(model.id), model, (record) => list.update(record)),
          h("button", { class: "quiet small", type: "button", onclick: () => openSharing(modelAddress(model.id), name) }, "Share", h("span", { class: "visually-hidden" }, ` ${name}`)),
          h("button", { class: "quiet small", type: "button", onclick: () => removeAll([model]) }, "Delete", h("span", { class: "visually-hidden" }, ` ${name}`))))));
}

/** Put models into the bin, with their jobs. @param {any[]} models */
function removeAll(models) {
  return putInBin(models.map(({ job }) => ({ kind: "job", id: job })), "model", (ids) => {
    ids.forEach(list.remove);
    return stored();
  }, back);
}

/** What was in the bin is listed again. */
async function back() {
  await list.reload();
  await stored();
}

/** Show what is in storage and in the bin. */
async function stored() {
  await storage(await showBin(byId("bin"), back));
}

const KINDS = /** @type {const} */ ([
  ["captures", "Photos", "s1"], ["models", "Models", "s2"], ["sfm", "Cameras", "s3"], ["jobs", "Checkpoints", "s4"],
]);

/** Show what the caller's records occupy: a bar, its key with the figures, and the largest records but those in the bin. @param {Set<string>} inBin */
async function storage(inBin) {
  const use = await get("/v1/storage", { largest: 6 + inBin.size });
  const largest = use.largest.filter((/** @type {any} */ record) => !inBin.has(record.id)).slice(0, 6);
  const body = byId("storage-body");
  body.replaceChildren();
  for (const owner of use.owners) {
    const kinds = KINDS.map(([kind, text, swatch]) => ({ text, swatch, size: owner.by_kind[kind] + (kind === "captures" ? owner.by_kind.uploads : 0) }));
    const whole = Math.max(owner.limit ?? owner.bytes, 1);
    const label = `${bytes(owner.bytes)}${owner.limit ? ` of ${bytes(owner.limit)}` : ""}`;
    append(body, [
      h("p", {}, use.owners.length > 1 ? h("strong", {}, `${owner.owner ?? "nobody"}: `) : null, label, owner.limit ? " used" : " in storage"),
      h("div", { class: "meter", "aria-hidden": "true" }, meter(kinds, whole)),
      h("ul", { class: "key" }, kinds.map(({ text, swatch, size }) => h("li", { class: swatch }, `${text} ${bytes(size)}`))),
    ]);
  }
  if (largest.length) {
    const expire = largest.some((/** @type {any} */ record) => record.expires_at);
    append(body, [h("div", { class: "scroll", tabindex: 0, role: "region", "aria-label": "Largest records" }, h("table", { class: "table stacks" },
      h("caption", {}, "The largest records"),
      h("thead", {}, h("tr", {}, ["What", "Name", "Last used", ...(expire ? ["Deleted"] : [])].map((text) => h("th", { scope: "col" }, text)), h("th", { scope: "col", class: "number" }, "Size"), h("td", {}))),
      h("tbody", {}, largest.map((/** @type {any} */ record) => h("tr", {},
        h("td", {}, kindOf(record)),
        h("td", {}, place(record)),
        h("td", { "data-label": "Last used" }, when(record.last_used)),
        expire ? h("td", { "data-label": "Deleted" }, record.expires_at ? when(record.expires_at) : "not by itself") : null,
        h("td", { class: "number" }, bytes(record.bytes)),
        h("td", {}, record.kind === "capture" ? deletePhotos(record) : null))))))]);
  }
  byId("storage").hidden = use.owners.length === 0;
}

/** A button that puts the photos of a capture into the bin. @param {any} record */
function deletePhotos({ id, name, needed_by: user }) {
  const text = name || id.slice(0, 8); // after the word "photos"
  return h("button", {
    class: "quiet small", type: "button", disabled: Boolean(user), title: user ? `The job ${user.slice(0, 8)} needs them.` : null, "aria-label": `Delete the photos ${text}`,
    onclick: () => putInBin([{ kind: "capture", id }], "photos", stored, stored),
  }, "Delete");
}

/** What a record in storage is, in words. @param {any} record */
function kindOf({ kind, complete }) {
  if (kind === "model" && complete === false) return "Unfinished model";
  return { capture: "Photos", job: "Checkpoints", model: "Model" }[/** @type {string} */ (kind)] ?? kind;
}

/** The name of a record in storage, which leads to its page; what there is of an unfinished model leads to its job. @param {any} record */
function place(record) {
  const name = nameOf(record, record.kind === "capture" ? "Photos" : record.kind === "model" ? "Model" : "Job");
  if (record.kind === "capture") return name;
  return h("a", { href: `/${record.kind === "model" && record.complete !== false ? "models" : "jobs"}/${record.id}` }, name);
}

/** @param {{swatch: string, size: number}[]} kinds @param {number} whole */
function meter(kinds, whole) {
  const space = "http://www.w3.org/2000/svg";
  const svg = document.createElementNS(space, "svg");
  svg.setAttribute("viewBox", "0 0 100 1");
  svg.setAttribute("preserveAspectRatio", "none");
  let from = 0;
  for (const { swatch, size } of kinds) {
    const bar = document.createElementNS(space, "rect");
    const width = (100 * size) / whole;
    for (const [name, value] of Object.entries({ x: from, y: 0, width, height: 1, class: swatch })) bar.setAttribute(name, String(value));
    svg.append(bar);
    from += width;
  }
  return svg;
}

await startShell();
const list = await listing({
  noun: "models",
  limit: 24,
  query: (filters) => filters,
  entry,
  deleteAll: removeAll,
  compare: ([left, right]) => location.assign(at(`/compare?${new URLSearchParams({ left, right })}`)),
  empty: () => h("div", {}, h("p", {}, "There are no models yet. ", h("a", { href: "/" }, "Start with some photos"), "."), exampleOffer()),
});
await stored();
