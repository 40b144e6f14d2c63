// The dialog that makes, shows and revokes links to a model.

import { at, isLoopback } from "./address.js";
import { get, send } from "./api.js";
import { h } from "./dom.js";
import { moment, nameOf } from "./format.js";
import { noticeOf } from "./shell.js";
import { prepareSmallFile } from "./viewer/small_file.js";

const TERMS = [["1d", "1 day"], ["7d", "7 days"], ["30d", "30 days"], ["365d", "1 year"]];

/**
 * Open the dialog of a model's links.
 * @param {string} address that of the model, as /v1/models/ID
 * @param {string} name of the model
 */
export async function openSharing(address, name) {
  const term = h("select", { id: "share-term" }, TERMS.map(([value, text]) => h("option", { value, selected: value === "30d" }, text)));
  const photos = h("input", { type: "checkbox", id: "share-photos", "aria-describedby": "share-photos-hint" });
  const label = h("input", { id: "share-name", maxlength: 200, autocomplete: "off" });
  const made = h("div", { class: "stack", role: "status" });
  const list = h("ul", { class: "links" });
  let latest = ""; // id of the link in `made`
  const trouble = h("div");
  const form = h("form", { class: "stack" },
    h("div", { class: "row" },
      h("div", { class: "field" }, h("label", { for: "share-term" }, "Valid for"), term),
      h("div", { class: "field" }, h("label", { for: "share-name" }, "For whom (only you see it)"), label)),
    h("div", {},
      h("label", { class: "row small", for: "share-photos" }, photos, "Show photos too"),
      h("p", { class: "hint", id: "share-photos-hint" }, "The photos that the model was compared with, in full size, and the report, which shows some of them.")),
    h("p", {}, h("button", { class: "primary", type: "submit" }, "Make a link")));
  const dialog = h("dialog", { class: "sharing", "aria-labelledby": "sharing-title" },
    h("div", { class: "stack" },
      h("div", { class: "row" }, h("h2", { id: "sharing-title" }, `Share ${name}`),
        h("button", { class: "quiet small push", type: "button", "aria-label": "Close", onclick: () => dialog.close() }, "✕")),
      h("p", {}, "Whoever has the link can look at this model and download it, without a key, until the link ends. With it go its picture, its annotations and measurements, the film of its training, the curve of its error, the names of the photo files, and where each photo was taken relative to the scene. It is listed nowhere."),
      form, trouble, made, list));

  /** Do what may fail, and say it in the dialog. @param {() => Promise<void>} work */
  async function tried(work) {
    trouble.replaceChildren();
    try {
      await work();
    } catch (error) {
      trouble.replaceChildren(noticeOf(/** @type {Error} */ (error)));
    }
  }

  async function show() {
    const { shares } = await get(`${address}/shares`);
    list.replaceChildren(...shares.map((/** @type {any} */ share) => h("li", { class: "row" },
      h("span", {}, nameOf(share, "Link")),
      h("span", { class: "hint" }, share.revoked_at ? `revoked ${moment(share.revoked_at)}` : `${share.active ? "valid until" : "expired"} ${moment(share.expires_at)}${share.photos ? ", with photos" : ""}`),
      share.active && h("button", { class: "small push", type: "button", onclick: () => revoke(share) }, "Revoke", h("span", { class: "visually-hidden" }, ` ${nameOf(share, "Link")}`)))));
  }

  /** @param {any} share */
  const revoke = (share) => tried(async () => {
    await send("DELETE", `${address}/shares/${share.id}`);
    if (share.id === latest) made.replaceChildren();
    await show();
    /** @type {HTMLElement} */ (form.querySelector("button")).focus();
  });

  form.addEventListener("submit", (event) => {
    event.preventDefault();
    void tried(async () => {
      const share = await send("POST", `${address}/shares`, { expires_in: term.value, name: label.value.trim() || null, photos: photos.checked });
      void prepareSmallFile(address); // before visitors come
      latest = share.id;
      made.replaceChildren(link(`${location.origin}${at(share.path)}`, name));
      label.value = "";
      await show();
      made.querySelector("input")?.focus({ preventScroll: true });
      made.scrollIntoView({ block: "nearest" });
    });
  });
  dialog.addEventListener("close", () => dialog.remove());
  document.body.append(dialog);
  dialog.showModal();
  await tried(show);
}

/** A frame fits its column, at most as wide as its attribute says, which pages that remove styles follow. */
const FRAME_STYLE = "width: 100%; max-width: 800px; height: auto; aspect-ratio: 8 / 5; border: 0";

/**
 * The HTML of a frame that shows a shared model alone.
 * @param {string} address of its link @param {string} name of the model
 */
export function frameOf(address, name) {
  const title = name.replace(/[&"<>]/g, (sign) => `&#${sign.charCodeAt(0)};`);
  return `<iframe src="${address}/embed" width="800" height="500" style="${FRAME_STYLE}" title="${title}" allow="fullscreen" loading="lazy"></iframe>`;
}

/** The address of a new link, which the server cannot show again. @param {string} address @param {string} name of the model */
function link(address, name) {
  const shown = h("input", { id: "share-link", readonly: true, value: address, "aria-describedby": isLoopback(location.hostname) && "share-reach", onfocus: () => shown.select() });
  const frame = h("textarea", { id: "share-frame", rows: 3, readonly: true, spellcheck: "false", onfocus: () => frame.select() }, frameOf(address, name));
  const [said, saidOfFrame] = [0, 1].map(() => h("span", { class: "hint", role: "status" }));
  return h("div", { class: "field" },
    isLoopback(location.hostname) && h("p", { class: "hint", id: "share-reach" },
      `Only this machine reaches ${location.host}. For others, make the link where this page is open under the name or the network address of the server.`),
    h("label", { for: "share-link" }, "The link, which is shown only now"),
    shown,
    h("div", { class: "row" },
      h("button", { class: "small", type: "button", onclick: () => copy(shown, said) }, "Copy"),
      h("a", { class: "button small", href: address, target: "_blank", rel: "noopener" }, "Open"), said),
    h("label", { for: "share-frame" }, "To show it on a page of yours, HTML of a frame"),
    frame,
    h("div", { class: "row" }, h("button", { class: "small", type: "button", onclick: () => copy(frame, saidOfFrame) }, "Copy the HTML"), saidOfFrame));
}

/**
 * Copy a text; where the browser has no clipboard, select it.
 * @param {HTMLInputElement | HTMLTextAreaElement} shown @param {HTMLElement} said where to say what was done
 */
export async function copy(shown, said) {
  try {
    await navigator.clipboard.writeText(shown.value);
    said.textContent = "Copied.";
  } catch {
    shown.focus();
    shown.select();
    said.textContent = "Selected: copy it with Ctrl-C.";
  }
}
