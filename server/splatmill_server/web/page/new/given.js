// Files as people give them: dropped files and folders, and those chosen or taken with a camera.

import { withoutTop } from "./kinds.js";

/** @typedef {{path: string, file: File}} Given */

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
  return files.map(({ file }, index) => ({ path: paths[index], file }));
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
