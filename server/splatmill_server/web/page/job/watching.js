// Asks a job for snapshots for as long as this page is looked at: in the foreground, and with the live view on.

import { Problem, send } from "../api.js";

/** Share of the time for which a job makes snapshots after which it is asked again. */
const EARLY = 0.4;

export class Watching {
  /** @param {string} jobId @param {() => boolean} wanted whether the live view is on and the job runs */
  constructor(jobId, wanted) {
    this.address = `/v1/jobs/${encodeURIComponent(jobId)}/watch`;
    this.wanted = wanted;
    /** @type {ReturnType<typeof setTimeout> | undefined} */
    this.timer = undefined;
    this.asking = false;
    document.addEventListener("visibilitychange", () => this.check());
  }

  /** Ask now if that is due; call it when something has changed. */
  check() {
    const looks = document.visibilityState === "visible" && this.wanted();
    if (!looks) {
      clearTimeout(this.timer);
      this.timer = undefined;
    } else if (this.timer === undefined && !this.asking) {
      this.ask();
    }
  }

  async ask() {
    this.asking = true;
    let wait = 5;
    try {
      const { seconds } = await send("POST", this.address);
      if (!seconds) return; // it has ended
      wait = EARLY * seconds;
    } catch (error) {
      if (!(error instanceof Problem)) throw error;
      if (error.status === 404 || error.status === 403) return; // it is deleted, or the session is another owner's
    } finally {
      this.asking = false;
    }
    this.timer = setTimeout(() => {
      this.timer = undefined;
      this.check();
    }, 1000 * wait);
  }
}
