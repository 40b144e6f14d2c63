// The REST API: requests whose errors are the server's problem documents, pages of lists, and the events of a job.

import { at, pathOfPage } from "./address.js";

/**
 * @typedef {object} ProblemDocument
 * @property {string} code
 * @property {number} status
 * @property {string} title
 * @property {string} detail
 * @property {string} [advice]
 * @property {Record<string, any>} [facts]
 */

/** An answer that is an error. `message` is its detail; `advice` says what to do. */
export class Problem extends Error {
  /** @param {ProblemDocument} document */
  constructor(document) {
    super(document.detail || document.title);
    this.name = "Problem";
    this.document = document;
    this.code = document.code;
    this.status = document.status;
    this.advice = document.advice ?? "";
    this.facts = document.facts ?? {};
  }
}

/** @typedef {Record<string, string | number | boolean | string[] | null | undefined>} Query */

/**
 * Send a request and return the response. Throws Problem for an error, also where the server cannot be reached.
 *
 * A request without a session, on a server that has keys, leads to the sign-in page, which leads back.
 * @param {string} method
 * @param {string} path address on this server
 * @param {object} [more]
 * @param {Query} [more.query] null, undefined and "" are left out; a list repeats its parameter
 * @param {any} [more.json] body to send as JSON
 * @param {BodyInit} [more.body] body to send as it is
 * @param {Record<string, string>} [more.headers]
 * @param {AbortSignal} [more.signal]
 * @param {boolean} [more.stay] throw the problem of a missing session in place of leading to the sign-in page
 */
export async function request(method, path, { query = {}, json, body, headers = {}, signal, stay = false } = {}) {
  const address = new URL(at(path), location.origin);
  for (const [name, value] of Object.entries(query)) {
    for (const one of Array.isArray(value) ? value : [value]) {
      if (one !== null && one !== undefined && one !== "") address.searchParams.append(name, String(one));
    }
  }
  /** @type {Response} */
  let response;
  try {
    response = await fetch(address, {
      method,
      headers: { Accept: "application/json", ...(json === undefined ? {} : { "Content-Type": "application/json" }), ...headers },
      body: json === undefined ? body : JSON.stringify(json),
      signal,
      credentials: "same-origin",
    });
  } catch (error) {
    if (signal?.aborted) throw error;
    throw unreachable("The server did not answer.");
  }
  if (response.ok || response.status === 304) return response;
  const problem = await problemOf(response);
  if (problem.status === 401 && !stay) {
    signIn();
    await new Promise(() => {}); // the page is being left
  }
  throw UNKNOWN.includes(problem.code) && (await isOutdated()) ? new Problem({ ...problem.document, ...OUTDATED }) : problem;
}

/** What a server answers to requests that it does not know. */
const UNKNOWN = ["not_found", "method_not_allowed", "invalid_request", "http_error"];

/** In place of what fails then. */
export const OUTDATED = { code: "page_outdated", detail: "This page is of another version than its server.", advice: "Reload the page." };

/** Whether the server has another version of this page by now. */
export async function isOutdated() {
  const version = (/** @type {string} */ text) => /\/page\/(\w+)\//.exec(text)?.[1];
  const own = version(/** @type {HTMLScriptElement} */ (document.querySelector("script[type=module]")).src);
  const now = await fetch(location.href, { credentials: "same-origin" }).then((answer) => answer.text()).then(version, () => own);
  return now !== undefined && now !== own;
}

/** @param {string} detail */
function unreachable(detail) {
  return new Problem({
    code: "unreachable", status: 0, title: "The server cannot be reached", detail,
    advice: "Check that it still runs and that this device is connected, then try again.",
  });
}

/**
 * Return the body of a response, as in `whole(response.json())`. Throws Problem where the connection ends before it does.
 * @template T
 * @param {Promise<T>} body
 * @returns {Promise<T>}
 */
export async function whole(body) {
  try {
    return await body;
  } catch (error) {
    throw error instanceof TypeError ? unreachable("The connection ended within the answer.") : error;
  }
}

