// Which of the given files are photos, masks, poses, videos or archives, and the names they get in the capture. The rules
// are those of the command line (client/splatmill/transfer/local_capture.py and data_sets.py); a test compares the two.

import { hasPhotosBeside, named } from "./documents.js";

/** @typedef {"images" | "masks" | "poses"} Role */

/**
 * What a server accepts, from `/v1/info`.
 * @typedef {object} Accepted
 * @property {string[]} photos suffixes with their dot, in lower case
 * @property {string[]} videos
 * @property {string[]} archives
 * @property {string[]} masks
 * @property {string[]} mask_folders in lower case
 * @property {string[]} mask_endings
 * @property {string[]} mask_beginnings
 * @property {Record<string, string[]>} other_folders names in lower case of folders without photos, by what they hold
 * @property {string[]} unused_folders those of them that are not used beside photos
 * @property {string[]} depth_folders those of them with depths of the photos, which go along as poses
 * @property {string[]} output_marks
 * @property {string[]} output_media
 * @property {{what: string, suffixes: string[], advice: string}[]} unread
 * @property {string[]} program_files patterns of names, in lower case, of files that may have cameras of other programs
 * @property {string[]} camera_lists patterns of the names of lists that belong to some of them
 * @property {Record<string, string[]>} other_cameras patterns of names, in lower case, by program
 * @property {string[]} large_cameras those of them whose files are not sent
 * @property {string[]} points suffixes of files of points that a training may start from
 * @property {string} example name of the file of a capture whose photos a worker makes
 * @property {number} min_photos that cameras can be recovered from, at least
 * @property {number} min_photo_side pixels
 */

/**
 * @typedef {object} Sorted
 * @property {{role: Role, name: string, path: string}[]} files
 * @property {string[]} ignored paths
 * @property {string | null} problem why the files cannot be read as one capture
 * @property {Set<string>} named paths of masks that frames of transforms files name
 * @property {Map<string, string>} others paths of pictures that are no photos, with what they are
 * @property {string[]} outputs paths of pictures, videos, zips and cameras that are results of Splatmill
 * @property {string} top folder of the data set, with a slash at its end, where it is not the given one
 * @property {boolean} posed whether there are cameras that may be read
 * @property {{path: string, first: string, posed: boolean}[]} zipped zips with files of cameras that are not used: the first
 *   of these, and whether it is because other cameras are
 * @property {string[]} idle files that may have cameras of other programs, where there are no photos for them
 */

const MODEL_SUFFIXES = [".bin", ".txt"];
const MODEL_STEMS = ["cameras", "images", "points3d", "rigs", "frames"];

/** Folders of a data set in which tools put COLMAP models, with their rank; the longest is tried first. */
const MODEL_PLACES = /** @type {[number, RegExp][]} */ ([
  [1, /(?:^|(?<=\/))colmap\/sparse\/(?:\d+\/)?$/i], [0, /(?:^|(?<=\/))sparse\/(?:\d+\/)?$/i], [2, /(?:^|(?<=\/))\d+\/$/],
]);

/** Folders in which the raw data of Polycam have a .json file for each photo, the preferred one first. */
const KEYFRAMES = ["keyframes/corrected_cameras/", "keyframes/cameras/"];

/** Names, in lower case, of the files that a COLMAP model must have. */
export const MODEL_PARTS = ["cameras.bin", "cameras.txt", "images.bin", "images.txt"];

/** Folders around a data set that are looked into. */
export const MAX_DEPTH = 4;

/** Folders that say what lies in them, so their name is kept where everything lies in one folder. */
const TELLING = [
  "images", "sparse", "colmap", "keyframes", "masks", "mask", "segmentation", "segmentations", "depth", "depths", "depth_maps", "depthmaps", "normals",
  "normal_maps", "normalmaps", "confidence", "confidences", "confidence_maps", "semantic", "semantics", "semantic_maps", "thumbnail", "thumbnails", "thumbs",
];

/** The suffix of a path in lower case, with its dot. @param {string} path */
export function suffix(path) {
  const base = path.slice(path.lastIndexOf("/") + 1);
  const dot = base.lastIndexOf(".");
  return dot > 0 ? base.slice(dot).toLowerCase() : "";
}

/**
 * Whether a file of a capture may hold cameras that are read. One that a training starts from, and depth maps, lie among
 * them, too.
 * @param {{role: string | null, name: string}} file
 * @param {Accepted} accepted
 */
