// The page of a job: its course live, from the events of the server, and what may be done with it.

import { Problem, follow, get, idOfPage, send } from "../api.js";
import { ErrorChart } from "../chart.js";
import { byId, h } from "../dom.js";
import { figures } from "../figures.js";
import { bytes, count, moment, nameOf, number, seconds } from "../format.js";
import { CANCELLING, FINAL, badgeKind, badgeText } from "../job_states.js";
import { labelButton, starButton, tagLinks } from "../labels.js";
import { titleOf } from "../new/titles.js";
import { confirmAction, noticeOf, notify, startShell } from "../shell.js";
import { prepareSmallFile } from "../viewer/small_file.js";
import { Course, stageName } from "./course.js";
import { LiveScene } from "./live_scene.js";
import { estimateOf, notificationButton, secondsLeft, sentenceOf, showNotification } from "./left.js";
import { showLog, warningsOf } from "./log.js";
import { kindsOf, photoParts } from "./photos.js";
import { planParts } from "./plan.js";
import { showTimeline } from "./timeline.js";
import { unitParts } from "./units.js";
import { Watching } from "./watching.js";

/** Milliseconds between two questions for the place in the queue. */
const QUEUE_MS = 3000;
/** Milliseconds for which the server surely keeps a snapshot. */
const KEPT_MS = 45_000;
/** Milliseconds of a connection after which a job that runs is shown although not all was heard. */
const LONGEST_MS = 8000;
/** Names of the stages in a report, for people; docs/report.md says what each holds. */
const REPORTED = { sfm: "Cameras", load: "Loading photos", plan: "Planning", train: "Training", evaluate: "Measuring the error", export: "Writing the model", film: "Progress video", live: "Live view", time_lapse: "Time-lapse" };

await startShell({ viewer: true });
const id = idOfPage();
const address = `/v1/jobs/${encodeURIComponent(id)}`;
const chart = new ErrorChart(byId("curve"));
const scene = new LiveScene(byId("live"), id);
const watchBox = /** @type {HTMLInputElement} */ (byId("watch"));
/** @type {any} the job's record, as it was last asked for */
let job = null;
/** @type {any} */
let report = null;
/** @type {any} */
let placement = null;
let course = new Course();
/** What is shown already, so that parts are made anew only where something changed. */
let shown = { state: "", plan: null, units: /** @type {any} */ (null), rows: /** @type {any} */ (null), previews: 0, cameras: null, logged: 0, snapshot: null };
let drawing = 0;
/** What the server estimates of each part of the job. @type {Map<string, number | null>} */
let estimate = new Map();
let notifies = false;
let stream = { close() {} };
/** Whether all is heard that had happened when the record was asked for: nothing is shown anew before. */
let caughtUp = false;
const watching = new Watching(id, () => job !== null && watchBox.checked && !course.final && !FINAL.includes(job.state));

/** @type {HTMLAnchorElement} */ (byId("log-file")).href = `${address}/logs?format=text`;
watchBox.addEventListener("change", () => watching.check());
setInterval(() => { if (!course.final) again(); }, 1000);
try {
  job = await get(address);
  begin();
} catch (error) {
  if (!(error instanceof Problem)) throw error;
  byId("outcome").replaceChildren(noticeOf(error));
}

/** Follow the events from the first one on. */
function begin() {
  showName();
  stream.close();
  stream = follow(id, heard, connection, () => {
    course = new Course();
    caughtUp = false;
    refresh();
  });
  if (FINAL.includes(job.state)) return;
  const button = notificationButton((on) => (notifies = on));
  byId("notify").replaceChildren(...(button ? [button] : []));
  estimateOf(job).then((known) => {
    estimate = known;
    again();
  }, () => {}); // the photos may be deleted: each stage says by itself how long it takes
}

function showName() {
  byId("name").textContent = nameOf(job, "Job");
  byId("tags").replaceChildren(...[tagLinks(job, "/jobs")].filter((list) => list !== null));
}

/** @param {any} record */
function heard(record) {
  course.apply(record);
  caughtUp ||= !course.final && course.reached(job); // what has ended is shown with what is fetched then
  if (course.final) ended();
  if (record.event.type === "state" && (caughtUp || course.final)) refresh();
  again();
}

