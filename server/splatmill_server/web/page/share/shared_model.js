// A shared model in the viewer: what the page of a link and its frame have in common.

import { at, pathOfPage } from "../address.js";
import { Problem, get } from "../api.js";
import { byId, h } from "../dom.js";
import { noticeOf } from "../shell.js";

/** The address of the model that this page's link shows; below it are the same addresses as of a model of one's own. */
export const address = at(`${pathOfPage().split("/").slice(0, 3).join("/")}/model`);

/**
 * Show the model of this page's link in `#view`, or say there why that cannot be done. Returns what the link tells of it,
 * or null where the link shows nothing any more.
 * @returns {Promise<any>}
 */
export async function showShared() {
  const box = byId("view");
  /** @type {any} */
  let model;
  try {
    model = await get(address);
  } catch (error) {
    box.classList.remove("stage");
    box.replaceChildren(noticeOf(/** @type {Problem} */ (error)));
    return null;
  }
  const name = model.name || "Shared scene";
  document.title = `${name} - Splatmill`;
  byId("title").textContent = name;
  view(box, model, name);
  return model;
}

/** @param {HTMLElement} box @param {any} model @param {string} name */
async function view(box, model, name) {
  const has = (/** @type {string} */ file) => model.files.some((/** @type {any} */ found) => found.name === file);
  const still = has("preview.jpg") ? h("img", { class: "still", src: `${address}/files/preview.jpg`, alt: `A picture of ${name}` }) : null;
  if (still) box.append(still);
  try {
    const cameras = has("cameras.json") ? (await get(`${address}/cameras`)).cameras : [];
    const { open } = await import("../viewer.js");
    const shown = await open(box, { url: `${address}/files/model.ply`, model: address, cameras: cameras.map((/** @type {any} */ found) => found.camera), label: name });
    // The picture stays until the first frame, and for good where neither WebGL nor a renderer is there.
    shown.addEventListener("frame", () => still?.remove(), { once: true });
    shown.addEventListener("trouble", (event) => box.append(noticeOf(/** @type {any} */ (event).detail ?? "The scene cannot be drawn.", "warning")), { once: true });
  } catch (error) {
    box.append(noticeOf(/** @type {Error} */ (error), "warning"));
  }
}