export function holdsCameras(file, accepted) {
  if (file.role !== "poses" || [".ply", ...accepted.points, ...accepted.photos].includes(suffix(file.name))) return false;
  return !Object.values(accepted.other_cameras).flat().some((pattern) => fits(file.name, pattern));
}

/**
 * Sort paths, relative to the folder that was given, into the files of a capture and those that are ignored.
 * @param {Iterable<string>} paths
 * @param {Accepted} accepted
 * @param {import("./documents.js").Documents} documents those of the transforms files that can be read
 * @param {Map<string, string[]>} lists names of the files in each zip, by its path
 * @returns {Sorted}
 */
export function sort(paths, accepted, documents = new Map(), lists = new Map()) {
  const shown = [...paths].filter((path) => !isHidden(path)).sort(byCodePoint);
  const outputs = ownOutputs(shown, accepted);
  const visible = shown.filter((path) => !outputs.has(path));
  const isPhoto = (/** @type {string} */ path) => accepted.photos.includes(suffix(path));
  const isWhole = (/** @type {string} */ path) => [...accepted.videos, ...accepted.archives].includes(suffix(path));
  const cameras = camerasIn(visible);
  // Cameras in a folder without photos are those of the photos around it.
  const top = visible.some((path) => path.startsWith(cameras.top) && isPhoto(path)) ? cameras.top : "";
  const read = [...documents].filter(([path]) => cameras.transforms.includes(path)).map(([, document]) => document);
  const pictures = visible.filter((path) => path.startsWith(top) && isPhoto(path));
  let photoRoot = pictures.some((path) => path.startsWith(`${top}images/`)) ? `${top}images/` : top;
  const photos = named(read, "file_path", cameras.top);
  if (hasPhotosBeside(pictures.filter((path) => photos.has(path)), photoRoot)) photoRoot = top;
  const masks = masksIn(pictures, top, photoRoot, accepted);
  const drawn = named(read, "mask_path", cameras.top);
  for (const path of pictures) {
    if (drawn.has(path) && !masks.has(path)) masks.set(path, path.slice((path.startsWith(photoRoot) ? photoRoot : top).length));
  }
  const poses = namesOf(cameras, visible);
  const points = named(read, "ply_file_path", cameras.top);
  for (const path of visible) if (points.has(path) && suffix(path) === ".ply") poses.set(path, path.slice(cameras.top.length));
  const maps = mapsIn(pictures, visible, read, cameras.top, accepted);
  const taken = pictures.some((path) => !maps.has(path));
  const alone = poses.size === 0;
  const programs = programFiles(visible, accepted);
  const unread = visible.filter((path) => Object.values(accepted.other_cameras).flat().some((pattern) => fits(path, pattern)));
  const small = unread.filter((path) => !accepted.large_cameras.some((pattern) => fits(path, pattern)));
  if (taken) for (const path of [...programs, ...small]) if (!poses.has(path)) poses.set(path, path);
  const zips = taken ? camerasInZips(visible, lists, accepted) : [];
  const along = new Set(alone ? zips.filter(({ posed }) => posed).map(({ path }) => path) : []);
  /** @type {Sorted} */
  const sorted = { files: [], ignored: [], problem: cameras.problem, named: new Set([...drawn].filter((path) => masks.has(path))), others: new Map(), outputs: [], top: cameras.top, zipped: zips.filter(({ path }) => !along.has(path)), posed: !alone || (taken && programs.length > 0), idle: taken ? [] : programs };
  if (alone) {
    const inside = visible.filter((path) => path.startsWith(photoRoot) && isPhoto(path) && !maps.has(path));
    sorted.problem ??= noPhotos(inside, accepted);
    sorted.others = besidePhotos(inside, accepted);
  }
  for (const path of visible) {
    const pose = poses.get(path);
    const mask = masks.get(path);
    if (pose !== undefined) sorted.files.push({ role: "poses", name: pose, path });
    else if (mask !== undefined) sorted.files.push({ role: "masks", name: mask, path });
    else if (maps.has(path)) sorted.files.push({ role: "poses", name: path.slice(path.startsWith(top) ? top.length : 0), path });
    else if (path.startsWith(photoRoot) && isPhoto(path) && !sorted.others.has(path)) {
      sorted.files.push({ role: "images", name: path.slice(photoRoot.length), path });
    } else if (along.has(path)) sorted.files.push({ role: "images", name: path, path });
    else sorted.ignored.push(path);
  }
  if (!sorted.files.some((file) => file.role === "images")) {
    sorted.files.push(...sorted.ignored.filter(isWhole).map((path) => /** @type {const} */ ({ role: "images", name: path, path })));
    sorted.ignored = sorted.ignored.filter((path) => !isWhole(path));
  }
  sorted.outputs.push(...outputs);
  for (const file of sorted.files) file.name = file.name.normalize("NFC");
  return sorted;
}

