// A model file of one's own in the viewer: chosen, or dropped onto the page. It does not leave the device.

import { byId } from "../dom.js";
import { bytes } from "../format.js";
import { noticeOf, startShell } from "../shell.js";
import { open } from "../viewer.js";

/** @type {import("../viewer.js").View | null} */
let view = null;
/** How the name of a model in levels of detail ends. */
const LEVELS = ".lod.zip";
/** The number of files so far: one that was chosen while another was read is the one that is shown. */
let chosen = 0;

const box = byId("view");
const field = /** @type {HTMLInputElement} */ (byId("file"));
const take = () => {
  if (field.files?.[0]) void show(field.files[0]);
  field.value = "";
};
field.addEventListener("change", take);
take(); // a file may have been chosen before this script ran
addEventListener("dragover", (event) => {
  if (event.dataTransfer?.types.includes("Files")) event.preventDefault();
});
addEventListener("drop", (event) => {
  const file = event.dataTransfer?.files[0];
  if (!file) return;
  event.preventDefault();
  void show(file);
});
await startShell({ open: true, viewer: true }); // last: a file may be dropped while it asks who is there

/** @param {File} file */
async function show(file) {
  const mine = (chosen += 1);
  byId("problem").replaceChildren();
  try {
    const levels = file.name.toLowerCase().endsWith(LEVELS);
    const contents = levels ? file : await file.arrayBuffer();
    if (mine !== chosen) return;
    view?.dispose();
    view = null;
    box.replaceChildren();
    view = await open(box, { bytes: contents, levels, label: file.name });
    byId("title").textContent = file.name;
    document.title = `${file.name} - Splatmill`;
    byId("figures").textContent = `${bytes(file.size)}, shown from this device.`;
  } catch (error) {
    if (mine !== chosen) return;
    const words = error instanceof DOMException ? `${file.name} cannot be read: it may have been moved, or is a folder.` : `${file.name}: ${/** @type {Error} */ (error).message}`;
    byId("problem").replaceChildren(noticeOf(words, "error"));
  }
}
