/**
 * A .lod.zip read piece by piece: levels of detail of a model, each chunk of which is a range of the file's bytes.
 *
 * The list of its files and the index are at its end (splat/formats/streamed_zip.py writes it so).
 */
import { ViewerError } from "./errors.js";

/** @import {Source} from "./source.js" */

/** Name of the index in the archive. */
export const INDEX = "lod-meta.json";

/** Bytes of the end that are read first, which hold the list and the index of a million Gaussians. */
const TAIL = 1 << 16;

/** Milliseconds after which a part that did not come is asked for again; after the last one it is given up. */
const PAUSES = [1000, 4000, 16000];
/** Milliseconds without an answer, and then without a further byte, after which a part is taken for one that does not come. */
const UNANSWERED = 60_000;
const STALLED = 20_000;
/** Milliseconds that a server may ask for before the next attempt; what asks for more is given up. */
const LONGEST_PAUSE = 90_000;
/** Statuses after which asking again may help, besides those over 499. */
const PASSING = [408, 425, 429];

/** Signs of a zip: the end, an entry of the list, and the bytes that both have without names. */
const END = 0x06054b50;
const ENTRY = 0x02014b50;
const END_BYTES = 22;
const ENTRY_BYTES = 46;
/** Depth of a tree at most, which PlayCanvas walks by calls in calls. */
const DEEPEST = 200;
/** Bytes before the name of a file where it is stored. */
const HEAD_BYTES = 30;

/**
 * @typedef {object} Entry  a file of the archive
 * @property {string} name
 * @property {Uint8Array} record  its entry of the list
 * @property {number} begin  where it begins, its head included
 * @property {number} end  where the next one does, or the list
 * @property {number} size  bytes as it is stored
 * @property {boolean} deflated
 */

export class Pieces {
  /**
   * Read the list and the index.
   * @param {Source} source
   * @returns {Promise<Pieces>}
   * @throws {ViewerError}  where it cannot be had, or is no such archive
   */
  static async open({ url, bytes }) {
    const pieces = new Pieces(bytes ? new Blob([/** @type {BlobPart} */ (bytes)]) : (url ?? ""));
    await pieces.readList();
    return pieces;
  }

  /** @param {Blob | string} file  its address, or itself */
  constructor(file) {
    this.file = file;
    this.etag = "";
    this.size = 0;
    /** Bytes that were read so far. */
    this.loaded = 0;
    /** Ends all that is loaded. */
    this.ending = new AbortController();
    /** When the server may be asked again, in milliseconds of `performance.now()`. */
    this.notBefore = 0;
    /** By folder, the files in it. @type {Map<string, Entry[]>} */
    this.folders = new Map();
    /** The folders of the coarsest level, which the first picture is drawn from. @type {Set<string>} */
    this.coarsest = new Set();
    /** The folder of the surroundings; empty where there are none. */
    this.surroundings = "";
  }

  async readList() {
    const tail = await this.last(TAIL);
    const start = this.size - tail.length;
    const end = viewOf(tail);
    const at = tail.length - END_BYTES;
    if (at < 0 || end.getUint32(at, true) !== END) throw damaged("it does not end as a .zip without a comment does");
    const [count, length, begin] = [end.getUint16(at + 10, true), end.getUint32(at + 12, true), end.getUint32(at + 16, true)];
    if (begin + length > start + at) throw damaged("its list of files is not where its end says");
    const list = begin >= start ? tail.subarray(begin - start, begin - start + length) : await this.read(begin, begin + length);
    const entries = entriesOf(list, count).sort((a, b) => a.begin - b.begin);
    const indices = entries.filter(({ name }) => name === INDEX || name.endsWith(`/${INDEX}`));
    const index = indices.sort((a, b) => a.name.split("/").length - b.name.split("/").length)[0];
    if (!index) throw damaged(`it holds no ${INDEX}`);
    const outer = folderOf(index.name); // of an archive that somebody has packed again
    for (const [i, entry] of entries.entries()) {
      entry.end = entries[i + 1]?.begin ?? begin;
      if (!entry.name.startsWith(outer)) continue;
      const folder = folderOf(entry.name).slice(outer.length);
      this.folders.set(folder, [...(this.folders.get(folder) ?? []), entry]);
    }
    const stored = index.begin >= start ? tail.subarray(index.begin - start, index.end - start) : await this.read(index.begin, index.end);
    /** The index, as bytes of JSON. */
    this.index = await contentsOf(stored, index);
    [this.coarsest, this.surroundings] = foldersOf(this.index);
  }

