// The page at `/`: photos in, a job out.

import { Problem, each, get, send } from "../api.js";
import { byId, h, when } from "../dom.js";
import { bytes, count, nameOf, number } from "../format.js";
import { exampleOffer } from "../example.js";
import { estimateOf } from "./estimate.js";
import { Gallery } from "./gallery.js";
import { documentsIn } from "./documents.js";
import { chosen, dropped, suggestedName } from "./given.js";
import { Items } from "./items.js";
import { suffix } from "./kinds.js";
import { Looking } from "./looking/looking.js";
import { Overlap } from "./looking/overlap.js";
import { OptionsForm } from "./options.js";
import { Start } from "./start.js";
import { forget, recall } from "./remembered.js";
import { listsIn } from "./zip.js";
import { noticeOf, notify, startShell } from "../shell.js";

/** Captures that are listed. */
const LISTED = 9;

/** Milliseconds after the last change before the server is asked for an estimate. */
const ESTIMATE_AFTER = 400;

/** Milliseconds between two redraws while photos are being checked. */
const REDRAW = 150;

/** Timer of the next redraw. @type {number | undefined} */
let redrawing;

/** Timer of the next estimate. @type {number | undefined} */
let estimating;

/** What the last estimate was asked for. */
let asked = "";

/** The settings and files that the button was refused with: why it was stays shown until they are changed. */
let refusedWith = "";

/** Called once files can be taken. @type {() => void} */
let canTake = () => {};
/** @type {Promise<void>} */
const takes = new Promise((resolve) => (canTake = resolve));
wireDropping();

const caller = await startShell();
const [info, { options }] = await Promise.all([get("/v1/info"), get("/v1/options")]);
const items = new Items(info.accepted, info.limits.max_image_pixels);
const form = new OptionsForm(options, estimateSoon);
const gallery = new Gallery(byId("photos"), byId("others"), byId("more"), toggle);
const looking = new Looking(onLooked);
const overlap = new Overlap(redraw);
const start = new Start(items, form, { redraw: () => redraw(), problem: refused, job: () => job().body });

byId("settings-first").append(form.first);
byId("settings-all").append(form.all);
byId("drop-title").tabIndex = -1;
byId("camera").hidden = !matchMedia("(any-pointer: coarse)").matches;
byId("phone").hidden = matchMedia("(pointer: coarse)").matches; // it is one

wireGiving();
wireTools();
canTake();
byId("form").addEventListener("submit", (event) => {
  event.preventDefault();
  void start.go();
});
byId("pause").addEventListener("click", () => start.pause());
addEventListener("beforeunload", (event) => {
  if (start.sending) event.preventDefault();
});
byId("phone").addEventListener("toggle", showPhone, { once: true });

const query = new URLSearchParams(location.search);
const [wanted, earlier] = [query.get("capture"), query.get("options_of")];
if (wanted) await useCapture(wanted, earlier);
else await Promise.all([offerToGoOn(), listCaptures()]);
document.documentElement.dataset.ready = "";

function wireGiving() {
  /** @type {[string, string][]} */
  const pairs = [["choose", "files"], ["choose-folder", "folder"], ["camera", "shot"]];
  for (const [button, input] of pairs) {
    const field = /** @type {HTMLInputElement} */ (byId(input));
    byId(button).addEventListener("click", () => field.click());
    field.addEventListener("change", () => {
      take(chosen(field.files));
      field.value = "";
    });
  }
}

function wireDropping() {
  const zone = byId("drop");
  // Files that miss the zone, or are dropped before the page is ready, would replace it.
  addEventListener("dragover", (event) => {
    event.preventDefault();
    zone.classList.add("over");
  });
  addEventListener("dragleave", (event) => event.relatedTarget === null && zone.classList.remove("over"));
  addEventListener("drop", async (event) => {
    event.preventDefault();
    zone.classList.remove("over");
    if (!event.dataTransfer) return;
    try {
      const files = dropped(event.dataTransfer); // at once: the browser empties it after the event
      await takes;
      await take(await files);
    } catch (error) {
      notify(/** @type {Error} */ (error));
    }
  });
}

function wireTools() {
  byId("clear").addEventListener("click", () => {
    items.clear();
    start.reset();
    redraw();
    byId("drop-title").focus();
  });
  byId("leave-all").addEventListener("click", () => {
    for (const item of advised()) item.left = true;
    redraw();
  });
  const only = /** @type {HTMLInputElement} */ (byId("only-bad"));
  only.addEventListener("change", () => {
    gallery.onlyBad = only.checked;
    redraw();
  });
  byId("more").addEventListener("click", () => {
    gallery.whole = true;
    redraw();
  });
}

