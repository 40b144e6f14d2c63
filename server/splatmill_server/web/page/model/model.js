// The page of one model: the viewer with its tools, the comparison with held-out photos, downloads, orbit video, mesh, cameras.

import { at } from "../address.js";
import { Problem, get, idOfPage, modelAddress, request } from "../api.js";
import { byId, h, when } from "../dom.js";
import { ago, bytes, nameOf } from "../format.js";
import { showCompare } from "./compare.js";
import { showCameras } from "./cameras.js";
import { showDownloads } from "./downloads.js";
import { showMesh } from "./mesh.js";
import { showOrbit } from "./orbit.js";
import { Stage } from "./stage.js";
import { binText, binned } from "../bin.js";
import { figures } from "../figures.js";
import { labelButton, starButton, tagLinks } from "../labels.js";
import { originOf } from "./origin.js";
import { openSharing } from "../sharing.js";
import { confirmAction, noticeOf, startShell } from "../shell.js";

/**
 * What the parts of the page know of the model.
 * @typedef {object} Shown
 * @property {any} model the answer of `/v1/models/{id}`
 * @property {string} address that of the model, as `/v1/models/{id}`
 * @property {any[]} cameras those of the photos, with `name`, `split`, `camera`, `psnr`, `ssim` and `photo`; none if it has none
 * @property {any} up what is up, as `/v1/models/{id}/cameras` says it
 * @property {any} report the contents of report.json; `{}` if it has none
 * @property {import("../viewer/presented.js").Presentation} presentation how it is shown to people
 * @property {"black" | "white"} background the colour behind the model when it was measured
 */

await startShell({ viewer: true });
const id = idOfPage();
try {
  await show(await load(modelAddress(id)));
} catch (error) {
  byId("problem").append(noticeOf(/** @type {Error} */ (error)));
}

/** @param {string} address @returns {Promise<Shown>} */
async function load(address) {
  const model = await get(address);
  const has = new Set(model.files.map((/** @type {any} */ file) => file.name));
  const [presentation, { cameras, up }, report] = await Promise.all([
    get(`${address}/presentation`),
    has.has("cameras.json") ? get(`${address}/cameras`) : { cameras: [], up: null },
    has.has("report.json") ? get(`${address}/files/report.json`).catch(() => ({})) : /** @type {any} */ ({}),
  ]);
  const chosen = report.plan?.background ?? "random";
  const white = chosen === "white" || (chosen === "random" && report.facts?.transparent > 0);
  return { model, address, cameras, up, report, presentation, background: white ? "white" : "black" };
}

/** @param {Shown} shown */
async function show(shown) {
  const { model } = shown;
  showName(model);
  byId("lead").append(...figures(model), ` · ${bytes(model.bytes)} · made `, when(model.created_at));
  byId("actions").append(...actions(shown));
  void originOf(shown.report).then((origin) => origin && byId("lead").after(origin));
  byId("whole").hidden = false;
  showCompare(byId("compare"), shown);
  void showDownloads(byId("downloads"), shown);
  const stage = new Stage(shown);
  void showOrbit(byId("orbit"), shown, stage);
  void showMesh(byId("mesh"), shown, stage);
  showCameras(byId("cameras"), shown, stage);
  document.addEventListener("visibilitychange", () => {
    if (!document.hidden) void lookWhere(shown);
  });
  await lookWhere(shown);
  await stage.open();
}

/** Say that the model is in the bin, or that it was deleted while another page was shown. @param {{model: any, address: string}} shown */
async function lookWhere({ model, address }) {
  const place = byId("problem");
  try {
    await request("GET", address);
    const { entries } = await get("/v1/bin");
    const entry = entries.find((/** @type {any} */ one) => one.kind === "job" && one.id === model.job);
    place.replaceChildren();
    if (!entry) return;
    const box = noticeOf(`This model is in the bin, and deleted for good ${ago(entry.deleted_at)}.`, "warning");
    box.append(h("p", {}, h("button", { type: "button", onclick: async () => {
      await request("DELETE", binned("job", model.job));
      await lookWhere({ model, address });
    } }, "Restore")));
    place.replaceChildren(box);
  } catch (error) {
    if (!(error instanceof Problem)) throw error;
    if (error.status === 404) place.replaceChildren(noticeOf(error)); // otherwise the server is away for a moment
  }
}

/** @param {any} model */
function showName(model) {
  const name = nameOf(model, "Model");
  document.title = `${name} - Splatmill`;
  byId("title").textContent = name;
  byId("tags").replaceChildren(...[tagLinks(model, "/models")].filter((list) => list !== null));
}

/** @param {Shown} shown */
function actions({ model, address }) {
  const has = model.files.some((/** @type {any} */ file) => file.name === "report.html");
  return [
    h("button", { type: "button", onclick: () => openSharing(address, nameOf(model, "Model")) }, "Share"),
    labelButton(address, () => model, (record) => {
      Object.assign(model, { name: record.name, tags: record.tags });
      showName(model);
    }),
    starButton(address, model, (record) => (model.favourite = record.favourite)),
    has && h("a", { class: "button", href: `${address}/files/report.html`, target: "_blank", rel: "noopener" }, "Report"),
    h("a", { class: "button", href: `/jobs/${encodeURIComponent(model.job)}` }, "Job"),
    h("button", { class: "danger", type: "button", onclick: () => remove(model) }, "Delete"),
  ].filter((element) => element instanceof Node);
}

/** @param {any} model */
async function remove(model) {
  const yes = await confirmAction({
    title: "Delete this model?",
    text: binText("model", 1),
    action: "Delete the model",
  });
  if (!yes) return;
  await request("PUT", binned("job", model.job));
  location.assign(at("/models"));
}
