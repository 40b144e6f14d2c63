// Which of the given files are photos, masks, poses, videos or archives, and the names they get in the capture. The rules
// are those of the command line (client/splatmill/local_capture.py); a test compares the two.

/** @typedef {"images" | "masks" | "poses"} Role */

/**
 * What a server accepts, as `/v1/info` tells it.
 * @typedef {object} Accepted
 * @property {string[]} photos suffixes with their dot, in lower case
 * @property {string[]} videos
 * @property {string[]} archives
 * @property {string[]} masks
 * @property {string[]} mask_folders
 * @property {number} min_photo_side pixels
 */

/**
 * @typedef {object} Sorted
 * @property {{role: Role, name: string, path: string}[]} files
 * @property {string[]} ignored paths
 */

const MODEL_SUFFIXES = [".bin", ".txt"];
const MODEL_STEMS = ["cameras", "images", "points3D", "rigs", "frames"];
const MODEL_FOLDERS = ["sparse/0/", "sparse/", "colmap/sparse/0/", "colmap/sparse/", ""];

/** Folders that say what lies in them, so their name is kept where everything lies in one folder. */
const TELLING = ["images", "masks", "mask", "sparse", "colmap"];

/** The suffix of a path in lower case, with its dot. @param {string} path */
export function suffix(path) {
  const base = path.slice(path.lastIndexOf("/") + 1);
  const dot = base.lastIndexOf(".");
  return dot > 0 ? base.slice(dot).toLowerCase() : "";
}

/**
 * Sort paths, relative to the folder that was given, into the files of a capture and those that are ignored.
 * @param {Iterable<string>} paths
 * @param {Accepted} accepted
 * @returns {Sorted}
 */
export function sort(paths, accepted) {
  const seen = [...paths].filter((path) => !isHidden(path)).sort(byCodePoint);
  const isPhoto = (/** @type {string} */ path) => accepted.photos.includes(suffix(path));
  const isWhole = (/** @type {string} */ path) => [...accepted.videos, ...accepted.archives].includes(suffix(path));
  const photoRoot = seen.some((path) => path.startsWith("images/") && isPhoto(path)) ? "images/" : "";
  const maskRoot = accepted.mask_folders.map((folder) => `${folder}/`).find((root) => seen.some((path) => path.startsWith(root)));
  const poses = posesIn(seen);
  /** @type {Sorted} */
  const found = { files: [], ignored: [] };
  for (const path of seen) {
    const pose = poses.get(path);
    if (pose !== undefined) found.files.push({ role: "poses", name: pose, path });
    else if (maskRoot && path.startsWith(maskRoot)) {
      if (isPhoto(path)) found.files.push({ role: "masks", name: path.slice(maskRoot.length), path });
    } else if (path.startsWith(photoRoot) && isPhoto(path)) {
      found.files.push({ role: "images", name: path.slice(photoRoot.length), path });
    } else found.ignored.push(path);
  }
  if (!found.files.some((file) => file.role === "images")) {
    found.files.push(...found.ignored.filter(isWhole).map((path) => /** @type {const} */ ({ role: "images", name: path, path })));
    found.ignored = found.ignored.filter((path) => !isWhole(path));
  }
  for (const file of found.files) file.name = file.name.normalize("NFC");
  return found;
}

/**
 * Return paths without the one folder that all of them lie in, as if that folder had been given.
 * @param {string[]} paths
 * @returns {string[]}
 */
export function withoutTop(paths) {
  const top = paths[0]?.split("/")[0];
  const common = paths.length > 0 && paths.every((path) => path.startsWith(`${top}/`));
  return common && !TELLING.includes(top) ? withoutTop(paths.map((path) => path.slice(top.length + 1))) : paths;
}

/** @param {string} path */
function isHidden(path) {
  const parts = path.split("/");
  return parts.some((part) => part.startsWith(".")) || parts.slice(0, -1).some((part) => part.startsWith("__MACOSX"));
}

/** The name in the capture of each path that is a pose file. @param {string[]} paths */
function posesIn(paths) {
  /** @type {Map<string, string>} */
  const found = new Map();
  for (const path of paths) {
    if (!path.includes("/") && path.startsWith("transforms") && path.endsWith(".json")) found.set(path, path);
  }
  for (const folder of MODEL_FOLDERS) {
    const inside = paths.filter((path) => path.startsWith(folder) && !path.slice(folder.length).includes("/"));
    if (!inside.some((path) => ["cameras.bin", "cameras.txt"].includes(path.slice(folder.length)))) continue;
    for (const path of inside) {
      const base = path.slice(folder.length);
      const ending = suffix(path);
      const stem = base.slice(0, base.length - ending.length);
      if (MODEL_STEMS.includes(stem) && MODEL_SUFFIXES.includes(ending)) found.set(path, `sparse/0/${base}`);
    }
    break;
  }
  return found;
}

/** The order of Python's strings. @param {string} one @param {string} other */
function byCodePoint(one, other) {
  const [left, right] = [[...one], [...other]];
  for (let i = 0; i < Math.min(left.length, right.length); i++) {
    const difference = /** @type {number} */ (left[i].codePointAt(0)) - /** @type {number} */ (right[i].codePointAt(0));
    if (difference) return difference;
  }
  return left.length - right.length;
}