/** @param {import("./given.js").Given[]} given */
async function take(given) {
  const documents = await documentsIn(given);
  const lists = await listsIn(given, info.accepted.archives);
  if (!given.length) return notify("Nothing was found in what you dropped.", "warning");
  if (start.busy) return notify("Files are being sent. Pause first to give more.", "warning");
  const added = items.add(given, documents, lists);
  for (const item of added) {
    if (item.kind === "archive") void items.open(item).then(redraw);
    looking.add(item.id, item.file, item.kind, suffix(item.path));
  }
  if (!items.used.length && !start.held.length) {
    const kinds = info.accepted.photos.map((/** @type {string} */ ending) => ending.slice(1)).join(", ");
    notify(`None of these files can be used. ${items.remarks.join(" ") || `Photos are ${kinds} files.`}`, "warning");
  }
  start.adopt();
  if (added.some(({ role }) => role)) start.suggest(suggestedName(given, info.accepted));
  redraw();
}

/** @param {import("./looking/look.js").Looked} looked */
function onLooked(looked) {
  const item = items.all.find(({ id }) => id === looked.id);
  if (!item) return; // removed meanwhile
  const { thumbnail, error, ...seen } = looked;
  Object.assign(item, seen);
  item.picture = thumbnail;
  if (thumbnail) item.thumbnail = URL.createObjectURL(thumbnail);
  if (error) item.lost = "The file cannot be read. It may have been moved or changed; give it again.";
  start.compare(item);
  redrawSoon();
}

/** @param {import("./items.js").Item} item */
function toggle(item) {
  item.left = !item.left;
  redraw();
}

function advised() {
  return items.photos.filter((item) => !item.left && !item.stored && item.verdict.kind === "bad");
}

function redrawSoon() {
  redrawing ??= setTimeout(redraw, REDRAW);
}

function redraw() {
  clearTimeout(redrawing);
  redrawing = undefined;
  items.judge(start.held);
  gallery.show(items);
  const any = items.all.length > 0;
  const usable = items.used.length > 0 || start.held.length > 0;
  byId("given").hidden = byId("cards").hidden = !any;
  byId("settings").hidden = byId("go").hidden = !usable;
  byId("drop").classList.toggle("small-drop", any);
  byId("example").hidden ||= any;
  byId("summary").textContent = summary();
  // Where cameras come with the photos, nothing has to be recognised in two of them.
  overlap.consider(items.size(start.held, Infinity).posed ? [] : items.photos.filter((item) => !item.left));
  byId("remarks").dataset.compared = String(overlap.compared);
  byId("remarks").replaceChildren(...overlap.sentences.map((sentence) => h("li", { class: "error" }, sentence)), ...items.remarks.map((sentence) => h("li", {}, sentence)));
  if (items.photos.every((item) => item.state !== "waiting" || item.lost)) byId("checked").textContent = summary();
  const bad = advised().length;
  const leave = byId("leave-all");
  leave.hidden = bad === 0;
  leave.textContent = bad === 1 ? "Leave out the one that is advised against" : `Leave out all ${number(bad)} that are advised against`;
  byId("tools").hidden = items.photos.length === 0 && items.all.length === 0;
  start.show();
  estimateSoon();
}

function summary() {
  const photos = items.photos.filter((item) => !item.left);
  const checking = photos.filter((item) => item.state === "waiting" && !item.lost).length;
  const masks = items.used.filter((item) => item.kind === "mask").length;
  const left = items.photos.length - photos.length;
  const size = items.used.reduce((sum, item) => sum + item.file.size, 0);
  return [
    count(photos.length, "photo"), masks > 0 && count(masks, "mask"), bytes(size),
    checking > 0 && `${number(checking)} being checked`, checking === 0 && advised().length > 0 && `${number(advised().length)} to look at`,
    left > 0 && `${number(left)} left out`,
  ].filter(Boolean).join(", ");
}

function estimateSoon() {
  clearTimeout(estimating);
  estimating = setTimeout(() => void estimate(), ESTIMATE_AFTER);
}

/** The job that would be started, as the server estimates it; its photos are null where they cannot be counted here. */
function job() {
  const values = form.values();
  if (items.scan) values.start ??= items.scan;
  const { photos, exact, posed } = items.size(start.held, Number(values.max_video_frames) || options.find((/** @type {any} */ one) => one.name === "max_video_frames").default);
  return { photos, body: { photos: Math.max(1, photos ?? 1), exact, posed, capture: start.capture, options: values } };
}

/** What the job would be made of, as text to compare. */
function contents() {
  const { body, photos } = job();
  return JSON.stringify([body.options, photos, items.used.map(({ name, file }) => [name, file.size]), items.lacking]);
}

async function estimate() {
  if (byId("go").hidden || start.busy) return;
  const { body, photos } = job();
  const question = JSON.stringify([body, photos, items.lacking]);
  if (question === asked) return;
  asked = question;
  try {
    const estimate = await send("POST", "/v1/estimate", body);
    if (asked !== question) return;
    if (refusedWith !== contents()) showProblem(null);
    byId("estimate").replaceChildren(items.lacking ? h("p", { class: "error" }, items.lacking) : photos === null
      ? h("p", {}, "How long it will take is not known: the server has yet to count the photos in the archive.")
      : estimateOf(estimate, photos, info.queued, body.options));
  } catch (error) {
    if (!(error instanceof Problem) || asked !== question) return;
    asked = "";
    byId("estimate").replaceChildren();
    showProblem(error);
  }
}

