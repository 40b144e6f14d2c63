// What the server makes in the background and keeps with a model: begun, followed until it is whole, stopped, listed and deleted.

import { get, request, send } from "../api.js";
import { h } from "../dom.js";
import { noticeOf } from "../shell.js";

/** Milliseconds between two looks how far it is. */
const LOOK_MS = 500;

/**
 * Follow a video or a mesh until it has ended, and return it; null once it was stopped.
 * @param {any} record
 * @param {HTMLButtonElement} stop
 * @param {(record: any) => void} said shows how far it is
 * @param {(error: Error) => void} refused shows why it could not be stopped
 */
async function follow(record, stop, said, refused) {
  const stopping = new AbortController();
  stop.onclick = async () => {
    stopping.abort(); // a question under way could come after the deletion
    try {
      await request("DELETE", record.links.self);
    } catch (error) {
      refused(/** @type {Error} */ (error));
    }
  };
  stop.hidden = false;
  try {
    while (!["succeeded", "failed"].includes(record.state)) {
      said(record);
      await new Promise((resolve) => setTimeout(resolve, LOOK_MS));
      if (stopping.signal.aborted) return null;
      record = await get(record.links.self, {}, stopping.signal);
    }
    return record;
  } catch (error) {
    if (stopping.signal.aborted) return null;
    throw error;
  } finally {
    stop.hidden = true;
  }
}

/**
 * The elements that show the videos or the meshes of a model, and what begins one. `open` lists them, and follows one that is not whole.
 * @param {string} address of the model
 * @param {"orbits" | "meshes"} kind
 * @param {HTMLButtonElement} make the button that begins one
 * @param {object} shown
 * @param {(record: any) => string} shown.progress how far one is
 * @param {(problem: any) => string} shown.failure why one has failed
 * @param {(record: any) => { name: string, use: HTMLElement }} shown.entry of the list: what is deleted, and what opens or saves it
 * @param {(record: any) => void} [shown.whole] shows one that has just been made
 * @param {() => void} [shown.over] when one is no longer followed
 */
export function keptOf(address, kind, make, { progress, failure, entry, whole = () => {}, over = () => {} }) {
  const stop = h("button", { type: "button", class: "quiet", hidden: true }, "Stop");
  const state = h("p", { class: "hint", role: "status" });
  const place = h("div");
  const kept = h("ul", { class: "kept" });
  const refused = (/** @type {unknown} */ error) => place.append(noticeOf(/** @type {Error} */ (error)));

  /** List those that are whole, and return the others that have not failed. */
  async function list() {
    /** @type {any[]} */
    const records = (await get(`${address}/${kind}`))[kind];
    kept.replaceChildren(...records.filter(({ state }) => state === "succeeded").map((record) => {
      const { name, use } = entry(record);
      return h("li", {}, use, h("button", { type: "button", class: "quiet", "aria-label": `Delete ${name}`, onclick: () => remove(record) }, "Delete"));
    }));
    return records.filter(({ state }) => state === "queued" || state === "running");
  }

  /** @param {any} record */
  async function remove(record) {
    try {
      await request("DELETE", record.links.self);
      place.replaceChildren();
      await list();
    } catch (error) {
      refused(error);
    }
  }

  /** Show how far one is until it is whole. @param {any} begun */
  async function show(begun) {
    make.disabled = true;
    try {
      const record = await follow(begun, stop, (each) => { state.textContent = progress(each); }, refused);
      state.textContent = !record ? "Stopped." : record.state === "failed" ? failure(record.problem) : "";
      if (record?.state === "succeeded") {
        whole(record);
        await list();
      }
    } catch (error) {
      state.textContent = "";
      throw error;
    } finally {
      make.disabled = false;
      over();
    }
  }

  /** @param {object} wish the body of the request */
  async function begin(wish) {
    make.disabled = true;
    try {
      await show(await send("POST", `${address}/${kind}`, wish));
    } catch (error) {
      refused(error);
    } finally {
      make.disabled = false;
    }
  }

  async function open() {
    try {
      const [unfinished] = await list();
      if (unfinished) await show(unfinished);
    } catch (error) {
      refused(error);
    }
  }

  return { stop, state, place, kept, begin, open };
}