/**
 * Return paths without the one folder that all of them lie in, as if that folder had been given.
 * @param {string[]} paths
 * @returns {string[]}
 */
export function withoutTop(paths) {
  const top = paths[0]?.split("/")[0];
  const common = paths.length > 0 && paths.every((path) => path.startsWith(`${top}/`));
  return common && !TELLING.includes(top.toLowerCase()) ? withoutTop(paths.map((path) => path.slice(top.length + 1))) : paths;
}

/** @param {string} path */
function isHidden(path) {
  const parts = path.split("/");
  return parts.some((part) => part.startsWith(".")) || parts.slice(0, -1).some((part) => part.startsWith("__MACOSX"));
}

/** What a file is by the folders in its path. @param {string} path @param {Accepted} accepted */
function kindOfFolder(path, accepted) {
  for (const folder of path.toLowerCase().split("/").slice(0, -1)) {
    for (const [what, folders] of Object.entries(accepted.other_folders)) if (folders.includes(folder)) return what;
  }
  return null;
}

/** A sentence where all pictures lie in folders that hold no photos. @param {string[]} paths @param {Accepted} accepted */
function noPhotos(paths, accepted) {
  const kinds = [...new Set(paths.map((path) => kindOfFolder(path, accepted)))].sort();
  if (!paths.length || kinds.includes(null)) return null;
  const which = paths.length > 1 ? `All ${paths.length} pictures lie` : "The only picture lies";
  return `${which} in a folder of ${kinds.join(" or ")} by its name, such as ${paths[0]}. Give the photos; if these are the photos, give their folder another name.`;
}

/** Pictures in folders of maps beside photos, with what they are. @param {string[]} paths @param {Accepted} accepted */
function besidePhotos(paths, accepted) {
  const kinds = paths.map((path) => /** @type {const} */ ([path, kindOfFolder(path, accepted)]));
  if (kinds.every(([, kind]) => kind !== null)) return new Map();
  return new Map(kinds.flatMap(([path, kind]) => (kind !== null && accepted.unused_folders.includes(kind) ? [[path, kind]] : [])));
}

/**
 * The pictures, videos, zips and cameras in folders of results.
 * @param {string[]} paths
 * @param {Accepted} accepted
 */
function ownOutputs(paths, accepted) {
  const split = paths.map((path) => ({ path, folder: path.slice(0, path.lastIndexOf("/") + 1), last: path.slice(path.lastIndexOf("/") + 1) }));
  /** @type {Map<string, number>} */
  const marks = new Map();
  for (const { folder, last } of split) if (accepted.output_marks.includes(last)) marks.set(folder, (marks.get(folder) ?? 0) + 1);
  return new Set(split.filter(({ folder, last }) => accepted.output_media.includes(last) && (marks.get(folder) ?? 0) >= 2).map(({ path }) => path));
}

/**
 * The name in the capture of each picture that is a mask.
 * @param {string[]} pictures all under `top`
 * @param {string} top
 * @param {string} photoRoot
 * @param {Accepted} accepted
 */
function masksIn(pictures, top, photoRoot, accepted) {
  /** @type {Map<string, string>} */
  const masks = new Map();
  for (const path of pictures) {
    const parts = path.slice(top.length).split("/");  // a folder around the data set may be called masks too
    const folder = parts.slice(0, -1).findIndex((part) => accepted.mask_folders.includes(part.toLowerCase()));
    if (folder >= 0) masks.set(path, top + parts.filter((_, index) => index !== folder).join("/"));
  }
  const photos = pictures.filter((path) => path.startsWith(photoRoot) && !masks.has(path));
  if (photos.length === 0) return new Map();
  const whole = new Set(photos.map((path) => path.toLowerCase()));
  const known = new Set([...whole, ...[...whole].map(stem)]);
  for (const path of photos) {
    const own = stem(path.toLowerCase());
    if (whole.has(own) || unmarked(own, accepted).some((name) => known.has(name))) masks.set(path, path);
  }
  for (const [path, name] of masks) masks.set(path, name.slice((name.startsWith(photoRoot) ? photoRoot : top).length));
  return masks;
}