/** Show a problem above the button, and beside the field that it concerns. @param {Error | null} problem */
function showProblem(problem) {
  const placed = form.show(problem instanceof Problem ? problem : null) && problem instanceof Problem;
  byId("problem").replaceChildren(...(placed ? form.errors.map((text) => h("p", { class: "error" }, text)) : problem ? [noticeOf(problem)] : []));
}

/** Show why the button did nothing, and lead to the field that is to be changed. @param {Error | null} problem */
function refused(problem) {
  refusedWith = problem ? contents() : "";
  showProblem(problem);
  form.lead();
}

async function showPhone() {
  const place = byId("phone-help");
  try {
    const { phoneHelp } = await import("./phone.js");
    place.replaceChildren(await phoneHelp(new URL(location.pathname + location.search, location.origin), info, caller?.key_name !== "no key"));
  } catch (error) {
    place.replaceChildren(h("p", {}, `Open ${location.href} on the phone. The code cannot be drawn: ${error instanceof Error ? error.message : error}`));
  }
}

/**
 * Offer a further job on a capture.
 * @param {string} id
 * @param {string | null} earlier  id of a job whose options the new one begins with
 */
async function useCapture(id, earlier) {
  try {
    const [capture, { entries }] = await Promise.all([get(`/v1/captures/${encodeURIComponent(id)}`), get("/v1/bin")]);
    start.use(capture);
    if (earlier) form.fill((await get(`/v1/jobs/${encodeURIComponent(earlier)}`)).options);
    showCapture(capture, entries.some((/** @type {any} */ entry) => entry.kind === "capture" && entry.id === capture.id));
  } catch (error) {
    notify(/** @type {Error} */ (error));
    await listCaptures();
  }
}

/**
 * Say what the server holds of a capture that a job is to be started on.
 * @param {any} capture @param {boolean} [deleted] whether it is in the bin
 */
function showCapture(capture, deleted = false) {
  const size = capture.files.reduce((/** @type {number} */ sum, /** @type {any} */ file) => sum + file.size, 0);
  byId("place").replaceChildren(h("div", { class: "notice" },
    h("p", {}, `${nameOf(capture, "Photos")}: ${count(capture.files.length, "file")}, ${bytes(size)}, already on the server.`),
    deleted && h("p", {}, h("strong", {}, "These photos are in the bin. "), "A job on them takes them out of it, and they are kept from then on."),
    h("p", {}, "Choose the settings of another job, or give more photos first. ", h("a", { href: "/" }, "Begin with new photos"))));
  byId("drop-title").textContent = "Drop more photos here";
  redraw();
}

/** Offer to continue an upload that another visit of this browser began, or to train what has arrived whole. */
async function offerToGoOn() {
  const upload = recall();
  if (!upload) return;
  /** @type {any} */
  let capture = null;
  if (upload.capture) {
    try {
      capture = await get(`/v1/captures/${encodeURIComponent(upload.capture)}`);
    } catch (error) {
      if (error instanceof Problem && error.status === 404) return forget(); // deleted meanwhile
      throw error;
    }
  }
  const there = upload.files.filter(([role, name, size]) => capture?.files.some((/** @type {any} */ file) => file.role === role && file.name === name && file.size === size)).length;
  if (capture && there === upload.files.length) {
    forget();
    if ((await get("/v1/jobs", { capture: capture.id, limit: 1 })).jobs.length) return; // its job began, and only the answer was lost
    form.restore(upload.options);
    start.use(capture);
    return showCapture(capture);
  }
  start.offer(upload, capture);
  form.restore(upload.options);
  const box = h("div", { class: "notice", "data-kind": "warning", id: "go-on" },
    h("p", {}, "An upload was interrupted ", when(upload.at), `: ${upload.name || "without a name"}, ${number(there)} of ${count(upload.files.length, "file")} arrived.`),
    h("p", {}, "Choose the same files again; those that are missing are sent. Browsers do not keep files for a page."),
    h("button", { type: "button", class: "small", onclick: () => {
      start.withdraw();
      forget();
      box.remove();
    } }, "Forget this upload"));
  byId("place").replaceChildren(box);
}

async function listCaptures() {
  const list = byId("capture-list");
  for await (const capture of each("captures", { limit: LISTED })) {
    if (list.children.length === LISTED) break;
    list.append(h("li", {}, h("a", { href: `/?capture=${encodeURIComponent(capture.id)}` }, nameOf(capture, "Photos"), h("span", {}, when(capture.created_at)))));
  }
  const none = list.children.length === 0;
  byId("captures").hidden = none;
  byId("example").hidden = !none || items.all.length > 0;
  if (none) byId("example").replaceChildren(exampleOffer());
}