function ended() {
  stream.close();
  if (course.state === "succeeded" && !FINAL.includes(job.state)) {
    void prepareSmallFile(`/v1/models/${encodeURIComponent(job.model ?? id)}`); // before the model's page asks for it
  }
  byId("notify").replaceChildren();
  if (notifies) showNotification(nameOf(job, "Job"), `${badgeText(course.state, false)}.`);
  notifies = false;
}

/** @param {boolean} open */
function connection(open) {
  if (open) setTimeout(() => (caughtUp ||= !course.final), LONGEST_MS);
  const lost = document.getElementById("lost");
  if (open || course.final) lost?.remove();
  else if (!lost) {
    const box = noticeOf("The connection to the server is lost. What is shown is from before; the page reconnects by itself.", "warning");
    box.id = "lost";
    byId("outcome").before(box);
  }
}

/** Ask for the record anew, and for what only the end of a job brings. */
async function refresh() {
  try {
    job = await get(address);
    if (job.state === "succeeded" && !report) report = await get(`${address}/report`);
    if (FINAL.includes(job.state)) await afterEnd();
  } catch (error) {
    if (!(error instanceof Problem)) throw error;
    if (error.status !== 404) notify(error);
    else if (error.code === "job_not_found") {
      job = null; // nothing is asked for or shown any more
      stream.close();
      byId("actions").replaceChildren();
      byId("outcome").replaceChildren(noticeOf(error));
    }
  }
  caughtUp ||= course.final;
  shown.state = "";
  again();
}

/** What storage has of a job whose events are gone. */
async function afterEnd() {
  if (!course.rows.length) course.rows = (await get(`${address}/curve`)).rows;
  if (!course.lines.length) {
    course.lines = (await get(`${address}/logs`)).lines;
    course.logged = course.lines.length;
  }
  course.plan ??= job.plan ?? report?.plan ?? null;
  if (job.state === "succeeded") {
    course.previews ||= 1;
    if (!placement) await fetchCameras();
  }
  showPhotos();
  showWarnings();
}

async function fetchCameras() {
  try {
    placement = await get(`${address}/cameras`);
  } catch (error) {
    if (!(error instanceof Problem)) throw error;
    return; // none are known yet, or the next event asks again
  }
  showPhotos();
}

/** Show what has changed, with the next frame; many events before it are one change. */
function again() {
  if (!drawing) drawing = requestAnimationFrame(draw);
}

function draw() {
  drawing = 0;
  if (!job || !caughtUp || !(course.spans.length || course.final)) return;
  byId("course").hidden = byId("state").hidden = false;
  if (shown.state !== course.state) {
    if (shown.state !== "" || course.final) byId("announcement").textContent = `${badgeText(course.state, false)}.`;
    shown.state = course.state;
    showState();
    watching.check();
  }
  document.title = `${pageTitle()} - Splatmill`;
  showTimeline(byId("stages"), course, Date.now());
  byId("left").textContent = course.final ? "" : sentenceOf(secondsLeft(course, estimate, Date.now()));
  if (shown.rows !== course.rows) {
    shown.rows = course.rows;
    chart.update(course.rows);
  }
  if (shown.plan !== course.plan) {
    shown.plan = course.plan;
    byId("plan-card").hidden = !course.plan;
    if (course.plan) byId("plan").replaceChildren(...planParts(course.plan));
  }
  if (shown.units !== course.units) {
    shown.units = course.units;
    byId("units-card").hidden = !course.units.size;
    if (course.units.size) byId("units").replaceChildren(unitParts(course.units));
  }
  if (shown.logged !== course.logged) {
    shown.logged = course.logged;
    showLog(byId("log"), course.lines);
    showWarnings();
  }
  if (course.previews !== shown.previews) {
    shown.previews = course.previews;
    scene.newPreview(course.previews);
  }
  if (course.cameras !== shown.cameras) {
    shown.cameras = course.cameras;
    fetchCameras();
  }
  scene.expect(course.previews > 0 || course.cameras !== null);
  if (course.snapshot !== shown.snapshot && !course.final) {
    shown.snapshot = course.snapshot;
    // By the server's clock: this device's may be wrong.
    if (course.snapshot && course.time - course.snapshot.time < KEPT_MS) scene.newSnapshot(course.snapshot);
  }
}

