// The progress of an upload in words and as a bar.

import { bytes, count, number, seconds } from "../format.js";
import { byId } from "../dom.js";

/** @param {import("./upload/sending.js").State} state */
export function showProgress(state) {
  const bar = /** @type {HTMLProgressElement} */ (byId("sent"));
  bar.max = Math.max(1, state.total);
  bar.value = state.sent;
  const parts = [`${bytes(state.sent)} of ${bytes(state.total)}`, `${number(state.done)} of ${count(state.files, "file")}`];
  if (state.speed !== null) parts.push(`${bytes(state.speed)}/s`);
  if (state.eta !== null && state.sent < state.total) parts.push(`${seconds(Math.max(1, Math.round(state.eta))).replace(".0", "")} left`);
  byId("sent-text").textContent = parts.join(" · ");
  byId("sent-waiting").textContent = state.waiting ?? "";
}