/** Return the problem that a response carries. @param {Response} response */
export async function problemOf(response) {
  const type = response.headers.get("Content-Type") ?? "";
  if (type.includes("json")) {
    const document = await response.json().catch(() => null);
    if (document && typeof document.code === "string") return new Problem({ ...document, status: response.status });
  }
  return new Problem({
    code: "http_error", status: response.status, title: response.statusText,
    detail: `The server answered with status ${response.status}${response.statusText ? ` (${response.statusText})` : ""}.`,
    advice: response.status >= 502 ? "A proxy before the server answered in its place. Try again in a few seconds." : "",
  });
}

/** Lead to the sign-in page, which leads back here. */
export function signIn() {
  if (pathOfPage() === "/sign-in") return;
  location.replace(`${at("/sign-in")}?next=${encodeURIComponent(location.pathname + location.search)}`);
}

/**
 * Return the JSON of an address.
 * @param {string} path
 * @param {Query} [query]
 * @param {AbortSignal} [signal]
 * @returns {Promise<any>}
 */
export async function get(path, query, signal) {
  return whole((await request("GET", path, { query, signal })).json());
}

/**
 * Send JSON and return the JSON of the answer, or null where the answer has none.
 * @param {"POST" | "PUT" | "PATCH" | "DELETE"} method
 * @param {string} path
 * @param {any} [json]
 * @returns {Promise<any>}
 */
export async function send(method, path, json) {
  const response = await request(method, path, { json });
  return response.status === 204 ? null : whole(response.json());
}

/**
 * Yield the records of a list, page after page, as far as they are asked for.
 * @param {"captures" | "jobs" | "models"} noun
 * @param {Query} [query]
 * @returns {AsyncGenerator<any>}
 */
export async function* each(noun, query = {}) {
  let cursor = null;
  do {
    /** @type {any} */
    const page = await get(`/v1/${noun}`, { ...query, cursor });
    yield* page[noun];
    cursor = page.cursor;
  } while (cursor);
}

/**
 * The addresses of a model below this one are `/files/NAME`, `/cameras` and `/render`. A shared model has the same ones
 * below another address, so what shows a model takes the address and not the id.
 * @param {string} id
 */
export function modelAddress(id) {
  return at(`/v1/models/${encodeURIComponent(id)}`);
}

/** The id at the end of this page's address, as in /jobs/ID. */
export function idOfPage() {
  return decodeURIComponent(pathOfPage().split("/")[2] ?? "");
}

/** Milliseconds before a stream that the browser has given up is opened anew. */
const REOPEN_MS = 3000;

/**
 * Follow the events of a job until it ends or `close` is called; the browser reconnects by itself and continues where it was.
 *
 * Where the server answered with an error, which browsers take for the end, a new stream begins at the first event.
 * @param {string} jobId
 * @param {(record: any) => void} onRecord receives `{id, attempt, at, event: {type, ...}}`
 * @param {(open: boolean) => void} [onConnection] whether the stream is connected
 * @param {() => void} [onAnew] called before the first event comes once more
 * @returns {{close: () => void}}
 */
export function follow(jobId, onRecord, onConnection = () => {}, onAnew = () => {}) {
  const types = ["state", "progress", "metric", "plan", "preview", "log", "cameras", "snapshot", "unit"];
  /** @type {EventSource} */
  let source;
  /** @type {ReturnType<typeof setTimeout> | undefined} */
  let timer;
  const open = () => {
    source = new EventSource(at(`/v1/jobs/${encodeURIComponent(jobId)}/events`));
    for (const type of types) {
      source.addEventListener(type, (message) => onRecord(JSON.parse(/** @type {MessageEvent} */ (message).data)));
    }
    source.addEventListener("open", () => onConnection(true));
    source.addEventListener("error", () => {
      onConnection(false);
      if (source.readyState !== EventSource.CLOSED) return;
      timer = setTimeout(() => {
        onAnew();
        open();
      }, REOPEN_MS);
    });
  };
  open();
  return {
    close: () => {
      clearTimeout(timer);
      source.close();
    },
  };
}