function pageTitle() {
  const name = nameOf(job, "Job");
  const { progress } = course;
  if (course.final || !progress?.total) return `${name}: ${badgeText(course.state, false).toLowerCase()}`;
  return `${Math.floor((100 * progress.done) / progress.total)} % of ${stageName(progress.stage).toLowerCase()}: ${name}`;
}

/** The state, the outcome, and what may be done now. */
function showState() {
  const badge = byId("state");
  badge.dataset.state = badgeKind(course.state);
  badge.textContent = badgeText(course.state, job.cancel_requested);
  showOutcome();
  showActions();
  byId("facts").replaceChildren(...facts().flatMap(([name, value]) => [h("dt", {}, name), h("dd", {}, value)]));
  const over = course.final;
  // A job that failed early has neither a scene nor a curve, and none will come.
  const early = over && course.state !== "succeeded";
  byId("live-card").hidden = early && !course.previews && !course.cameras && !placement && !course.snapshot;
  byId("curve-card").hidden = early && !course.rows.length;
  for (const name of ["watch", "watch-hint"]) byId(name).closest(name === "watch" ? "label" : "p")?.toggleAttribute("hidden", over);
  if (course.state === "failed") byId("details").setAttribute("open", ""); // the log says how far it came
  showSeconds();
  if (course.state === "queued") setTimeout(() => { if (job && course.state === "queued") refresh(); }, QUEUE_MS);
}

/** A message that says the same is left alone: screen readers would read it out again. */
function showOutcome() {
  const parts = outcome();
  const said = parts.map((part) => part.textContent).join("\n");
  const place = byId("outcome");
  if (place.dataset.said !== said) place.replaceChildren(...parts);
  place.dataset.said = said;
}

function outcome() {
  if (course.state === "succeeded") {
    const result = report?.result;
    const box = noticeOf("The model is finished.", "good");
    if (result) box.append(h("p", {}, figures(result)));
    box.append(h("p", { class: "row" }, h("a", { class: "button primary", href: `/models/${encodeURIComponent(job.model ?? id)}` }, "Open the model"),
      report && h("a", { href: `/v1/models/${encodeURIComponent(job.model ?? id)}/files/report.html` }, "Report")));
    return [box];
  }
  if (course.state === "failed") return [failure(course.problem ?? job.problem)];
  if (course.state === "cancelled") return [noticeOf("The job is cancelled. A restart continues from its last checkpoint, if it has one.", "warning")];
  if (job.cancel_requested) return [noticeOf("The job is being cancelled: it ends once its process has ended.", "warning")];
  if (course.state === "queued") return [noticeOf(waiting())];
  return [];
}

function waiting() {
  if (job.waiting_for) return `No running worker serves "${job.waiting_for}". The job starts when one does.`;
  const { queue_position: place, estimated_start: start } = job;
  const when = start ? ` It probably begins at ${moment(start)}.` : "";
  if (place === null || place === undefined) return `The job begins in a moment.${when}`;
  return place === 0 ? `The job is the next to begin.${when}` : `${count(place, "job")} ${place === 1 ? "is" : "are"} run before this one.${when}`;
}

/** @param {any} problem */
function failure(problem) {
  const box = noticeOf(new Problem(problem ?? { code: "internal_error", status: 500, title: "The job failed", detail: "The job failed, and the server gave no reason." }));
  box.prepend(h("h2", {}, problem?.title ?? "The job failed"));
  const skipped = problem?.facts?.skipped;
  if (Array.isArray(skipped) && skipped.length) {
    box.append(h("details", {}, h("summary", {}, `${count(skipped.length, "photo")} not used`), h("ul", {}, skipped.map((text) => h("li", {}, String(text))))));
  }
  return box;
}

