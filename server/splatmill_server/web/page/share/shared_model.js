// A shared model in the viewer: what the page of a link and its frame have in common.

import { at, pathOfPage } from "../address.js";
import { Problem, get } from "../api.js";
import { byId } from "../dom.js";
import { noticeOf } from "../shell.js";

/** The address of the model that this page's link shows; below it are the same addresses as of a model of one's own. */
export const address = at(`${pathOfPage().split("/").slice(0, 3).join("/")}/model`);

/**
 * Show the model of this page's link in `#view`, or say there why that cannot be done. Returns what the link answers of it,
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
  void view(box, model, name);
  return model;
}

/** @param {HTMLElement} box @param {any} model @param {string} name */
async function view(box, model, name) {
  try {
    const has = model.files.some((/** @type {any} */ file) => file.name === "cameras.json");
    const [{ cameras, up }, presentation, { openModel }, { present }] = await Promise.all([
      has ? get(`${address}/cameras`) : { cameras: [] }, get(`${address}/presentation`), import("../opening.js"), import("../viewer/presented.js"),
    ]);
    const shown = { address, gaussians: model.gaussians, files: model.files, cameras, up, presentation };
    present(box, await openModel(box, shown, { antialias: model.antialias, label: name }), presentation, name);
  } catch (error) {
    // The picture of the model, which the page came with, stays.
    box.append(noticeOf(/** @type {Error} */ (error), "warning"));
  }
}
