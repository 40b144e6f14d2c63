// Files as people give them: dropped files and folders, and those chosen or taken with a camera.

import { day } from "../format.js";
import { suffix, withoutTop } from "./kinds.js";

/** @typedef {{path: string, file: File, folder?: string}} Given  folder: the one that all were given in, which is not in the path */

/**
 * Return the files of a drop, those in folders with their path. Throws an Error, as a sentence, for what cannot be read.
 * @param {DataTransfer} transfer
 * @returns {Promise<Given[]>}
 */
export async function dropped(transfer) {
  // The items are gone once the event is over, so the entries are taken before anything is awaited.
  const entries = [...transfer.items].flatMap((item) => {
    const entry = item.kind === "file" ? item.webkitGetAsEntry?.() : null;
    return entry ? [entry] : [];
  });
  const plain = [...transfer.files];
  if (!entries.length) return plain.map((file) => ({ path: file.name, file }));
  const files = [];
  for (const entry of entries) files.push(...(await walk(entry)));
  return stripped(files);
}

/** @param {FileList | null} files @returns {Given[]} */
export function chosen(files) {
  return stripped([...(files ?? [])].map((file) => ({ path: file.webkitRelativePath || file.name, file })));
}

/** @param {Given[]} files */
function stripped(files) {
  const paths = withoutTop(files.map(({ path }) => path));
  return files.map(({ path, file }, index) => ({ path: paths[index], file, folder: path.slice(0, path.length - paths[index].length).replace(/\/$/, "") }));
}

/** What a scene of these files may be called: as their folder, the only file that is no photo by itself, or the day. @param {Given[]} given @param {import("./kinds.js").Accepted} accepted */
export function suggestedName(given, accepted) {
  const folder = given[0].folder?.split("/").pop();
  if (folder) return folder;
  const [{ file }] = given;
  const stem = file.name.slice(0, file.name.length - suffix(file.name).length);
  return given.length === 1 && [...accepted.archives, ...accepted.videos].includes(suffix(file.name)) && stem ? stem
    : day(file.lastModified);
}

/** @param {FileSystemEntry} entry @returns {Promise<Given[]>} */
async function walk(entry) {
  const path = entry.fullPath.replace(/^\//, "");
  try {
    if (entry.isFile) {
      const file = await new Promise((resolve, reject) => /** @type {FileSystemFileEntry} */ (entry).file(resolve, reject));
      return [{ path, file }];
    }
    const reader = /** @type {FileSystemDirectoryEntry} */ (entry).createReader();
    const files = [];
    for (;;) {
      /** @type {FileSystemEntry[]} */
      const some = await new Promise((resolve, reject) => reader.readEntries(resolve, reject));
      if (!some.length) return files; // a reader gives its entries in several parts
      for (const inside of some) files.push(...(await walk(inside)));
    }
  } catch (error) {
    throw new Error(`${path} cannot be read: ${error instanceof Error ? error.message : error}. Choose the files with the button in place of dropping them.`);
  }
}
