// What the server makes in the background: followed until it is whole, and stopped.

import { get, request } from "../api.js";

/** Milliseconds between two looks how far it is. */
const LOOK_MS = 500;

/**
 * Follow a video or a mesh until it has ended, and return it; null once it was stopped.
 * @param {any} record
 * @param {HTMLButtonElement} stop
 * @param {(record: any) => void} said shows how far it is
 * @param {(error: Error) => void} refused shows why it could not be stopped
 */
export async function follow(record, stop, said, refused) {
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