  /**
   * The files of a chunk as a .sog.
   * @param {string} folder  that its meta.json is in, with a slash at its end
   * @returns {Promise<Uint8Array>}
   */
  async chunk(folder) {
    const entries = this.folders.get(folder) ?? [];
    if (!entries.length) throw damaged(`it holds no files in ${folder}`);
    const begin = entries[0].begin;
    const files = await this.read(begin, entries[entries.length - 1].end);
    const list = entries.map(({ record, begin: at, name }) => {
      const short = new TextEncoder().encode(name.slice(name.lastIndexOf("/") + 1));
      const entry = new Uint8Array(ENTRY_BYTES + short.length);
      entry.set(record.subarray(0, ENTRY_BYTES));
      entry.set(short, ENTRY_BYTES);
      const view = viewOf(entry);
      view.setUint16(28, short.length, true);
      view.setUint32(30, 0, true); // nothing added, and no comment
      view.setUint32(42, at - begin, true);
      return entry;
    });
    const length = list.reduce((sum, entry) => sum + entry.length, 0);
    const end = new DataView(new ArrayBuffer(END_BYTES));
    end.setUint32(0, END, true);
    end.setUint16(8, list.length, true);
    end.setUint16(10, list.length, true);
    end.setUint32(12, length, true);
    end.setUint32(16, files.length, true);
    return joined([files, ...list, new Uint8Array(end.buffer)]);
  }

  /** The last bytes, at most `count`. @param {number} count */
  async last(count) {
    if (this.file instanceof Blob) {
      this.size = this.file.size;
      return this.read(Math.max(0, this.size - count), this.size);
    }
    return this.fetched(`bytes=-${count}`);
  }

  /** The bytes from `begin` to before `end`. @param {number} begin @param {number} end */
  async read(begin, end) {
    if (!(this.file instanceof Blob)) return this.fetched(`bytes=${begin}-${end - 1}`);
    const bytes = new Uint8Array(await this.file.slice(begin, end).arrayBuffer());
    this.loaded += bytes.length;
    return bytes;
  }

  /** @param {string} range @returns {Promise<Uint8Array>} */
  async fetched(range) {
    for (const pause of PAUSES) {
      try {
        return await this.fetchedOnce(range);
      } catch (error) {
        if (error instanceof ViewerError && error.reason === "refused") throw error;
        const asked = error instanceof Passing ? error.after : 0;
        if (asked > LONGEST_PAUSE) throw error;
        this.notBefore = Math.max(this.notBefore, performance.now() + asked);
        await this.wait(pause);
      }
    }
    return this.fetchedOnce(range);
  }

  /** Wait, but no longer than something is loaded. @param {number} pause  milliseconds */
  async wait(pause) {
    await new Promise((resolve) => {
      const timer = setTimeout(resolve, pause);
      this.ending.signal.addEventListener("abort", () => resolve(clearTimeout(timer)), { once: true });
    });
  }

  /** @param {string} range @returns {Promise<Uint8Array>} */
  async fetchedOnce(range) {
    const failed = (/** @type {string} */ why) => new ViewerError("refused", sentence(why));
    const left = this.notBefore - performance.now();
    if (left > 0) await this.wait(left);
    if (this.ending.signal.aborted) throw failed("the view was closed");
    const patience = new Patience(this.ending.signal);
    try {
      // Without If-Range, with which browsers keep nothing of what they load.
      const answer = await fetch(/** @type {string} */ (this.file), { headers: { Range: range }, signal: patience.signal });
      if (!answer.ok) throw refusal(answer);
      const etag = (answer.headers.get("ETag") ?? "").replace(/^W\//, "");
      this.etag ||= etag;
      if (etag !== this.etag) throw failed("it was changed meanwhile. Reload the page");
      if (answer.status !== 206) throw failed("the server, or a proxy before it, sends no parts of files");
      this.size = Number(/\/(\d+)$/.exec(answer.headers.get("Content-Range") ?? "")?.[1]);
      const bytes = await patience.bytesOf(answer);
      this.loaded += bytes.length;
      return bytes;
    } catch (error) {
      if (this.ending.signal.aborted) throw failed("the view was closed");
      if (error instanceof ViewerError) throw error;
      throw new Passing(patience.over ? "the server sent nothing more" : "the server could not be reached", 0, error);
    } finally {
      patience.end();
    }
  }

  /** Load nothing any more. */
  end() {
    this.ending.abort();
  }
}

/** Why a part did not come where asking again may help. */
class Passing extends ViewerError {
  /** @param {string} why @param {number} after  milliseconds for which the server asks to wait @param {unknown} [cause] */
  constructor(why, after, cause) {
    super("unreadable", sentence(why), { cause });
    this.after = after;
  }
}

/** Ends a request that nothing comes of. */
class Patience {
  /** @param {AbortSignal} ending  ends it as well */
  constructor(ending) {
    this.request = new AbortController();
    this.signal = this.request.signal;
    this.ending = ending;
    this.stop = () => this.request.abort();
    ending.addEventListener("abort", this.stop);
    /** Whether nothing came for too long. */
    this.over = false;
    this.timer = 0;
    this.expect(UNANSWERED);
  }

  /** @param {number} within  milliseconds */
  expect(within) {
    clearTimeout(this.timer);
    this.timer = setTimeout(() => {
      this.over = true;
      this.request.abort();
    }, within);
  }

  /** End the request, if its bytes were not read to their end. */
  end() {
    clearTimeout(this.timer);
    this.ending.removeEventListener("abort", this.stop);
    this.request.abort();
  }

