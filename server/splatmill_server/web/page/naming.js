// The name of a job and its model, and the dialog that changes it.

import { send } from "./api.js";
import { h } from "./dom.js";
import { notify } from "./shell.js";

const LONGEST = 200; // characters, as the server allows

/**
 * A button that asks for a new name.
 * @param {string} address that of the record, as `/v1/models/{id}`
 * @param {() => string} name the present name
 * @param {(record: any) => void} renamed called with the record under its new name
 */
export function renameButton(address, name, renamed) {
  return h("button", { type: "button", onclick: async () => {
    const chosen = await askName(name());
    if (chosen === null || chosen === name()) return;
    try {
      renamed(await send("PATCH", address, { name: chosen || null }));
    } catch (error) {
      notify(/** @type {Error} */ (error));
    }
  } }, "Rename");
}

/** @param {string} name the present one @returns {Promise<string | null>} the name as it was left; null if it is not to change */
function askName(name) {
  return new Promise((resolve) => {
    const field = h("input", { id: "new-name", type: "text", maxlength: LONGEST, autocomplete: "off", autofocus: true });
    field.value = name;
    const dialog = h("dialog", { "aria-labelledby": "rename-title" },
      h("form", { method: "dialog", class: "stack" },
        h("h2", { id: "rename-title" }, "Rename"),
        h("div", { class: "field" }, h("label", { for: "new-name" }, "Name"), field),
        h("div", { class: "row" },
          h("button", { class: "push", type: "button", onclick: () => dialog.close("no") }, "Keep"),
          h("button", { class: "primary", value: "yes" }, "Rename"))));
    dialog.addEventListener("close", () => {
      resolve(dialog.returnValue === "yes" ? field.value.trim() : null);
      dialog.remove();
    });
    document.body.append(dialog);
    dialog.showModal();
    field.select();
  });
}
