// The labels of a job and its model: its name, its tags and its star, and what changes them.

import { send } from "./api.js";
import { h } from "./dom.js";
import { nameOf } from "./format.js";
import { noticeOf, notify } from "./shell.js";

/** Characters of a name and of a tag, and tags of a record, as the server allows. */
const LONGEST_NAME = 200;
const LONGEST_TAG = 40;
const MOST_TAGS = 12;

/**
 * A button that asks for the name and the tags.
 * @param {string} address that of the record, as `/v1/models/{id}`
 * @param {() => any} record the record as it is now
 * @param {(record: any) => void} changed called with the record under its new labels
 */
export function labelButton(address, record, changed) {
  return h("button", { type: "button", onclick: () => askLabels(address, record(), changed) }, "Name and tags");
}

/**
 * A star that is pressed for a favourite.
 * @param {string} address that of the record
 * @param {any} record
 * @param {(record: any) => void} changed called with the record after the change
 */
export function starButton(address, record, changed) {
  const name = nameOf(record, address.includes("/jobs/") ? "Job" : "Model");
  const button = h("button", { type: "button", class: "star", "data-focus": "star", title: "Favourite", "aria-label": `Favourite: ${name}`, onclick: async () => {
    try {
      const after = await send("PATCH", address, { favourite: button.getAttribute("aria-pressed") !== "true" });
      show(after.favourite);
      changed(after);
    } catch (error) {
      notify(/** @type {Error} */ (error));
    }
  } });
  const show = (/** @type {boolean} */ on) => {
    button.setAttribute("aria-pressed", String(on));
    button.textContent = on ? "★" : "☆";
  };
  show(record.favourite);
  return button;
}

/** The tags of a record, each with a link to the list of what has it; null without any. @param {any} record @param {"/jobs" | "/models"} list */
export function tagLinks({ tags }, list) {
  return tags.length ? h("ul", { class: "tags", "aria-label": "Tags" }, tags.map((/** @type {string} */ tag) =>
    h("li", {}, h("a", { href: `${list}?${new URLSearchParams({ tag })}` }, tag)))) : null;
}

/** @param {string} text @returns {string[]} */
function tagsIn(text) {
  return text.split(",").map((tag) => tag.trim()).filter(Boolean);
}

/** Why these tags cannot be saved, a sentence; "" where they can. @param {string[]} tags */
function problemOf(tags) {
  const long = tags.find((tag) => [...tag].length > LONGEST_TAG);
  if (long) return `The tag "${long}" is too long: a tag has at most ${LONGEST_TAG} characters.`;
  return tags.length > MOST_TAGS ? `These are ${tags.length} tags; at most ${MOST_TAGS} are kept.` : "";
}

/** @param {string} address @param {any} record @param {(record: any) => void} changed */
function askLabels(address, record, changed) {
  const name = h("input", { id: "new-name", type: "text", maxlength: LONGEST_NAME, autocomplete: "off", autofocus: true });
  const tags = h("input", { id: "new-tags", type: "text", autocomplete: "off", "aria-describedby": "new-tags-hint" });
  const problem = h("div");
  name.value = record.name ?? "";
  tags.value = record.tags.join(", ");
  const dialog = h("dialog", { "aria-labelledby": "labels-title", onclose: () => dialog.remove() },
    h("form", { class: "stack", onsubmit: async (/** @type {Event} */ event) => {
      event.preventDefault();
      const chosen = tagsIn(tags.value);
      const wrong = problemOf(chosen);
      tags.setAttribute("aria-invalid", String(Boolean(wrong)));
      if (wrong) {
        problem.replaceChildren(h("p", { class: "error", role: "alert" }, wrong));
        tags.focus();
        return;
      }
      try {
        const after = await send("PATCH", address, { name: name.value.trim() || null, tags: chosen });
        dialog.close();
        changed(after);
      } catch (error) {
        problem.replaceChildren(noticeOf(/** @type {Error} */ (error)));
      }
    } },
      h("h2", { id: "labels-title" }, "Name and tags"),
      h("div", { class: "field" }, h("label", { for: "new-name" }, "Name"), name),
      h("div", { class: "field" }, h("label", { for: "new-tags" }, "Tags"), tags,
        h("p", { class: "hint", id: "new-tags-hint" }, "Words to find it by, separated by commas.")),
      problem,
      h("div", { class: "row" },
        h("button", { class: "push", type: "button", onclick: () => dialog.close() }, "Cancel"),
        h("button", { class: "primary", type: "submit" }, "Save"))));
  document.body.append(dialog);
  dialog.showModal();
  name.select();
}
