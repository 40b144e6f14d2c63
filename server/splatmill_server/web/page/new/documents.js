// The files that transforms*.json name: photos, masks and points. The rules are those of the command line
// (client/splatmill/transfer/local_capture.py); a test compares the two.

/** @typedef {Map<string, Record<string, unknown>>} Documents transforms files by their paths */

/**
 * Read the transforms files among some files. One that cannot be read is left out: the worker says what is wrong with it.
 * @param {import("./given.js").Given[]} given
 * @returns {Promise<Documents>}
 */
export async function documentsIn(given) {
  /** @type {Documents} */
  const documents = new Map();
  for (const { path, file } of given) {
    if (!/(^|\/)transforms[^/]*\.json$/i.test(path)) continue;
    try {
      const document = JSON.parse(decoded(new Uint8Array(await file.arrayBuffer())));
      if (document !== null && typeof document === "object" && !Array.isArray(document)) documents.set(path, document);
    } catch {
      continue;
    }
  }
  return documents;
}

/**
 * The text of a JSON file in UTF-8, UTF-16 or UTF-32: by its byte-order mark, or else by the zeros around its first letters.
 * @param {Uint8Array} bytes
 */
function decoded(bytes) {
  const begin = [...bytes.subarray(0, 4)].map((byte) => (byte ? "x" : "0")).join("");
  const mark = bytes[0] === 0xff && bytes[1] === 0xfe ? "le" : bytes[0] === 0xfe && bytes[1] === 0xff ? "be" : "";
  if (begin.startsWith("00") || begin === "x000" || (mark === "le" && begin === "xx00")) return wide(bytes, !begin.startsWith("00"));
  const little = mark === "le" || (!mark && /^x0/.test(begin));
  const big = mark === "be" || (!mark && /^0x/.test(begin));
  return new TextDecoder(little ? "utf-16le" : big ? "utf-16be" : "utf-8").decode(bytes);
}

/** The text of UTF-32, which TextDecoder does not read. @param {Uint8Array} bytes @param {boolean} little */
function wide(bytes, little) {
  const view = new DataView(bytes.buffer, bytes.byteOffset);
  const points = Array.from({ length: bytes.length >> 2 }, (_, index) => view.getUint32(4 * index, little));
  return points.map((point) => (point === 0xfeff ? "" : point > 0x10ffff ? "\ufffd" : String.fromCodePoint(point))).join("");
}

/**
 * The paths that a name in a file of cameras may stand for: with the slashes of this system, and percent-decoded.
 * @param {string} name
 */
function readings(name) {
  const plain = name.replaceAll("\\", "/").replace(/^\.\//, "");
  try {
    return [plain, decodeURIComponent(plain)];
  } catch {
    return [plain];
  }
}

/**
 * The paths that transforms files or their frames name under a key.
 * @param {Iterable<Record<string, unknown>>} documents
 * @param {"file_path" | "mask_path" | "depth_file_path" | "depth_path" | "ply_file_path"} key
 * @param {string} top
 */
export function named(documents, key, top) {
  const entries = [...documents].flatMap((document) => [document, ...(Array.isArray(document.frames) ? document.frames : [])]);
  const names = entries.map((entry) => (entry !== null && typeof entry === "object" ? entry[key] : null)).filter((name) => typeof name === "string");
  return new Set(names.flatMap((name) => readings(name).map((path) => top + path)));
}

/**
 * Whether cameras name photos outside the folder `images`, other than these in another size (`images_4`).
 * @param {string[]} names
 * @param {string} photoRoot
 */
export function hasPhotosBeside(names, photoRoot) {
  const reduced = `${photoRoot.replace(/\/$/, "")}_`;
  return names.some((name) => !name.startsWith(photoRoot) && !(name.startsWith(reduced) && /^\d+$/.test(name.slice(reduced.length).split("/")[0])));
}
