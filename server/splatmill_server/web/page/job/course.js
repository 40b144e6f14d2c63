// The course of a job, from its events: a reader of the same events gets the same course, from whichever event it begins.

import { FINAL, STATES } from "../job_states.js";

/** Names of the stages that progress is reported of. */
const STAGES = new Map(Object.entries({
  staging: "Fetching the photos",
  images: "Examining the photos",
  features: "Finding features",
  pairs: "Choosing pairs of photos",
  matching: "Matching pairs of photos",
  mapping: "Placing cameras",
  stereo: "Adding points by stereo",
  alignment: "Placing the scan",
  depth: "Reading the depth maps",
  loading: "Loading the photos",
  training: "Training",
  evaluation: "Comparing photos with the scene",
  writing: "Writing files",
}));

/** The name of a stage for people. @param {string} stage */
export function stageName(stage) {
  return STAGES.get(stage) ?? stage.replaceAll("_", " ");
}

const MOST_LINES = 1000;

/**
 * @typedef {object} Span a time in one state
 * @property {string} state
 * @property {number} from milliseconds since 1970
 * @property {number | null} to null while it lasts
 *
 * @typedef {object} Stage
 * @property {string} name
 * @property {number} done
 * @property {number | null} total
 * @property {string} note
 * @property {boolean} atMost whether `total` and `eta` are bounds
 * @property {number} began
 * @property {number} last time of the last report
 * @property {number | null} eta seconds until the stage ends
 */

export class Course {
  constructor() {
    this.state = "queued";
    this.attempt = 0;
    /** When the newest event was reported, milliseconds since 1970 by the server's clock. */
    this.time = 0;
    /** @type {any} the problem document of a job that failed */
    this.problem = null;
    /** @type {Span[]} */
    this.spans = [];
    /** @type {Map<string, Stage>} */
    this.stages = new Map();
    /** @type {any} the last progress event */
    this.progress = null;
    /** @type {any} */
    this.plan = null;
    /** @type {import("../chart.js").CurveRow[]} */
    this.rows = [];
    /** @type {import("./log.js").Line[]} */
    this.lines = [];
    /** Number of lines so far, those that are no longer kept included. */
    this.logged = 0;
    /** @type {any} the last event of cameras that were placed */
    this.cameras = null;
    /** @type {any} the last event of a snapshot */
    this.snapshot = null;
    /** @type {Map<string, any>} the last event of each unit of a scene in tiles, in the order of their first ones */
    this.units = new Map();
    /** Number of previews so far: it names the picture anew. */
    this.previews = 0;
  }

  get final() {
    return FINAL.includes(this.state);
  }

  /** Whether this has come as far as a record of the job says. @param {any} job */
  reached({ state, attempt, progress }) {
    if (FINAL.includes(state)) return this.final;
    if (state === "queued") return this.spans.length > 0;
    const [here, there] = [this.state, state].map((one) => Object.keys(STATES).indexOf(one));
    if (this.attempt !== attempt || here !== there) return this.attempt > attempt || (this.attempt === attempt && here > there);
    return !progress || (this.stages.get(progress.stage)?.done ?? -1) >= progress.done;
  }

  /** Add what an event says. @param {any} record */
  apply({ event, at, attempt }) {
    const time = Date.parse(at);
    this.time = Math.max(this.time, time);
    switch (event.type) {
      case "state":
        this.enter(event, time, attempt);
        break;
      case "progress":
        this.progress = event;
        this.advance(event, time);
        break;
      case "metric":
        // A run that resumed from a checkpoint measures again what came after it.
        this.rows = [...this.rows.filter((row) => row.step < event.step), event];
        break;
      case "plan":
        this.plan = event.plan;
        break;
      case "log":
        // After a restore of its Redis, the server sends lines again.
        if (this.lines.some((line) => line.at === at && line.message === event.message)) break;
        this.lines.push({ at, level: event.level ?? "info", message: event.message, about: event.about });
        this.logged += 1;
        if (this.lines.length > MOST_LINES) this.lines.shift();
        break;
      case "cameras":
        this.cameras = event;
        break;
      case "snapshot":
        this.snapshot = { ...event, time };
        break;
      case "unit":
        this.units = new Map(this.units).set(event.unit, event);
        break;
      case "preview":
        this.previews += 1;
        break;
    }
  }

  /** @param {any} event @param {number} time @param {number} attempt */
  enter(event, time, attempt) {
    const again = event.state === "queued" && this.spans.length > 0;
    if (again && attempt === 0) {
      // It was restarted: what happened before belongs to another run. What was measured may be gone on with.
      const { rows, lines, logged } = this;
      Object.assign(this, new Course(), { rows, lines, logged });
    }
    const open = this.spans.at(-1);
    if (open) open.to ??= time;
    this.state = event.state;
    this.attempt = attempt;
    this.problem = event.problem ?? null;
    this.progress = null;
    if (this.final || again) {
      // What was in work has ended with the attempt.
      this.units = new Map([...this.units].filter(([, unit]) => unit.state === "done" || unit.state === "failed"));
    }
    if (!this.final) this.spans.push({ state: event.state, from: time, to: null });
  }

  /** @param {any} event @param {number} time */
  advance(event, time) {
    const known = this.stages.get(event.stage);
    const anew = !known || event.done < known.done;
    const began = anew ? time : known.began;
    const passed = (time - began) / 1000;
    const share = event.total ? event.done / event.total : 0;
    const eta = event.eta ?? (share > 0.02 && passed > 1 ? (passed * (1 - share)) / share : null);
    this.stages.set(event.stage, {
      name: event.stage, done: event.done, total: event.total ?? null, note: event.note ?? "", atMost: event.at_most ?? false, began, last: time, eta,
    });
  }

  /** Seconds in each state so far, and at which of them it is now. @param {number} now milliseconds since 1970 */
  seconds(now) {
    /** @type {Map<string, number>} */
    const sums = new Map();
    for (const { state, from, to } of this.spans) {
      sums.set(state, (sums.get(state) ?? 0) + Math.max(0, (to ?? now) - from) / 1000);
    }
    return sums;
  }
}
