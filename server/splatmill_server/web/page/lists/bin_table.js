// What is in the bin, as a table: each entry can be restored, or deleted for good at once.

import { binned } from "../bin.js";
import { get, send } from "../api.js";
import { h, when } from "../dom.js";
import { nameOf } from "../format.js";
import { confirmAction, notify } from "../shell.js";

/**
 * Show the bin in a section, which is hidden while it is empty. `changed` is to show it anew.
 * @param {HTMLElement} section
 * @param {() => unknown} changed called when an entry was restored or deleted for good
 * @returns {Promise<Set<string>>} the ids of what is in the bin
 */
export async function showBin(section, changed) {
  const { entries } = await get("/v1/bin");
  section.hidden = entries.length === 0;
  const again = async () => {
    await changed();
    if (section.hidden) document.getElementById("main")?.focus();
    else section.querySelector("button")?.focus();
  };
  section.replaceChildren(h("h2", { id: "bin-title" }, "Bin"),
    h("p", { class: "hint" }, "What is here counts as used storage until it is deleted for good."),
    h("div", { class: "scroll", tabindex: 0, role: "region", "aria-label": "Entries of the bin" }, h("table", { class: "table stacks" },
      h("thead", {}, h("tr", {}, ["What", "Name", "Deleted for good", ""].map((text) => h("th", { scope: "col" }, text)))),
      h("tbody", {}, entries.map((/** @type {any} */ entry) => row(entry, again))))));
  return new Set(entries.map((/** @type {any} */ entry) => entry.id));
}

/** @param {any} entry @param {() => unknown} changed */
function row(entry, changed) {
  const what = entry.kind === "capture" ? "Photos" : entry.model ? "Model" : "Job";
  const name = nameOf(entry, what);
  const { kind, id } = entry;
  return h("tr", {},
    h("td", {}, what),
    h("td", {}, name),
    h("td", { "data-label": "Deleted for good" }, when(entry.deleted_at)),
    h("td", {}, h("div", { class: "row" },
      h("button", { class: "small", type: "button", "aria-label": `Restore ${name}`, onclick: async () => {
        await send("DELETE", binned(kind, id));
        notify(`${name} is restored.`, "good");
        await changed();
      } }, "Restore"),
      h("button", { class: "quiet small", type: "button", "aria-label": `Delete ${name} now`, onclick: async () => {
        const yes = await confirmAction({ title: `Delete ${name} now?`, text: "This cannot be undone.", action: "Delete for good" });
        if (!yes) return;
        await send("DELETE", `/v1/${kind}s/${encodeURIComponent(id)}`);
        await changed();
      } }, "Delete now"))));
}
