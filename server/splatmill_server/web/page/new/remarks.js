// Remarks on files before they are sent: those that are not read, and what is probably wrong with masks. The sentences
// are those of the command line (client/splatmill/transfer/local_capture.py) and of the worker (images/masks.py); tests compare them.

import { MAX_DEPTH, MODEL_PARTS, fits, stem, suffix, unmarked } from "./kinds.js";

/** Share of the pixels of all photos that masks may hide without a remark. */
const MOST_HIDDEN = 0.5;

/**
 * Sentences about files that hold photos, videos or cameras and are not used.
 * @param {import("./kinds.js").Sorted} sorted
 * @param {import("./kinds.js").Accepted} accepted
 * @returns {string[]}
 */
export function remarks({ files, ignored, others, posed, idle, zipped }, accepted) {
  const said = [];
  const read = new Map(accepted.unread.flatMap((kind) => kind.suffixes.map((ending) => [ending, kind])));
  /** @type {Map<import("./kinds.js").Accepted["unread"][0], string[]>} */
  const unread = new Map();
  for (const path of ignored) {
    const kind = read.get(suffix(path));
    if (kind) unread.set(kind, [...(unread.get(kind) ?? []), path]);
  }
  for (const [kind, paths] of unread) {
    said.push(`Not read are ${kind.what}: ${paths[0]}${paths.length > 1 ? ` and ${paths.length - 1} more` : ""}. ${kind.advice}`);
  }
  if (!posed) said.push(...unreadCameras([...ignored, ...files.map(({ path }) => path)], accepted));
  if (idle.length) said.push(`Cameras are read where photos have the names in them; beside a video or a zip these files are not used: ${idle.join(", ")}.`);
  const beside = ignored.filter((path) => [...accepted.videos, ...accepted.archives].includes(suffix(path)));
  if (beside.length) said.push(`Videos and zips are not used where there are photos: ${beside.join(", ")}.`);
  for (const { path, first, posed } of zipped) {
    const why = posed ? "other cameras lie beside the photos" : "photos lie in the zip and beside it";
    said.push(`The cameras in ${path} are not used, such as ${first}: ${why}. Give one folder or one zip with the photos and the cameras that belong to them.`);
  }
  for (const what of accepted.unused_folders) {
    const paths = [...others].filter(([, kind]) => kind === what).map(([path]) => path);
    const more = paths.length > 1 ? ` and ${paths.length - 1} more` : "";
    if (paths.length) said.push(`${paths.length === 1 ? "1 picture is" : `${paths.length} pictures are`} taken for ${what} by the name of the folder and not used: ${paths[0]}${more}.`);
  }
  return said;
}

/**
 * Sentences about files with cameras that are not read: of other programs, too deep, or a part of a COLMAP model.
 * @param {string[]} paths
 * @param {import("./kinds.js").Accepted} accepted
 */
function unreadCameras(paths, accepted) {
  const recovered = "cameras are recovered from the photos.";
  const first = (/** @type {string[]} */ patterns) => paths.find((path) => patterns.some((pattern) => fits(path, pattern)));
  const said = Object.entries(accepted.other_cameras).flatMap(([program, patterns]) => {
    const path = first(patterns);
    return path ? [`The cameras of ${program} in ${path} are not read: ${recovered} To use those, export them from there as a COLMAP model or a transforms.json.`] : [];
  });
  const part = first([...MODEL_PARTS, "transforms*.json"]);
  if (part) said.push(`${part} is not read: ${recovered} A COLMAP model has cameras and images, both as .bin or both as .txt, and lies at most ${MAX_DEPTH} folders down, as a transforms.json does.`);
  return said;
}

/**
 * Sentences about where the cameras lie, and about results that are not used.
 * @param {import("./kinds.js").Sorted} sorted
 * @returns {string[]}
 */
export function places({ top, outputs }) {
  return [
    ...(top ? [`The cameras are those in ${top}.`] : []),
    ...(outputs.length ? [`Results of an earlier training, not read: ${outputs.join(", ")}.`] : []),
  ];
}

/** Level of 255 from which a pixel of a mask is shown. */
const SHOWN = 128;

/**
 * Sentences about masks that belong to no photo, about masks of two labels, and about those that hide all or most.
 * @param {{name: string, named: boolean, levels: Uint32Array | null}[]} masks named: by a frame
 * @param {string[]} photos names
 * @param {import("./kinds.js").Accepted} accepted
 * @returns {string[]}
 */
export function onMasks(masks, photos, accepted) {
  const said = [];
  const last = (/** @type {string} */ name) => name.slice(name.lastIndexOf("/") + 1).toLowerCase();
  const known = new Set(photos.flatMap((name) => [last(name), stem(last(name))]));
  const used = masks.filter(({ name, named }) => named || [stem(last(name)), ...unmarked(stem(last(name)), accepted)].some((form) => known.has(form)));
  const unused = masks.filter((mask) => !used.includes(mask)).map(({ name }) => name).sort();
  if (unused.length) {
    const are = unused.length === 1 ? "1 mask belongs" : `${unused.length} masks belong`;
    said.push(`${are} to no photo by name, and no use is made of it: ${unused.slice(0, 5).join(", ")}${unused.length > 5 ? ", ..." : ""}.`);
  }
  const counts = used.flatMap(({ levels }) => (levels === null ? [] : [levels]));
  const present = Array.from({ length: 256 }, (_, level) => level).filter((level) => counts.some((levels) => levels[level]));
  const [low, high] = present;
  let shownFrom = SHOWN;
  if (present.length === 2 && (high < SHOWN || low >= SHOWN)) {
    shownFrom = high;
    said.push(`The masks have the levels ${low} and ${high} of 255 alone, as pictures of labels have. ${low} is taken to hide, and ${high} to show what is trained on: if it is the other way round, invert them.`);
  }
  const sum = (/** @type {Uint32Array} */ levels) => levels.reduce((all, count) => all + count, 0);
  const shares = counts.map((levels) => sum(levels.subarray(0, shownFrom)) / sum(levels));
  const hidden = shares.reduce((sum, share) => sum + share, 0) / shares.length;
  if (hidden * used.length > MOST_HIDDEN * photos.length) {
    said.push(`The masks of ${used.length} of ${photos.length} photos hide ${Math.round(100 * hidden)}% of their pixels. Black hides, and white is trained on: if the masks show in white what they should hide, invert them.`);
  }
  return said;
}
