// Two models side by side, seen by one camera, with what each of them measures.

import { get, modelAddress } from "../api.js";
import { byId, h } from "../dom.js";
import { figures } from "../figures.js";
import { decibels, nameOf } from "../format.js";
import { openModel } from "../opening.js";
import { noticeOf, startShell } from "../shell.js";
import { sameWorld } from "./same_world.js";

/**
 * @typedef {object} Side a model of the page
 * @property {any} model
 * @property {any[]} cameras of its photos
 * @property {any} up what is up, as `/v1/models/{id}/cameras` says it
 * @property {any} presentation
 * @property {string} address
 */

await startShell({ viewer: true });
try {
  const asked = new URLSearchParams(location.search);
  const ids = ["left", "right"].map((side) => asked.get(side));
  if (!ids[0] || !ids[1]) throw new Error("Choose two models in the list: Select, tick both, Compare.");
  await show(await Promise.all(ids.map((id) => load(modelAddress(/** @type {string} */ (id))))));
} catch (error) {
  byId("problem").append(noticeOf(/** @type {Error} */ (error)));
}

/** @param {string} address @returns {Promise<Side>} */
async function load(address) {
  const [model, presentation] = await Promise.all([get(address), get(`${address}/presentation`)]);
  const has = model.files.some((/** @type {any} */ file) => file.name === "cameras.json");
  return { model, address, presentation, ...(has ? await get(`${address}/cameras`) : { cameras: [], up: null }) };
}

/** @param {Side[]} sides */
async function show(sides) {
  byId("whole").hidden = false;
  document.title = `${sides.map(({ model }) => nameOf(model, "Model")).join(" and ")} - Splatmill`;
  const together = sameWorld(sides[0].cameras, sides[1].cameras);
  byId("said").textContent = together
    ? "Both are seen by one camera: move either of them."
    : "These models have no coordinates in common, as they were not made from the same photos with the same cameras. Each is moved by itself.";
  const boxes = sides.map(() => h("div", { class: "stage" }));
  byId("pair").append(...sides.map((side, i) => h("figure", {}, boxes[i], h("figcaption", {},
    h("a", { href: `/models/${encodeURIComponent(side.model.id)}` }, nameOf(side.model, "Model")), h("div", { class: "muted" }, figures(side.model))))));
  const views = await Promise.all(sides.map(async (side, i) => {
    try {
      return await openModel(boxes[i], { ...side, gaussians: side.model.gaussians, files: side.model.files }, { label: nameOf(side.model, "Model") });
    } catch (error) {
      boxes[i].append(noticeOf(/** @type {Error} */ (error)));
      return null;
    }
  }));
  const [left, right] = views;
  if (left && right && together) {
    follow(left, right);
    follow(right, left);
    take(left, right);
  }
  showPhotos(sides, together, views);
  document.documentElement.dataset.ready = "";
}

/** Let one view show what another sees, now. @param {import("../viewer.js").View} from @param {import("../viewer.js").View} to */
function take(from, to) {
  [to.pose, to.distance, to.tangents] = [from.pose, from.distance, from.tangents];
  to.again();
}

/** Let one view show what another sees, whenever that is moved. @param {import("../viewer.js").View} from @param {import("../viewer.js").View} to */
function follow(from, to) {
  from.addEventListener("move", () => take(from, to));
}

/**
 * The photos that both models have not seen, with what each measures on them.
 * @param {Side[]} sides @param {boolean} together @param {(import("../viewer.js").View | null)[]} views
 */
function showPhotos(sides, together, views) {
  const held = sides.map(({ cameras }) => new Map(cameras.filter(({ split, psnr }) => split === "test" && psnr !== null).map((camera) => [camera.name, camera])));
  const names = [...held[0].keys()].filter((name) => held[1].has(name));
  if (!names.length) return;
  const look = (/** @type {string} */ name) => views.forEach((view, i) => {
    if (view && (i === 0 || !together)) view.setCamera(held[i].get(name).camera);
  });
  byId("photos").hidden = false;
  byId("photos").append(h("h2", { id: "photos-title" }, "Photos that neither has seen"),
    h("div", { class: "scroll", tabindex: 0, role: "region", "aria-labelledby": "photos-title" }, h("table", { class: "table" },
      h("thead", {}, h("tr", {}, h("th", { scope: "col" }, "Photo"), sides.map((side) => h("th", { scope: "col", class: "number" }, nameOf(side.model, "Model"))))),
      h("tbody", {}, names.map((name) => h("tr", {},
        h("td", {}, h("button", { type: "button", class: "quiet small", onclick: () => look(name) }, `Look from ${name}`)),
        held.map((cameras) => h("td", { class: "number" }, decibels(cameras.get(name).psnr)))))))));
}
