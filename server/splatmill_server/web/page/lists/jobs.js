// The list of jobs: state and progress of each, cancel, delete.

import { Problem, get, send } from "../api.js";
import { putInBin } from "../bin.js";
import { h, when } from "../dom.js";
import { decibels, nameOf, seconds } from "../format.js";
import { CANCELLING, FINAL, RUNNING, badgeKind, badgeText } from "../job_states.js";
import { exampleOffer } from "../example.js";
import { stageName } from "../job/course.js";
import { starButton, tagLinks } from "../labels.js";
import { listing } from "./listing.js";
import { confirmAction, startShell } from "../shell.js";

const REFRESH_MS = 4000; // between two requests for the unfinished jobs, while the page is visible

/** @param {any} job */
function entry(job) {
  const name = nameOf(job, "Job");
  const done = FINAL.includes(job.state);
  const { progress } = job;
  return h("li", {},
    poster(job),
    h("div", {},
      h("div", { class: "title" },
        h("a", { class: "whole", href: `/jobs/${job.id}`, "data-focus": "open" }, name),
        h("span", { class: "badge", "data-state": badgeKind(job.state) }, badgeText(job.state, job.cancel_requested))),
      !done && progress?.total
        ? h("progress", { value: progress.done, max: progress.total, "aria-label": `${name}: ${stageName(progress.stage)}` }) : null,
      tagLinks(job, "/jobs"),
      h("p", { class: "meta" }, facts(job).flatMap((fact) => [fact, " · "]), when(job.created_at))),
    h("div", { class: "actions" },
      starButton(`/v1/jobs/${job.id}`, job, (record) => list.update(record)),
      done ? null : h("button", { class: "quiet small", type: "button", "data-focus": "cancel", disabled: job.cancel_requested, onclick: () => cancel(job) }, "Cancel", hidden(name)),
      done ? h("button", { class: "quiet small", type: "button", "data-focus": "delete", onclick: () => remove(job) }, "Delete", hidden(name)) : null));
}

/** @param {string} name */
function hidden(name) {
  return h("span", { class: "visually-hidden" }, ` ${name}`);
}

/** @param {any} job */
function poster(job) {
  if (job.state === "succeeded" && job.model) return h("img", { class: "poster", src: `/v1/models/${job.model}/files/preview.jpg`, alt: "", loading: "lazy" });
  return h("div", { class: "poster none", "aria-hidden": "true" }, job.state === "failed" ? "no model" : job.state === "cancelled" ? "cancelled" : "…");
}

/** @param {any} job @returns {string[]} */
function facts(job) {
  const sentences = [];
  const { progress } = job;
  if (job.state === "failed" && job.problem) sentences.push(job.problem.title);
  if (job.state === "queued") {
    if (job.waiting_for) sentences.push(`waits for a worker of the queue ${job.waiting_for}`);
    else if (job.queue_position !== null && job.queue_position !== undefined) sentences.push(job.queue_position === 0 ? "next in the queue" : `${job.queue_position} before it`);
  }
  if (RUNNING.includes(job.state) && progress) {
    if (progress.psnr) sentences.push(decibels(progress.psnr));
    if (progress.eta) sentences.push(`${stageName(progress.stage)}: about ${seconds(progress.eta)} left`);
  }
  if (job.finished_at && job.started_at) sentences.push(`took ${seconds((Date.parse(job.finished_at) - Date.parse(job.started_at)) / 1000)}`);
  return sentences;
}

/** @param {any} job */
async function cancel(job) {
  const yes = await confirmAction({
    title: "Cancel this job?", text: CANCELLING, action: "Cancel the job", keep: "Let it run",
  });
  if (!yes) return;
  list.update(await send("POST", `/v1/jobs/${job.id}/cancel`));
}

/** @param {any} job */
function remove(job) {
  return removeAll([job]);
}

/** Put jobs into the bin, with their models. @param {any[]} jobs */
function removeAll(jobs) {
  return putInBin(jobs.map(({ id }) => ({ kind: "job", id })), "job", (ids) => ids.forEach(list.remove), list.reload);
}

async function refresh() {
  if (document.hidden) return;
  const open = list.records().filter((job) => !FINAL.includes(job.state));
  for (const { id } of open) {
    try {
      list.update(await get(`/v1/jobs/${id}`));
    } catch (error) {
      if (!(error instanceof Problem)) throw error;
      if (error.code === "job_not_found") list.remove(id); // somebody else has deleted it
      // Otherwise the server is away for a moment, and is asked again.
    }
  }
}

await startShell();
const list = await listing({
  noun: "jobs",
  limit: 30,
  query: ({ state, ...labels }) => ({ ...labels, state: state === "running" ? RUNNING : state }),
  entry,
  deleteAll: removeAll,
  deletable: (job) => FINAL.includes(job.state),
  empty: () => h("div", {}, h("p", {}, "There are no jobs yet. ", h("a", { href: "/" }, "Start with some photos"), "."), exampleOffer()),
});
setInterval(refresh, REFRESH_MS);