  /** @param {Response} answer */
  async bytesOf(answer) {
    const reader = /** @type {ReadableStream<Uint8Array>} */ (answer.body).getReader();
    const parts = [];
    this.expect(STALLED);
    for (let part = await reader.read(); !part.done; part = await reader.read()) {
      this.expect(STALLED);
      parts.push(part.value);
    }
    return joined(parts);
  }
}

/** @param {string} why */
function sentence(why) {
  return `The model could not be loaded in parts: ${why}.`;
}

/** What an answer that is no success means for further attempts. @param {Response} answer */
function refusal(answer) {
  const why = `the server answered ${answer.status}`;
  if (answer.status < 500 && !PASSING.includes(answer.status)) return new ViewerError("refused", sentence(why));
  return new Passing(why, 1000 * Number(answer.headers.get("Retry-After") ?? 0) || 0);
}

/** @param {string} why */
function damaged(why) {
  return new ViewerError("unreadable", `The model could not be read as levels of detail: ${why}.`);
}

/** @param {Uint8Array} bytes */
function viewOf(bytes) {
  return new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
}

/** @param {Uint8Array} list @param {number} count @returns {Entry[]} */
function entriesOf(list, count) {
  const view = viewOf(list);
  const entries = [];
  for (let at = 0; entries.length < count; ) {
    if (at + ENTRY_BYTES > list.length || view.getUint32(at, true) !== ENTRY) throw damaged("its list of files is damaged");
    const [named, added, comment] = [28, 30, 32].map((place) => view.getUint16(at + place, true));
    const record = list.subarray(at, at + ENTRY_BYTES + named);
    const method = view.getUint16(at + 10, true);
    if (method !== 0 && method !== 8) throw damaged("its files are compressed in a way that browsers do not read");
    entries.push({
      name: new TextDecoder().decode(record.subarray(ENTRY_BYTES)),
      record,
      begin: view.getUint32(at + 42, true),
      end: 0,
      size: view.getUint32(at + 20, true),
      deflated: method === 8,
    });
    at += ENTRY_BYTES + named + added + comment;
  }
  return entries;
}

/** The contents of a file. @param {Uint8Array} stored  it and its head @param {Entry} entry */
async function contentsOf(stored, { size, deflated }) {
  const view = viewOf(stored);
  const begin = HEAD_BYTES + view.getUint16(26, true) + view.getUint16(28, true);
  const bytes = stored.subarray(begin, begin + size);
  if (!deflated) return bytes;
  const whole = new Blob([/** @type {BlobPart} */ (bytes)]).stream().pipeThrough(new DecompressionStream("deflate-raw"));
  return new Uint8Array(await new Response(whole).arrayBuffer());
}

/**
 * The folders of the coarsest level, and that of the surroundings. Fails for an index that PlayCanvas would not survive.
 * @param {Uint8Array} bytes  the index
 * @returns {[Set<string>, string]}
 */
function foldersOf(bytes) {
  let index;
  try {
    index = JSON.parse(new TextDecoder().decode(bytes));
  } catch {
    throw damaged(`its ${INDEX} is no JSON`);
  }
  const whole = (/** @type {any} */ number, /** @type {number} */ most) => Number.isInteger(number) && number >= 0 && number < most;
  const corner = (/** @type {any} */ place) => Array.isArray(place) && place.length === 3 && place.every(Number.isFinite);
  const { version, filenames, lodLevels, environment, tree } = index ?? {};
  const named = Array.isArray(filenames) && [...filenames, environment ?? ""].every((name) => typeof name === "string");
  if (version !== 1 || !named || !whole(lodLevels, 100)) throw damaged(`its ${INDEX} is not of version 1`);
  const folders = new Set();
  const nodes = [{ node: tree, depth: 0 }];
  for (const { node, depth } of nodes) {
    const levels = Object.keys(node?.lods ?? {}).map(Number);
    /** @type {any[]} */
    const places = Object.values(node?.lods ?? {});
    const fits = corner(node?.bound?.min) && corner(node.bound.max) && (node.lods ? !node.children : Array.isArray(node.children))
      && places.every((place) => whole(place?.file, filenames.length) && whole(place.offset, 2 ** 31) && whole(place.count, 2 ** 31))
      && levels.every((level) => whole(level, lodLevels)) && depth < DEEPEST;
    if (!fits) throw damaged(`the tree in its ${INDEX} is damaged`);
    for (const child of node.children ?? []) nodes.push({ node: child, depth: depth + 1 });
    const coarsest = Math.max(...levels.filter((level) => node.lods[level].count > 0));
    if (coarsest >= 0) folders.add(folderOf(filenames[node.lods[coarsest].file]));
  }
  return [folders, folderOf(environment ?? "")];
}

/** The folder that a path leads to, with a slash at its end. @param {string} path */
function folderOf(path) {
  return path.slice(0, path.lastIndexOf("/") + 1);
}

/** @param {Uint8Array[]} parts */
function joined(parts) {
  const whole = new Uint8Array(parts.reduce((sum, part) => sum + part.length, 0));
  let at = 0;
  for (const part of parts) {
    whole.set(part, at);
    at += part.length;
  }
  return whole;
}
