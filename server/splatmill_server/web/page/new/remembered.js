// What this browser remembers of an upload that is under way, so that it can go on after the page was closed: which capture
// it goes to, and the names and sizes of its files. Browsers keep no files; they have to be given again.

import { at } from "../address.js";

/** Servers below several paths of one host share this storage. */
const KEY = `splatmill.upload${at("/").slice(1)}`;

/**
 * @typedef {object} Upload
 * @property {string} key makes the capture, once
 * @property {string} [capture] id of the capture, once it is known
 * @property {string} name
 * @property {Record<string, string>} options as they were typed
 * @property {[string, string, number][]} files role, name and size
 * @property {{key: string, body: string}} [job] the request that creates the job, once it was sent
 * @property {string} at when it began, ISO 8601
 */

/** @returns {Upload | null} */
export function recall() {
  try {
    const upload = JSON.parse(localStorage.getItem(KEY) ?? "null");
    return upload && Array.isArray(upload.files) && typeof upload.key === "string" ? upload : null;
  } catch {
    return null; // storage is off in this browser, or another version wrote it
  }
}

/** @param {Upload} upload */
export function remember(upload) {
  try {
    localStorage.setItem(KEY, JSON.stringify(upload));
  } catch {
    // Storage is off or full: the upload works, and only its continuation in another visit does not.
  }
}

export function forget() {
  try {
    localStorage.removeItem(KEY);
  } catch {
    // Storage is off.
  }
}

/** A text that nobody else makes. `crypto.randomUUID` is not there on pages that came over plain http. */
export function unique() {
  return [...crypto.getRandomValues(new Uint8Array(16))].map((byte) => byte.toString(16).padStart(2, "0")).join("");
}
