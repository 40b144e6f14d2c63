// The time that a job will take, as the server derives it from the jobs that it has finished.

import { count, seconds } from "../format.js";
import { h } from "../dom.js";

const STAGES = { cameras: "Cameras", training: "Training", rest: "Start, loading, measuring, storing" };

/** @typedef {{stage: keyof typeof STAGES, seconds: number | null, lowest: number | null, highest: number | null, because: string}} Stage */
/** @typedef {{seconds: number | null, lowest: number | null, highest: number | null, stages: Stage[], jobs: number, machine: string | null}} Estimate */

/**
 * Return an estimate as an element.
 * @param {Estimate} estimate
 * @param {number} photos
 * @param {number} waiting jobs that wait before it
 * @param {Record<string, any>} asked the settings
 */
export function estimateOf(estimate, photos, waiting, asked) {
  const { jobs, machine } = estimate;
  const queue = waiting > 0 ? ` ${count(waiting, "job")} ${waiting === 1 ? "waits" : "wait"} before it.` : "";
  if (jobs === 0 && estimate.seconds === null && estimate.stages.every((stage) => stage.seconds === null)) {
    return h("p", {}, `How long it will take is not known: no job has finished on this server yet.${queue}`);
  }
  const training = estimate.stages.find(({ stage }) => stage === "training");
  const timed = asked.time_budget && training?.seconds ? h("strong", {}, range(training)[0]) : null;
  const head = estimate.seconds !== null
    ? h("p", {}, "About ", h("strong", {}, range(estimate)[0]), range(estimate)[1], ` for everything, with ${count(photos, "photo")}, once the job has begun`,
      timed && [", of which ", timed, " are training"], `.${queue}`)
    : timed ? h("p", {}, "About ", timed, ` for the training alone. How long finding the cameras before it takes is not known yet.${queue}`)
      : h("p", {}, `How long all of it will take is not known yet.${queue}`);
  return h("div", {}, head, h("details", {}, h("summary", {}, "How this was derived"),
    h("dl", { class: "facts" }, estimate.stages.flatMap((stage) => [
      h("dt", {}, STAGES[stage.stage] ?? stage.stage),
      h("dd", {}, stage.seconds === null ? "not known. " : `${range(stage).join("")}. `, stage.because),
    ])),
    machine && h("p", { class: "hint" }, `Figures of ${count(jobs, "job")} on ${machine}. The cameras of a capture are recovered once; a further job on it does without that time.`)));
}

/**
 * The time that is estimated, and how long alike jobs took. Rounded, the estimate may be an end of its own range, which
 * then stands alone.
 * @param {{seconds: number | null, lowest: number | null, highest: number | null}} range
 * @returns {[string, string]} the time, and the range in brackets or nothing
 */
export function range({ seconds: middle, lowest, highest }) {
  const [from, about, to] = [lowest ?? middle, middle, highest ?? middle].map((time) => rough(time ?? 0));
  if (from === to) return [about, ""];
  return about === from || about === to ? [`${from} to ${to}`, ""] : [about, ` (${from} to ${to})`];
}

/** A duration without a precision that an estimate does not have. @param {number} given */
function rough(given) {
  if (given < 10) return seconds(Math.max(1, Math.round(given))).replace(".0", "");
  return seconds(given < 120 ? 5 * Math.round(given / 5) : given < 1800 ? 30 * Math.round(given / 30) : 300 * Math.round(given / 300)).replace(" 00 s", "");
}
