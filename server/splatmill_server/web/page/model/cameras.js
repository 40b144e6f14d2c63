// The table of the cameras, from whose places the model can be looked at.

import { h } from "../dom.js";
import { count, decibels, number } from "../format.js";

/**
 * @import {Shown} from "./model.js"
 * @import {Stage} from "./stage.js"
 */

/**
 * @param {HTMLElement} section
 * @param {Shown} shown
 * @param {Stage} stage
 */
export function showCameras(section, { cameras }, stage) {
  if (!cameras.length) return;
  section.hidden = false;
  const held = cameras.filter((camera) => camera.split === "test").length;
  section.append(h("details", {},
    h("summary", {}, h("span", { id: "cameras-title" }, `Cameras: ${count(cameras.length, "photo")}, ${number(held)} of them held out`)),
    h("div", { class: "scroll" }, h("table", { class: "table" },
      h("thead", {}, h("tr", {}, ["Photo", "Used for"].map((text) => h("th", { scope: "col" }, text)),
        ["PSNR", "SSIM"].map((text) => h("th", { scope: "col", class: "number" }, text)),
        h("th", { scope: "col" }, h("span", { class: "visually-hidden" }, "View")))),
      h("tbody", {}, cameras.map((camera) => h("tr", {},
        h("td", {}, camera.name),
        h("td", {}, camera.split === "test" ? "Measuring" : "Training"),
        h("td", { class: "number" }, (camera.psnr ?? null) === null ? "" : decibels(camera.psnr)),
        h("td", { class: "number" }, (camera.ssim ?? null) === null ? "" : camera.ssim.toFixed(3)),
        h("td", {}, h("button", { type: "button", class: "quiet small", "aria-label": `Look from ${camera.name}`, onclick: () => stage.lookFrom(camera) }, "Look from here")))))))));
}
