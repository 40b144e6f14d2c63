// The page of a link: one model, for somebody without a key.

import { get } from "../api.js";
import { byId, h } from "../dom.js";
import { figures } from "../figures.js";
import { bytes, moment } from "../format.js";
import { copy, frameOf } from "../sharing.js";
import { address, showShared } from "./shared_model.js";
import { startShell } from "../shell.js";

const KINDS = /** @type {Record<string, string>} */ ({
  "report.html": "Report",
  "report.png": "Quality against time", "cameras.json": "Cameras of the photos", "preview.jpg": "Picture", "poster.jpg": "Picture from the start view", "progress.mp4": "Film of the training",
});

await startShell({ open: true, visitor: true });
const model = await showShared();
if (model) {
  byId("figures").append(...figures(model));
  const { formats } = await get(`${address}/formats`);
  byId("downloads").append(...formats.map((/** @type {any} */ format) => h("li", {},
    h("a", { href: format.address, download: "", title: format.loses }, format.name),
    h("span", { class: "number" }, format.bytes === null ? "made on demand" : bytes(format.bytes)))));
  byId("downloads").append(...model.files.filter((/** @type {any} */ file) => file.name in KINDS).map((/** @type {any} */ file) => h("li", {},
    h("a", { href: `${address}/files/${file.name}`, download: file.name }, KINDS[file.name]),
    h("span", { class: "number" }, `${file.name.split(".").pop()}, ${bytes(file.size)}`))));
  const frame = /** @type {HTMLTextAreaElement} */ (byId("embed"));
  frame.value = frameOf(`${location.origin}${location.pathname.replace(/\/$/, "")}`, model.name || "A scene in 3D");
  frame.addEventListener("focus", () => frame.select());
  byId("copy").addEventListener("click", () => copy(frame, byId("copied")));
  byId("until").textContent = `This link is valid until ${moment(model.expires_at)}.`;
  byId("below").hidden = false;
}
