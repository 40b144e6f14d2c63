// From files and settings to a job: the capture is made, what it lacks is sent, the job is created once.

import { at } from "../address.js";
import { get, request, send, whole } from "../api.js";
import { byId } from "../dom.js";
import { count, number } from "../format.js";
import { showProgress } from "./progress.js";
import { forget, remember, unique } from "./remembered.js";
import { Sending } from "./upload/sending.js";

/** @typedef {import("./items.js").Item} Item */
/** @typedef {import("./items.js").Held} Held */
/** @typedef {import("./remembered.js").Upload} Upload */

export class Start {
  /**
   * @param {import("./items.js").Items} items
   * @param {import("./options.js").OptionsForm} form
   * @param {object} on
   * @param {() => void} on.redraw
   * @param {(problem: Error | null) => void} on.problem
   * @param {() => {options: Record<string, unknown>}} on.job the job that would be started, as the server estimates it
   */
  constructor(items, form, on) {
    this.items = items;
    this.form = form;
    this.on = on;
    /** Files that the capture holds. @type {Held[]} */
    this.held = [];
    /** @type {string | null} */
    this.capture = null;
    /** Whether the capture was there before, so that a job may be started without new files. */
    this.further = false;
    /** The name that was filled in. */
    this.suggested = "";
    /** @type {Upload | null} */
    this.offered = null;
    /** @type {Upload | null} */
    this.upload = null;
    this.busy = false;
    /** @type {Sending | null} */
    this.sending = null;
    /** The key of the request that creates the job, and the request that it belongs to. */
    this.job = { key: "", body: "" };
  }

  get name() {
    return /** @type {HTMLInputElement} */ (byId("name"));
  }

  /** Fill in a name where nobody has typed one. @param {string} name */
  suggest(name) {
    if (!this.name.value) this.name.value = this.suggested = name.slice(0, this.name.maxLength);
  }

  /** Start further jobs on a capture. @param {{id: string, name: string | null, files: Held[]}} capture */
  use(capture) {
    this.capture = capture.id;
    this.held = capture.files;
    this.further = true;
    this.name.value ||= capture.name ?? "";
  }

  /**
   * Continue an upload of an earlier visit once one of its files is given again.
   * @param {Upload} upload
   * @param {{id: string, files: Held[]} | null} capture
   */
  offer(upload, capture) {
    this.offered = upload;
    this.offeredHeld = capture?.files ?? [];
  }

  /** Begin anew, with another capture: what was sent of files that were removed is not to be trained. */
  reset() {
    if (this.further) return;
    if (this.upload) forget();
    if (this.name.value === this.suggested) this.name.value = "";
    this.upload = this.sending = this.capture = null;
    this.held = [];
    byId("sending").hidden = true;
  }

  withdraw() {
    this.offered = null;
  }

  /** Go on with the upload that was offered, if files of it were given. */
  adopt() {
    const offered = this.offered;
    if (!offered || this.capture) return;
    const known = new Set(offered.files.map((file) => file.join("\n")));
    if (!this.items.used.some((item) => known.has([item.role, item.name, item.file.size].join("\n")))) return;
    this.offered = null;
    this.upload = offered;
    this.capture = offered.capture ?? null;
    this.held = this.offeredHeld ?? [];
    this.name.value ||= offered.name;
    document.getElementById("go-on")?.remove();
    for (const item of this.items.all) this.compare(item);
  }

  /** Note whether the capture holds a file. @param {Item} item */
  compare(item) {
    item.stored = this.held.some((file) => file.role === item.role && file.name === item.name && file.size === item.file.size && file.sha256 === item.digest);
  }

  /** Show what the button does, and which stage this is at. */
  show() {
    const button = /** @type {HTMLButtonElement} */ (byId("start"));
    const missing = this.items.used.filter((item) => !item.stored);
    const refused = missing.filter((item) => item.problem).length;
    button.disabled = this.busy;
    button.textContent = this.sending && !this.busy ? "Go on" : refused > 0 && refused === missing.length ? `Train without ${refused === 1 ? "it" : `these ${number(refused)}`}`
      : missing.length === 0 && this.capture ? "Train" : this.upload ? "Go on and train" : "Upload and train";
    byId("pause").hidden = !(this.busy && this.sending);
  }

