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

/** What is deleted, as people call it: one, several, and what goes along and what stays. */
const NOUNS = /** @type {const} */ ({
  model: ["model", "models", "Jobs and reports go with their models, and links to them open nothing meanwhile. The photos are kept."],
  job: ["job", "jobs", "Models and reports go with their jobs, and links to them open nothing meanwhile. The photos are kept."],
  photos: ["set of photos", "sets of photos", "Models made of them are kept."],
});

/**
 * What deleting does: the same sentences before and after it, wherever something is deleted.
 * @param {keyof typeof NOUNS} noun @param {number} many
 */
export function binText(noun, many) {
  const [one, several, more] = NOUNS[noun];
  return `${many === 1 ? `The ${one} stays` : `${many} ${several} stay`} in the bin for a day, and can be restored there. ${more}`;
}

/**
 * Put records into the bin, and offer to restore them.
 * @param {{kind: "job" | "capture", id: string}[]} records
 * @param {keyof typeof NOUNS} noun
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
  notify(binText(noun, done.length), "good", { text: "Undo", act: async () => {
    for (const { kind, id } of done) await send("DELETE", binned(kind, id));
    await back();
  } });
}
