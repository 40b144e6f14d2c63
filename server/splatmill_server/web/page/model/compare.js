// The comparison of held-out photos with the model: photo and rendering of the same camera under a slider, with the
// PSNR and SSIM of the report. The rendering is the server's, which is what was measured.

import { h, term } from "../dom.js";
import { count, decibels, number } from "../format.js";

/** @import {Shown} from "./model.js" */

/**
 * @param {HTMLElement} section
 * @param {Shown} shown
 */
export function showCompare(section, { address, cameras, background, report }) {
  const photos = cameras.filter((camera) => camera.photo);
  if (!photos.length) return;
  section.hidden = false;
  const render = h("img", { class: "render", alt: "" });
  const photo = h("img", { class: "photo", alt: "" });
  const pair = h("div", { class: "pair" }, render, photo, h("div", { class: "handle" }),
    h("span", { class: "tag left" }, "Photo"), h("span", { class: "tag right" }, "Model"));
  const caption = h("figcaption", { class: "number", role: "status" });
  const slider = h("input", { type: "range", min: 0, max: 100, value: 50, step: 1, "aria-label": "How much of the picture is the photo, in percent" });
  const fitted = h("div", { class: "fitted" }, pair, slider);
  const list = h("ul", { class: "photos", "aria-label": "Held-out photos" });
  const order = h("select", { "aria-label": "Order of the photos" },
    h("option", { value: "name" }, "In order"), h("option", { value: "worst" }, "Worst first"));
  const missing = cameras.filter((camera) => camera.split === "test").length - photos.length;
  let current = photos[0];

  const cut = () => pair.style.setProperty("--cut", `${slider.value}%`);
  slider.addEventListener("input", cut);
  pair.addEventListener("pointerdown", (event) => {
    pair.setPointerCapture(event.pointerId);
    drag(event);
  });
  pair.addEventListener("pointermove", (event) => event.buttons && drag(event));
  order.addEventListener("change", fill);

  /** @param {PointerEvent} event */
  function drag(event) {
    const box = pair.getBoundingClientRect();
    slider.value = String((100 * (event.clientX - box.left)) / box.width);
    cut();
  }

  /** @param {any} camera */
  function choose(camera) {
    current = camera;
    const { width, height } = camera.camera;
    pair.style.aspectRatio = `${width} / ${height}`;
    fitted.style.maxWidth = `calc(75vh * ${width / height})`;
    photo.src = `${address}/files/${camera.photo}`;
    photo.alt = `The photo ${camera.name}`;
    render.src = `${address}/render?${renderQuery(camera.camera, background)}`;
    render.alt = `The model from where ${camera.name} was taken`;
    caption.textContent = `${camera.name}: PSNR ${decibels(camera.psnr)}${(camera.ssim ?? null) === null ? "" : `, SSIM ${camera.ssim.toFixed(3)}`}`;
    for (const button of list.querySelectorAll("button")) {
      button.setAttribute("aria-pressed", String(button.dataset.name === camera.name));
    }
  }

  function fill() {
    const ordered = [...photos];
    if (order.value === "worst") ordered.sort((a, b) => (a.psnr ?? Infinity) - (b.psnr ?? Infinity));
    list.replaceChildren(...ordered.map((camera) => h("li", {},
      h("button", { type: "button", class: "quiet", "data-name": camera.name, onclick: () => choose(camera) },
        h("span", { class: "name" }, camera.name),
        h("span", { class: "number" }, `${decibels(camera.psnr)}${(camera.ssim ?? null) === null ? "" : ` · ${camera.ssim.toFixed(3)}`}`)))));
    choose(order.value === "worst" ? ordered[0] : current);
  }

  render.addEventListener("error", () => {
    caption.textContent = "The server did not render this view. Try again when it is less busy.";
  });
  section.append(
    h("h2", { id: "compare-title" }, "Against photos that it has not seen"),
    h("p", { class: "muted" }, `${count(photos.length, "photo")} ${photos.length === 1 ? "was" : "were"} `, term("held out", "held-out"), ` from the training. Figures are those of the training's report${report.result?.ssim ? `: on average ${decibels(report.result.psnr)}, SSIM ${report.result.ssim.toFixed(3)}` : ""}.`,
      missing > 0 && ` ${number(missing)} more ${missing === 1 ? "has" : "have"} no picture here; the report says why.`),
    h("div", { class: "compare" },
      h("figure", {}, fitted, caption),
      h("div", { class: "stack" }, order, list)));
  fill();
  cut();
}

/**
 * The query of `GET .../render` for a camera.
 * @param {any} camera
 * @param {string} background
 */
export function renderQuery(camera, background) {
  const { camera_to_world, ...fields } = camera;
  return new URLSearchParams({
    ...Object.fromEntries(Object.entries(fields).filter(([, value]) => value !== null).map(([name, value]) => [name, String(value)])),
    camera_to_world: camera_to_world.flat().join(","),
    background,
  });
}