  pause() {
    this.sending?.pause();
  }

  /** Upload what is missing and create the job; then its page is shown. A second call while it runs does nothing. */
  async go() {
    if (this.busy) return;
    this.busy = true;
    this.on.problem(null);
    this.on.redraw();
    let last = "";
    try {
      if (this.items.problem || this.items.lacking) throw new Error(this.items.problem ?? this.items.lacking);
      await this.check();
      await this.looked();
      await this.makeCapture();
      if (!(await this.sendFiles())) return;
      const job = await this.createJob();
      this.sending = null;
      forget();
      location.assign(at(`/jobs/${job.id}`));
      await new Promise(() => {}); // the page is being left
    } catch (error) {
      if (error instanceof DOMException && error.name === "AbortError") last = "Paused";
      else this.on.problem(/** @type {Error} */ (error));
    } finally {
      this.busy = false;
      this.say(last);
      this.on.redraw();
    }
  }

  /** Let the server check the settings before anything is sent. */
  async check() {
    await send("POST", "/v1/estimate", this.on.job());
  }

  /** Wait until all files have been looked at; their digests are needed. */
  async looked() {
    const waiting = () => this.items.used.filter((item) => item.digest === null && !item.lost);
    while (waiting().length) {
      this.say(`Checking ${count(waiting().length, "file")}`);
      await new Promise((resolve) => setTimeout(resolve, 100));
    }
    const lost = this.items.used.find((item) => item.lost);
    if (lost) throw new Error(`${lost.name}: ${lost.lost} Or leave it out.`);
  }

  async makeCapture() {
    const files = this.items.used;
    this.upload ??= { key: `page-${unique()}`, name: "", options: {}, files: [], at: new Date().toISOString() };
    this.upload.name = this.name.value.trim();
    this.upload.options = this.form.typed();
    this.upload.files = files.map((item) => [item.role ?? "", item.name, item.file.size]);
    if (!this.further) remember(this.upload);
    if (!this.capture) {
      // With the key, a repeated request gets the same capture.
      const capture = await send("POST", "/v1/captures", { name: this.upload.name || null, key: this.upload.key });
      this.capture = capture.id;
      this.upload.capture = capture.id;
      if (!this.further) remember(this.upload);
    }
    this.held = (await get(`/v1/captures/${this.capture}`)).files;
    for (const item of files) this.compare(item);
  }

  /** Send what is missing; returns whether the job can be created. */
  async sendFiles() {
    const used = this.items.used.filter((item) => !item.problem);
    if (!used.some((item) => !item.stored)) return true;
    const sendable = used.flatMap(({ id, role, name, file, digest }) => (role && digest ? [{ id, role, name, file, digest }] : []));
    const byNumber = new Map(used.map((item) => [item.id, item]));
    const there = new Set(used.filter((item) => item.stored).map((item) => item.id));
    this.sending = new Sending(/** @type {string} */ (this.capture), sendable, there, {
      change: showProgress,
      item: (id, problem) => {
        const item = /** @type {Item} */ (byNumber.get(id));
        item.stored = problem === null;
        item.problem = problem;
      },
    });
    byId("sending").hidden = false;
    this.say("Uploading");
    this.on.redraw();
    await this.sending.run();
    this.sending = null;
    const refused = used.filter((item) => item.problem);
    if (!refused.length) return true;
    this.on.problem(new Error(`The server refused ${count(refused.length, "file")}: ${refused.slice(0, 3).map((item) => item.problem?.message).join(" ")}`));
    return false;
  }

  async createJob() {
    this.say("Starting the job");
    const body = { capture: this.capture, name: this.name.value.trim() || null, options: this.on.job().options };
    const text = JSON.stringify(body);
    this.job = this.upload?.job ?? this.job;
    if (this.job.body !== text) this.job = { key: `page-${unique()}`, body: text };
    if (this.upload && !this.further) {
      this.upload.job = this.job; // the job may have been created although its answer was lost with the page
      remember(this.upload);
    }
    const headers = { "Idempotency-Key": this.job.key };
    return whole((await request("POST", "/v1/jobs", { json: body, headers })).json());
  }

  /** @param {string} text what is being done, for screen readers too */
  say(text) {
    byId("doing").textContent = text;
  }
}
