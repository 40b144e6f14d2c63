// A few workers that look at files one after the other, so that the page itself never stands still.

/** @typedef {import("./look.js").Looked} Looked */

const WORKERS = Math.max(1, Math.min(4, (navigator.hardwareConcurrency || 2) - 1));

/** Formats that every browser with these workers decodes. A file of them that does not decode is damaged. */
const SHOWN = [".jpg", ".jpeg", ".jpe", ".jfif", ".png", ".webp", ".avif"];

export class Looking {
  /** @param {(looked: Looked) => void} onLooked */
  constructor(onLooked) {
    this.onLooked = onLooked;
    /** @type {{id: number, file: File, kind: string, ending: string}[]} */
    this.queue = [];
    /** @type {Worker[]} */
    this.idle = [];
    this.started = 0;
    this.library = library();
  }

  /**
   * Look at a file once a worker is free.
   * @param {number} id
   * @param {File} file
   * @param {string} kind of the item: a photo or mask is decoded; of others only the digest is taken
   * @param {string} ending suffix of its name
   */
  add(id, file, kind, ending) {
    this.queue.push({ id, file, kind, ending });
    if (!this.idle.length && this.started < WORKERS) this.start();
    this.next();
  }

  start() {
    this.started++;
    const worker = new Worker(new URL("./look.js", import.meta.url), { type: "module" });
    worker.addEventListener("message", ({ data }) => {
      this.onLooked(data);
      this.idle.push(worker);
      this.next();
    });
    this.idle.push(worker);
  }

  next() {
    const worker = this.queue.length ? this.idle.pop() : undefined;
    const file = worker && this.queue.shift();
    if (!worker || !file) return;
    const { id, kind, ending } = file;
    worker.postMessage({ id, file: file.file, kind, shown: SHOWN.includes(ending), library: this.library });
  }
}

/** The address of the module with `sha256`, or "" on a server without its JavaScript packages. */
function library() {
  try {
    return import.meta.resolve("@noble/hashes/sha2.js");
  } catch {
    return "";
  }
}
