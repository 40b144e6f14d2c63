/**
 * What visitors get with a view, on pages of links, in frames, and in the page in one file: the annotations and
 * measurements of its owner, and a bar of buttons.
 *
 * @import {View} from "../viewer.js"
 * @import {Annotation} from "./annotations.js"
 * @import {Measurement, Scale} from "./lengths.js"
 * @import {Camera} from "./pose.js"
 * @typedef {object} Presentation  as GET /v1/models/{id}/presentation answers
 * @property {Camera | null} [start_view]
 * @property {"black" | "white"} [background]
 * @property {boolean} [auto_rotate]
 * @property {Scale | null} [scale]
 * @property {Measurement[]} [measurements]
 * @property {Annotation[]} [annotations]
 * @property {{keyframes: {camera_to_world: number[][], fov_y_deg: number}[], closed: boolean} | null} [camera_path]
 */
import { Annotations } from "./annotations.js";
import { hasTouch, help } from "./controls.js";
import { measuredLines } from "./lengths.js";
import { Turning } from "./turning.js";

/** What visitors are told until they have moved or touched the view. */
const HINT = "Drag to turn, wheel to come nearer, double click to turn about a point.";
const HINT_OF_TOUCH = "Tap and drag to turn, pinch to zoom.";

/** The pictures on the buttons, as paths in a square of 24. */
const ICONS = {
  start: "M4 11 12 4l8 7M6 10v9h4v-5h4v5h4v-9",
  turn: "M19 12a7 3.5 0 1 1-3.2-2.9M16 5.5v3.8h-3.8M5 12v2c0 2 3 3.6 7 3.6s7-1.6 7-3.6v-2",
  marks: "M3 16 16 3l5 5L8 21zM7 12l2 2M10 9l2 2M13 6l2 2",
  picture: "M4 8h4l1.5-2.5h5L16 8h4v11H4zM12 16.5a3.2 3.2 0 1 0 0-6.4 3.2 3.2 0 0 0 0 6.4",
  whole: "M9 4H4v5M15 4h5v5M9 20H4v-5M15 20h5v-5",
  help: "M9 9.2a3 3 0 1 1 4.3 2.7c-.9.5-1.3 1-1.3 2.1M12 17.5v.5",
};

/**
 * @param {HTMLElement} box  holds the view; it is what fills the screen
 * @param {View} view @param {Presentation} presentation @param {string} name  of pictures that are saved
 */
export function present(box, view, presentation, name) {
  const { annotations = [], measurements = [], scale = null } = presentation;
  const pins = new Annotations(view, annotations);
  const bar = document.createElement("div");
  bar.className = "view-bar";
  bar.setAttribute("role", "toolbar");
  bar.setAttribute("aria-label", "The view");
  const turning = new Turning(view, (on) => turn.setAttribute("aria-pressed", String(on)));
  const turn = button("turn", "Turn slowly", () => turning.turn(!turning.on));
  turn.setAttribute("aria-pressed", "false");
  const hint = document.createElement("p");
  hint.className = "said above-bar";
  hint.setAttribute("role", "status");
  hint.textContent = hasTouch() ? HINT_OF_TOUCH : HINT;
  const hide = () => {
    hint.textContent = "";
    view.element.classList.add("told"); // the view's own hint of touches does not take its place
  };

  let shown = true;
  const mark = () => {
    marks.setAttribute("aria-pressed", String(shown));
    view.mark({ lines: shown ? measuredLines(measurements, scale) : [] });
  };
  const marks = button("marks", "Measurements", () => {
    shown = !shown;
    mark();
  });
  mark();

  bar.append(button("start", "Start view", () => {
    turning.turn(false);
    view.goHome();
  }), turn);
  if (measurements.length) bar.append(marks);
  bar.append(button("picture", "Save a picture", () => savePicture(view, name).catch((error) => {
    hint.textContent = error.message;
  })));
  if (document.fullscreenEnabled) {
    bar.append(button("whole", "Full screen", () => (document.fullscreenElement ? document.exitFullscreen() : box.requestFullscreen())));
  }
  bar.append(button("help", "How it is moved", () => {
    hint.textContent = hint.textContent === help() ? "" : help();
  }));
  view.addEventListener("hand", hide);
  view.element.addEventListener("pointerdown", hide);
  view.element.after(hint, bar);
  if (presentation.auto_rotate && !matchMedia("(prefers-reduced-motion: reduce)").matches) turning.turn(true);
  return { pins, turning };
}

/**
 * Save the view as a picture.
 * @param {View} view @param {string} name  of the file, without its suffix
 */
export async function savePicture(view, name) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(await view.picture());
  link.download = `${name}.png`;
  link.click();
  URL.revokeObjectURL(link.href);
}

/** @param {keyof typeof ICONS} icon @param {string} text @param {() => void} press */
function button(icon, text, press) {
  const made = document.createElement("button");
  made.type = "button";
  made.title = text;
  made.setAttribute("aria-label", text);
  made.addEventListener("click", press);
  const picture = document.createElementNS("http://www.w3.org/2000/svg", "svg");
  picture.setAttribute("viewBox", "0 0 24 24");
  picture.setAttribute("aria-hidden", "true");
  const path = document.createElementNS("http://www.w3.org/2000/svg", "path");
  path.setAttribute("d", ICONS[icon]);
  picture.append(path);
  made.append(picture);
  return made;
}
