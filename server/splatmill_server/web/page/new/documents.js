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
      const document = JSON.parse(await file.text());
      if (document !== null && typeof document === "object" && !Array.isArray(document)) documents.set(path, document);
    } catch {
      continue;
    }
  }
  return documents;
}

/**
 * The paths that transforms files or their frames name under a key.
 * @param {Iterable<Record<string, unknown>>} documents
 * @param {"file_path" | "mask_path" | "ply_file_path"} key
 * @param {string} top
 */
export function named(documents, key, top) {
  const entries = [...documents].flatMap((document) => [document, ...(Array.isArray(document.frames) ? document.frames : [])]);
  const names = entries.map((entry) => (entry !== null && typeof entry === "object" ? entry[key] : null)).filter((name) => typeof name === "string");
  return new Set(names.map((name) => top + name.replaceAll("\\", "/").replace(/^\.\//, "")));
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
