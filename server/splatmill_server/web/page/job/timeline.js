// The stages of a job with their progress, and what is to come.

import { h } from "../dom.js";
import { number, seconds } from "../format.js";
import { STATES } from "../job_states.js";
import { stageName } from "./course.js";

/** Stages of structure from motion, in the order in which they come. */
const SFM = ["images", "features", "pairs", "matching", "mapping", "stereo"];

/** Fill a list with the stages. @param {HTMLElement} list @param {import("./course.js").Course} course @param {number} now */
export function showTimeline(list, course, now) {
  const spent = course.seconds(now);
  const order = Object.keys(STATES);
  const at = course.final ? order.length : order.indexOf(course.state);
  // Where a job ended early, its last state is the one that it did not get through.
  const broke = course.state === "failed" || course.state === "cancelled" ? course.spans.at(-1)?.state : undefined;
  list.replaceChildren(...order.map((state, index) => {
    const reached = spent.has(state);
    const status = state === broke ? "stopped" : index < at && (reached || course.state === "succeeded") ? "done" : index === at ? "now" : "open";
    const words = { done: "done", now: "in progress", open: "to come", stopped: "stopped here" }[status];
    return h("li", { "data-status": status, "aria-current": status === "now" ? "step" : null },
      h("div", { class: "row" },
        h("span", { class: "mark", "aria-hidden": "true" }, { done: "✓", now: "●", open: "○", stopped: "✕" }[status]),
        h("strong", {}, STATES[/** @type {keyof typeof STATES} */ (state)]),
        h("span", { class: "visually-hidden" }, words),
        reached && h("span", { class: "muted number push" }, seconds(spent.get(state) ?? 0))),
      status === "now" && course.progress && current(course),
      state === "sfm" && reached && parts(course));
  }));
}

/** The bar of the stage that is worked on. @param {import("./course.js").Course} course */
function current(course) {
  const stage = course.stages.get(course.progress.stage);
  if (!stage) return null;
  const name = stageName(stage.name);
  return h("div", { class: "stage-now" },
    stage.total
      ? h("progress", { max: stage.total, value: Math.min(stage.done, stage.total), "aria-label": name })
      : h("progress", { "aria-label": name }),
    h("p", { class: "small number" }, sentence(course, stage, name)));
}

/** @param {import("./course.js").Course} course @param {import("./course.js").Stage} stage @param {string} name */
function sentence(course, stage, name) {
  const { progress } = course;
  const parts = [];
  if (stage.name === "training") {
    parts.push(`Step ${number(stage.done)}${stage.total ? ` of ${stage.atMost ? "at most" : "about"} ${number(stage.total)}` : ""}`);
    if (stage.note) parts.push(stage.note);
    if (progress.gaussians) parts.push(`${number(progress.gaussians)} Gaussians`);
  } else {
    parts.push(`${name}${stage.total ? `: ${number(stage.done)} of ${number(stage.total)}` : ""}`);
    if (stage.note && !/^(photos|pairs) /.test(stage.note)) parts.push(stage.note);
  }
  if (stage.eta !== null) parts.push(`${stage.atMost ? "at most" : "about"} ${seconds(stage.eta)} left of this stage`);
  return `${parts.join(", ")}.`;
}

/** The stages of structure from motion that are over. @param {import("./course.js").Course} course */
function parts(course) {
  const over = SFM.map((name) => course.stages.get(name)).filter((stage) => stage && stage.name !== course.progress?.stage);
  if (!over.length) return null;
  return h("ul", { class: "small muted parts" }, over.map((stage) => stage && h("li", {},
    `${stageName(stage.name)}${amount(course, stage)}`)));
}

/** How much a stage that is over did. @param {import("./course.js").Course} course @param {import("./course.js").Stage} stage */
function amount(course, { name, total }) {
  if (!total) return "";
  // Its last report of progress may not have been sent; the cameras were counted at the end.
  const placed = name === "mapping" && course.cameras?.final ? `${number(course.cameras.cameras)} of ` : "";
  return `: ${placed}${number(total)}`;
}
