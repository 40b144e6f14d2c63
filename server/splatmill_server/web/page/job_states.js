// The states of a job, as every page names them.

/** Those that a job goes through, in order. */
export const STATES = /** @type {const} */ ({
  queued: "Waiting",
  preparing: "Reading photos",
  sfm: "Finding cameras",
  training: "Training",
  exporting: "Writing files",
});

/** Those in which a worker is at it. */
export const RUNNING = Object.keys(STATES).slice(1);

const ENDS = /** @type {const} */ ({ succeeded: "Finished", failed: "Failed", cancelled: "Cancelled" });

/** What cancelling does. */
export const CANCELLING = "It ends without a model. What it has done is kept, so a restart continues from there.";

/** Those that nothing follows. */
export const FINAL = Object.keys(ENDS);

const NAMES = /** @type {Record<string, string>} */ ({ ...STATES, ...ENDS });

/** What a badge says of a job. @param {string} state @param {boolean} stopping whether its cancellation is asked for */
export function badgeText(state, stopping) {
  return stopping && !FINAL.includes(state) ? "Stopping" : NAMES[state] ?? state;
}

/** The kind of a badge, which colours it. @param {string} state */
export function badgeKind(state) {
  return RUNNING.includes(state) ? "running" : state;
}
