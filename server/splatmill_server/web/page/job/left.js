// How long a job will still take, and a notification of the browser when it ends.

import { get, send } from "../api.js";
import { h } from "../dom.js";
import { seconds } from "../format.js";
import { holdsCameras, suffix } from "../new/kinds.js";
import { STATES } from "../job_states.js";
import { notify } from "../shell.js";

/** The states in which each part of an estimate passes. */
const PASSES_IN = /** @type {Record<string, string[]>} */ ({ cameras: ["sfm"], training: ["training"], rest: ["preparing", "exporting"] });

/**
 * What the server estimates of a job, by part, in seconds; null for what it cannot derive.
 * @param {any} job
 * @returns {Promise<Map<string, number | null>>}
 */
export async function estimateOf(job) {
  const [{ files }, { accepted }] = await Promise.all([get(`/v1/captures/${encodeURIComponent(job.capture)}`), get("/v1/info")]);
  const images = files.filter((/** @type {any} */ file) => file.role === "images").map((/** @type {any} */ file) => suffix(file.name));
  const posed = files.some((/** @type {any} */ file) => holdsCameras(file, accepted));
  const { stages } = await send("POST", "/v1/estimate", { photos: Math.max(images.length, 1), posed, options: job.options });
  // How many photos a zip, a video or the example holds is not known, and cameras take time for each.
  const counted = posed || images.every((/** @type {string} */ ending) => accepted.photos.includes(ending));
  return new Map(stages.map((/** @type {any} */ { stage, seconds }) => [stage, stage === "cameras" && !counted ? null : seconds]));
}

/**
 * Seconds until a job ends; null where a part of it is not known. What the running stage says of itself counts more than what
 * other jobs took, and a part that has taken longer than they did may end at any moment.
 * @param {import("./course.js").Course} course
 * @param {Map<string, number | null>} estimate
 * @param {number} now milliseconds since 1970
 */
export function secondsLeft(course, estimate, now) {
  const spent = course.seconds(now);
  const states = Object.keys(STATES);
  let sum = 0;
  for (const [part, passing] of Object.entries(PASSES_IN)) {
    if (passing.every((state) => states.indexOf(state) < states.indexOf(course.state))) continue; // it is over
    const running = course.stages.get(course.progress?.stage);
    const training = part === "training" && course.state === "training" ? running?.name : "";
    if (training === "evaluation" || (training === "training" && running?.eta != null)) {
      sum += Math.max(0, (running?.eta ?? 0) - (now - (running?.last ?? now)) / 1000);
      continue;
    }
    const whole = estimate.get(part) ?? null;
    if (whole === null) return null;
    sum += Math.max(0, whole - passing.reduce((before, state) => before + (spent.get(state) ?? 0), 0));
  }
  return sum;
}

/** @param {number | null} left */
export function sentenceOf(left) {
  if (left === null) return "";
  return left < 5 ? "The whole job ends in a moment." : `About ${seconds(Math.round(left))} until the whole job ends.`;
}

/**
 * A button that asks the browser to say when the job has ended, also while another tab is shown; null where it cannot.
 * @param {(on: boolean) => void} change
 */
export function notificationButton(change) {
  if (!("Notification" in window) || Notification.permission === "denied") return null;
  const button = h("button", { class: "small", type: "button", "aria-pressed": "false", onclick: async () => {
    const on = button.getAttribute("aria-pressed") !== "true";
    if (on && await Notification.requestPermission() !== "granted") {
      notify("The browser does not allow notifications of this server. Its settings for this page can allow them.", "warning");
      return;
    }
    button.setAttribute("aria-pressed", String(on));
    change(on);
  } }, "Notify me when it ends");
  return button;
}

/** @param {string} title @param {string} body */
export function showNotification(title, body) {
  try {
    const shown = new Notification(title, { body });
    shown.onclick = () => {
      window.focus();
      shown.close();
    };
  } catch {
    // Phones allow them to service workers alone; the page itself shows the end.
  }
}
