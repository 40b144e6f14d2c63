// The upload of all files of a capture: several at a time, repeated after breaks, paused and continued.

import { Problem } from "../../api.js";
import { sendFile } from "./one_file.js";

/** Files that are sent at once. */
const CONCURRENT = 4;

/** Statuses after which the same request may succeed later; 0 is a broken connection. */
const TRANSIENT = [0, 408, 425, 429, 500, 502, 503, 504];

/** Codes of answers after which the upload of a file is begun again, and continues where the server stands. */
const AGAIN = ["upload_offset_differs", "upload_completed", "upload_not_found", "body_cut_off", "digest_mismatch"];

/** Codes that concern one file; the others are sent all the same. */
const OF_ONE_FILE = ["name_taken", "name_invalid", "file_empty", "not_an_image", "image_truncated", "image_too_small", "image_too_large", "body_too_large", "unreadable"];

/** Attempts without progress after which the upload waits for a person. */
const PATIENCE = 8;

/** Seconds of the longest pause between two attempts. */
const LONGEST_PAUSE = 30;

/** Seconds over which the speed is measured. */
const SPEED_SECONDS = 8;

/** @typedef {import("./one_file.js").Sendable & {id: number}} Item */

/**
 * @typedef {object} State
 * @property {number} sent bytes that the server has or that are on their way
 * @property {number} total bytes of all files
 * @property {number} done files that the server has
 * @property {number} files
 * @property {number | null} speed bytes a second, or null before it is known
 * @property {number | null} eta seconds, or null before it is known
 * @property {string | null} waiting why nothing is sent now, or null
 */

export class Sending {
  /**
   * @param {string} capture
   * @param {Item[]} items
   * @param {Set<number>} there ids of items that the capture holds already
   * @param {object} on
   * @param {(state: State) => void} on.change
   * @param {(id: number, problem: Problem | null) => void} on.item called once a file is stored (null) or refused
   */
  constructor(capture, items, there, on) {
    this.capture = capture;
    this.on = on;
    this.items = items;
    /** @type {Map<number, number>} */
    this.positions = new Map(items.map((item) => [item.id, there.has(item.id) ? item.file.size : 0]));
    this.done = new Set(there);
    /** @type {Map<number, Problem>} */
    this.refused = new Map();
    this.total = items.reduce((sum, item) => sum + item.file.size, 0);
    /** @type {[number, number][]} */
    this.marks = [];
    /** @type {string | null} */
    this.waiting = null;
    this.reported = 0;
  }

  /**
   * Send what is missing; resolves once all files are stored or refused. Rejects with a Problem that ends the upload for
   * now, and with an AbortError after `pause`; then it can be called again, and continues.
   */
  async run() {
    this.control = new AbortController();
    this.marks = [];
    // Poses and masks go first: if one is refused, that is known before the photos are sent.
    const order = [...this.items].sort((one, other) => Number(one.role === "images") - Number(other.role === "images"));
    const queue = order.filter((item) => !this.done.has(item.id) && !this.refused.has(item.id)).values();
    const work = async () => {
      for (const item of queue) await this.send(item);
    };
    try {
      await Promise.all(Array.from({ length: CONCURRENT }, work));
    } catch (error) {
      this.control.abort();
      throw error;
    } finally {
      this.waiting = null;
      this.marks = []; // nothing is sent, so there is no speed
      this.tell(true);
    }
  }

  /** Stop sending. What has arrived is kept by the server. */
  pause() {
    this.control?.abort();
  }

  /** @param {Item} item */
  async send(item) {
    const signal = /** @type {AbortController} */ (this.control).signal;
    let tries = 0;
    let reached = -1;
    while (true) {
      try {
        await sendFile(this.capture, item, (position) => this.at(item, position), signal);
        this.done.add(item.id);
        this.on.item(item.id, null);
        this.tell(true);
        return;
      } catch (error) {
        if (!(error instanceof Problem)) throw error;
        if (OF_ONE_FILE.includes(error.code)) {
          this.refused.set(item.id, error);
          this.on.item(item.id, error);
          return;
        }
        const position = this.positions.get(item.id) ?? 0;
        if (position > reached) [reached, tries] = [position, 0];
        tries++;
        const passes = TRANSIENT.includes(error.status) || AGAIN.includes(error.code);
        if (!passes || tries > PATIENCE || signal.aborted) throw error;
        await this.rest(tries, error, signal);
      }
    }
  }

  /**
   * Wait before another attempt: longer each time, and no longer than until the device is connected again.
   * @param {number} tries
   * @param {Problem} problem
   * @param {AbortSignal} signal
   */
  async rest(tries, problem, signal) {
    const own = Math.min(LONGEST_PAUSE, 0.5 * 2 ** (tries - 1)) * (0.5 + Math.random() / 2);
    const seconds = Math.max(own, problem.facts.retry_after ?? 0);
    this.waiting = `${problem.message} Trying again (${tries} of ${PATIENCE}).`;
    this.tell(true);
    await new Promise((resolve, reject) => {
      const timer = setTimeout(resolve, 1000 * seconds);
      addEventListener("online", resolve, { once: true });
      signal.addEventListener("abort", () => {
        clearTimeout(timer);
        reject(new DOMException("The upload was paused.", "AbortError"));
      }, { once: true });
    });
    this.waiting = null;
  }

  /** @param {Item} item @param {number} position */
  at(item, position) {
    this.positions.set(item.id, Math.min(position, item.file.size));
    this.tell(false);
  }

  /** @param {boolean} always whether to tell at once, and not a tenth of a second after the last time */
  tell(always) {
    const now = performance.now() / 1000;
    if (!always && now - this.reported < 0.1) return;
    this.reported = now;
    const sent = this.sum();
    this.marks.push([now, sent]);
    while (this.marks.length > 2 && now - this.marks[0][0] > SPEED_SECONDS) this.marks.shift();
    const [since, before] = this.marks[0];
    const speed = now - since > 0.5 && sent > before ? (sent - before) / (now - since) : null;
    const eta = speed === null ? null : (this.total - sent) / speed;
    this.on.change({ sent, total: this.total, done: this.done.size, files: this.items.length, speed, eta, waiting: this.waiting });
  }

  sum() {
    let sent = 0;
    for (const item of this.items) sent += this.refused.has(item.id) ? item.file.size : this.positions.get(item.id) ?? 0;
    return sent;
  }
}