/** Buttons are made anew only where others are needed: a button that is replaced loses the focus. */
function showActions() {
  const key = `${course.state === "succeeded"} ${course.final} ${job.cancel_requested}`;
  const place = byId("actions");
  if (place.dataset.key !== key) place.replaceChildren(...actions());
  place.dataset.key = key;
}

function actions() {
  const other = h("a", { class: "button", href: `/?capture=${encodeURIComponent(job.capture)}&options_of=${encodeURIComponent(job.id)}` }, course.final ? "Train with other options" : "New job with other options");
  const labels = [labelButton(address, () => job, (record) => {
    job = record;
    showName();
    again();
  }), starButton(address, job, (record) => (job = record))];
  if (!course.final) {
    return [other, ...labels, h("button", { type: "button", class: "danger", disabled: job.cancel_requested, onclick: cancel }, "Cancel")];
  }
  return [other, ...labels, course.state === "succeeded" ? null : h("button", { type: "button", onclick: restart }, "Restart")].filter((part) => part !== null);
}

async function cancel() {
  if (!await confirmAction({ title: "Cancel this job?", text: CANCELLING, action: "Cancel the job", keep: "Let it run" })) return;
  try {
    job = await send("POST", `${address}/cancel`);
  } catch (error) {
    if (!(error instanceof Problem)) throw error;
    notify(error);
  }
  refresh();
}

async function restart() {
  try {
    job = await send("POST", `${address}/restart`);
  } catch (error) {
    if (!(error instanceof Problem)) throw error;
    notify(error);
    return;
  }
  report = placement = null;
  course = new Course();
  shown = { ...shown, state: "-", snapshot: null };
  begin();
}

/** @returns {[string, any][]} */
function facts() {
  /** @type {[string, any][]} */
  const rows = [["Created", moment(job.created_at)]];
  if (job.attempt > 1) rows.push(["Attempt", number(job.attempt)]);
  const set = Object.entries(job.options).filter(([, value]) => value !== null && value !== "auto");
  const said = ["preset", "within", "time_budget", "steps", "max_gaussians", "image_size", "backend"];
  for (const name of said) {
    const setting = set.find(([key]) => key === name);
    if (!setting) continue;
    const [, value] = setting;
    rows.push([titleOf(name), name === "time_budget" || name === "within" ? seconds(value) : typeof value === "number" ? number(value) : String(value)]);
  }
  if (report?.peak_memory) rows.push(["Memory", `${bytes(report.peak_memory)} at most`]);
  rows.push(["Capture", h("code", {}, job.capture)]);
  return rows;
}

function showPhotos() {
  if (!placement) return;
  const kinds = kindsOf(placement, report?.misfits ?? []);
  byId("photos-card").hidden = false;
  byId("photos").replaceChildren(...photoParts(placement, kinds));
  scene.setPlacement(placement, kinds);
}

function showWarnings() {
  const sentences = [...new Set([...warningsOf(course.lines), ...(report?.warnings ?? [])])];
  byId("warnings-card").hidden = !sentences.length;
  byId("warnings").replaceChildren(...sentences.map((text) => h("li", {}, text)));
}

function showSeconds() {
  const rows = Object.entries(report?.seconds ?? {}).filter(([, spent]) => Number(spent) > 0);
  byId("seconds-card").hidden = !rows.length;
  if (!rows.length) return;
  const whole = rows.reduce((sum, [, spent]) => sum + Number(spent), 0);
  byId("seconds").replaceChildren(h("div", { class: "scroll" }, h("table", { class: "table" },
    h("thead", {}, h("tr", {}, h("th", { scope: "col" }, "Stage"), h("th", { scope: "col", class: "number" }, "Time"), h("th", { scope: "col" }, "Share"))),
    h("tbody", {}, rows.map(([name, spent]) => h("tr", {},
      h("th", { scope: "row" }, /** @type {Record<string, string>} */ (REPORTED)[name] ?? name),
      h("td", { class: "number" }, seconds(Number(spent))),
      h("td", {}, h("meter", { min: 0, max: whole, value: Number(spent), "aria-label": `${Math.round((100 * Number(spent)) / whole)} %` }))))))));
}
