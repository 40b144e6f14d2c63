// One request that sends bytes, with progress. `fetch` does not report the bytes sent, so this is an XMLHttpRequest.

import { at } from "../../address.js";
import { Problem } from "../../api.js";

/**
 * @typedef {object} Answer
 * @property {number} status 0 where the connection broke
 * @property {(name: string) => string | null} header
 * @property {any} json null where the body is none
 */

/**
 * Send a request; resolves also for errors of the server. Rejects with an AbortError when `signal` is aborted.
 * @param {string} method
 * @param {string} address
 * @param {object} more
 * @param {Record<string, string>} more.headers
 * @param {Blob | null} [more.body]
 * @param {(sent: number) => void} [more.onSent] called with the bytes of the body that were sent
 * @param {AbortSignal} more.signal
 * @returns {Promise<Answer>}
 */
export function transfer(method, address, { headers, body = null, onSent = () => {}, signal }) {
  return new Promise((resolve, reject) => {
    const request = new XMLHttpRequest();
    const abort = () => request.abort();
    request.open(method, at(address));
    for (const [name, value] of Object.entries(headers)) request.setRequestHeader(name, value);
    request.upload.addEventListener("progress", (event) => onSent(event.loaded));
    request.addEventListener("loadend", () => {
      signal.removeEventListener("abort", abort);
      if (signal.aborted) reject(new DOMException("The upload was paused.", "AbortError"));
      else resolve({ status: request.status, header: (name) => request.getResponseHeader(name), json: parsed(request.responseText) });
    });
    if (signal.aborted) return reject(new DOMException("The upload was paused.", "AbortError"));
    signal.addEventListener("abort", abort);
    request.send(body);
  });
}

/**
 * The problem of an answer that is an error. Among its facts, `retry_after` has the seconds that the server asks to wait.
 * @param {Answer} answer
 * @returns {Problem}
 */
export function problemOfAnswer(answer) {
  const wait = Number(answer.header("Retry-After")) || 0;
  if (typeof answer.json?.code === "string") {
    return new Problem({ ...answer.json, status: answer.status, facts: { ...answer.json.facts, retry_after: wait } });
  }
  if (answer.status === 0) {
    return new Problem({
      code: "unreachable", status: 0, title: "The server cannot be reached", detail: "The connection to the server was lost.",
      advice: "Check that it still runs and that this device is connected.",
    });
  }
  return new Problem({
    code: "http_error", status: answer.status, title: "", detail: `The server answered with status ${answer.status}.`,
    facts: { retry_after: wait },
  });
}

/** @param {string} text */
function parsed(text) {
  try {
    return JSON.parse(text);
  } catch {
    return null;
  }
}