/**
 * The depth maps and maps of confidence beside photos or a video.
 * @param {string[]} pictures
 * @param {string[]} paths
 * @param {Record<string, unknown>[]} read documents of the data set
 * @param {string} top
 * @param {Accepted} accepted
 */
function mapsIn(pictures, paths, read, top, accepted) {
  const drawn = new Set([...named(read, "depth_file_path", top), ...named(read, "depth_path", top)]);
  const photos = named(read, "file_path", top);
  const kind = (/** @type {string} */ path) => kindOfFolder(path.startsWith(top) ? path.slice(top.length) : path, accepted);
  const maps = new Set(pictures.filter((path) => (accepted.depth_folders.includes(kind(path) ?? "") || drawn.has(path)) && !photos.has(path)));
  const others = [...accepted.unused_folders, ...accepted.depth_folders, "masks"];
  const beside = pictures.some((path) => !maps.has(path) && !others.includes(kind(path) ?? ""));
  return beside || paths.some((path) => accepted.videos.includes(suffix(path))) ? maps : new Set();
}

/** A path without its suffix. @param {string} path */
export function stem(path) {
  return path.slice(0, path.length - suffix(path).length);
}

/**
 * The names of the photos that a mask of this name, in lower case and without its suffix, may belong to.
 * @param {string} name
 * @param {Accepted} accepted
 */
export function unmarked(name, accepted) {
  const start = name.lastIndexOf("/") + 1;
  const [folder, last] = [name.slice(0, start), name.slice(start)];
  const names = accepted.mask_endings.filter((end) => last.endsWith(end) && last !== end).map((end) => last.slice(0, -end.length));
  names.push(...accepted.mask_beginnings.filter((begin) => last.startsWith(begin) && last !== begin).map((begin) => last.slice(begin.length)));
  return names.map((name) => folder + name);
}

/** @typedef {{top: string, transforms: string[], models: string[], problem: string | null}} Cameras */

/**
 * The cameras of the outermost data set: its folder, its transforms*.json files and its folders with a COLMAP model.
 * @param {string[]} paths
 * @returns {Cameras}
 */
function camerasIn(paths) {
  /** @type {Map<string, {transforms: string[], keyframes: string[][], models: Map<string, number>}>} */
  const sets = new Map();
  const lower = new Set(paths.map((path) => path.toLowerCase()));
  const of = (/** @type {string} */ top) => sets.get(top) ?? sets.set(top, { transforms: [], keyframes: KEYFRAMES.map(() => []), models: new Map() }).get(top);
  for (const path of paths) {
    const folder = path.slice(0, path.lastIndexOf("/") + 1);
    const base = path.slice(folder.length).toLowerCase();
    const place = KEYFRAMES.findIndex((name) => `/${folder.toLowerCase()}`.endsWith(`/${name}`));
    if (base.startsWith("transforms") && base.endsWith(".json")) of(folder)?.transforms.push(path);
    else if (place >= 0 && base.endsWith(".json")) of(folder.slice(0, -KEYFRAMES[place].length))?.keyframes[place].push(path);
    else if (base === "cameras.bin" || base === "cameras.txt") {
      const { top, rank } = placeOf(folder);
      if (top === "" || lower.has(`${folder.toLowerCase()}images${base.slice(-4)}`)) of(top)?.models.set(folder, rank);
    }
  }
  const depth = (/** @type {string} */ top) => top.split("/").length - 1;
  const tops = [...sets.keys()].sort((one, other) => depth(one) - depth(other) || byCodePoint(one, other));
  const none = { top: "", transforms: [], models: [], problem: null };
  if (!tops.length || depth(tops[0]) > MAX_DEPTH) return none;
  if (tops.length > 1 && depth(tops[1]) === depth(tops[0])) {
    return { ...none, problem: `There are cameras of several data sets, in ${tops[0]} and in ${tops[1]}. Give the folder of one of them.` };
  }
  const { transforms, keyframes, models } = /** @type {{transforms: string[], keyframes: string[][], models: Map<string, number>}} */ (sets.get(tops[0]));
  const best = Math.min(...models.values());
  const folders = [...models.keys()].filter((folder) => models.get(folder) === best);
  const last = (/** @type {string} */ folder) => Number(numberOf(folder) ?? Infinity);
  folders.sort((one, other) => (last(one) === last(other) ? byCodePoint(one, other) : last(one) - last(other)));
  const first = transforms.length ? transforms : keyframes.find((paths) => paths.length) ?? [];
  return { top: tops[0], transforms: first, models: folders, problem: null };
}

