// The example scene: a worker makes photos of the built-in still life and trains on them, when somebody asks for it.

import { at } from "./address.js";
import { get, request, send } from "./api.js";
import { h } from "./dom.js";
import { noticeOf } from "./shell.js";

/** The name of the example's photos and of its job. */
const NAME = "Still life";

/** Each owner has its photos once, so that further jobs on them do without the time of the cameras. */
const KEY = "example-still-life";

/** So that the scene is there soon, on any machine. */
const OPTIONS = { time_budget: "2m" };

/** A sentence with the button that trains the example scene. */
export function exampleOffer() {
  const state = h("div", { role: "status" });
  const button = h("button", { type: "button", onclick: async () => {
    button.disabled = true;
    try {
      const job = await train();
      location.assign(at(`/jobs/${encodeURIComponent(job.id)}`));
    } catch (error) {
      state.replaceChildren(noticeOf(/** @type {Error} */ (error)));
      button.disabled = false;
    }
  } }, "Train the example scene");
  return h("div", { class: "example" },
    h("p", {}, "No photos at hand? The server makes photos of a small still life and trains a scene on them in some minutes."),
    button, state);
}

/** Make the capture of the example, where the caller has none, and a job on it. */
async function train() {
  const { accepted } = await get("/v1/info");
  const capture = await send("POST", "/v1/captures", { name: NAME, key: KEY });
  if (!capture.files.length) {
    await request("PUT", `/v1/captures/${encodeURIComponent(capture.id)}/images/${accepted.example}`, { body: new Blob([`${NAME}\n`], { type: "application/octet-stream" }) });
  }
  return send("POST", "/v1/jobs", { capture: capture.id, name: NAME, options: OPTIONS });
}
