// The bin: what is deleted can be restored for a day.

import { send } from "./api.js";
import { notify } from "./shell.js";

/**
 * The address of a record in the bin.
 * @param {"job" | "capture"} kind @param {string} id
 */
export function binned(kind, id) {
  return `/v1/bin/${kind}s/${encodeURIComponent(id)}`;
}

/**
 * Put records into the bin, and offer to restore them.
 * @param {{kind: "job" | "capture", id: string}[]} records
 * @param {[string, string]} noun what one of them is called, and several: ["model", "models"]
 * @param {(ids: string[]) => unknown} gone called with those that are in the bin
 * @param {() => unknown} back called when they are restored
 */
export async function putInBin(records, noun, gone, back) {
  /** @type {typeof records} */
  const done = [];
  for (const record of records) {
    try {
      await send("PUT", binned(record.kind, record.id));
      done.push(record);
    } catch (error) {
      notify(/** @type {Error} */ (error)); // the others do not depend on it
    }
  }
  if (!done.length) return;
  await gone(done.map(({ id }) => id));
  const what = done.length === 1 ? `The ${noun[0]} is` : `${done.length} ${noun[1]} are`;
  notify(`${what} in the bin, and deleted for good in a day.`, "good", { text: "Undo", act: async () => {
    for (const { kind, id } of done) await send("DELETE", binned(kind, id));
    await back();
  } });
}