/** The data set that a folder with a COLMAP model belongs to, and the rank of its place there. @param {string} folder */
function placeOf(folder) {
  for (const [rank, place] of MODEL_PLACES) {
    const match = place.exec(folder);
    if (match) return { top: folder.slice(0, match.index), rank };
  }
  return { top: folder, rank: MODEL_PLACES.length };
}

/** The last part of a folder if it is a number. @param {string} folder */
function numberOf(folder) {
  return /(?:^|\/)(\d+)\/$/.exec(folder)?.[1] ?? null;
}

/** The name in the capture, which is that in the data set, of each path that is a pose file. @param {Cameras} cameras @param {string[]} paths */
function namesOf(cameras, paths) {
  /** @type {Map<string, string>} */
  const poses = new Map(cameras.transforms.map((path) => [path, path.slice(cameras.top.length)]));
  for (const folder of cameras.models) {
    for (const path of paths.filter((one) => one.startsWith(folder))) {
      const ending = suffix(path);
      const stem = path.slice(folder.length, path.length - ending.length).toLowerCase();
      if (MODEL_STEMS.includes(stem) && MODEL_SUFFIXES.includes(ending)) poses.set(path, path.slice(cameras.top.length));
    }
  }
  return poses;
}

/**
 * The paths of files that may have cameras of other programs, and of the lists that belong to them.
 * @param {string[]} paths
 * @param {Accepted} accepted
 */
function programFiles(paths, accepted) {
  const patterns = [...accepted.program_files, ...(paths.some((path) => fits(path, "*.out")) ? accepted.camera_lists : [])];
  return paths.filter((path) => patterns.some((pattern) => fits(path, pattern)));
}

/**
 * The zips with files of cameras: the first of these, and whether nothing but other cameras keeps them from being used.
 * @param {string[]} paths
 * @param {Map<string, string[]>} lists
 * @param {Accepted} accepted
 */
function camerasInZips(paths, lists, accepted) {
  const patterns = [...MODEL_PARTS, "transforms*.json", ...Object.values(accepted.other_cameras).flat()];
  const media = [...accepted.photos, ...accepted.videos, ...accepted.archives];
  return paths.flatMap((path) => {
    const inside = (lists.get(path) ?? []).filter((name) => !isHidden(name)).sort(byCodePoint);
    const programs = programFiles(inside, accepted);
    const first = inside.find((name) => programs.includes(name) || patterns.some((pattern) => fits(name, pattern)) || isKeyframe(name));
    return first ? [{ path, first, posed: !inside.some((name) => media.some((ending) => name.toLowerCase().endsWith(ending))) }] : [];
  });
}

/** Whether a path is that of a camera in the raw data of Polycam. @param {string} path */
function isKeyframe(path) {
  const folder = `/${path.slice(0, path.lastIndexOf("/") + 1).toLowerCase()}`;
  return path.toLowerCase().endsWith(".json") && KEYFRAMES.some((place) => folder.endsWith(`/${place}`));
}

/** Whether the last parts of a path, as many as a pattern in lower case has, fit it; * stands for any letters. @param {string} path @param {string} pattern */
export function fits(path, pattern) {
  const name = path.split("/").slice(-pattern.split("/").length).join("/").toLowerCase();
  const parts = pattern.split("*").map((part) => part.replace(/[.*+?^${}()|[\]\\]/g, "\\$&"));
  return new RegExp(`^${parts.join(".*")}$`, "su").test(name);
}

/** The order of Python's strings. @param {string} one @param {string} other */
export function byCodePoint(one, other) {
  const [left, right] = [[...one], [...other]];
  for (let i = 0; i < Math.min(left.length, right.length); i++) {
    const difference = /** @type {number} */ (left[i].codePointAt(0)) - /** @type {number} */ (right[i].codePointAt(0));
    if (difference) return difference;
  }
  return left.length - right.length;
}
