// The table of downloads: each file with its bytes, and each format with the error that the model has in it. Formats are
// made when they are first asked for, and their rows told anew then.

import { get, request } from "../api.js";
import { h } from "../dom.js";
import { bytes } from "../format.js";
import { noticeOf } from "../shell.js";
import { smallFormat } from "../viewer/small_file.js";

/** @import {Shown} from "./model.js" */

/**
 * A row of the table.
 * @typedef {object} Row
 * @property {string} name
 * @property {string} href
 * @property {string} what
 * @property {string} [loses] what a model loses in it, in the words of the field
 * @property {number | null} size bytes; null until it was made
 * @property {string} [psnr] of the model in this file, as text
 * @property {string} [loss] what it is less than that of model.ply, as text
 * @property {string} [madeAt] the address that answers when the file has been made, where it has not
 */

/** What the files of a model hold. Files in folders are shown elsewhere on the page. @type {Record<string, string>} */
const FILES = {
  "model.ply": "The Gaussians as they were trained, for any viewer or editor",
  "cameras.zip": "The cameras and points as a COLMAP model and as transforms.json, for other tools",
  "cameras.json": "The cameras of the photos",
  "frame.json": "How the coordinates were chosen: up, unit, and where on the earth",
  "report.json": "The report as data",
  "report.html": "The report as a page",
  "report.png": "Quality against time",
  "progress.mp4": "Video of the training",
  "preview.jpg": "A picture of the model",
  "poster.jpg": "The picture from the start view, which links show",
};

/**
 * @param {HTMLElement} section
 * @param {Shown} shown
 */
export async function showDownloads(section, { model, address }) {
  const sizes = new Map(model.files.map((/** @type {any} */ file) => [file.name, file.size]));
  /** @type {Row[]} */
  const files = Object.keys(FILES).filter((name) => sizes.has(name)).map((name) => ({
    name, href: `${address}/files/${name}`, what: FILES[name], size: sizes.get(name),
  }));
  // The roles are named because the layout on phones would take them away.
  const body = h("tbody", { role: "rowgroup" });
  const state = h("div", { role: "status" });
  section.append(h("h2", { id: "downloads-title" }, "Downloads"),
    h("div", { class: "scroll" }, h("table", { class: "table stacks", role: "table" },
      h("thead", { role: "rowgroup" }, h("tr", { role: "row" }, ["File", "Size", "PSNR"].map((text, i) =>
        h("th", { scope: "col", role: "columnheader", class: i > 0 && "number" }, text)))),
      body)),
    state);
  /** The addresses whose files are being made. @type {Set<string>} */
  const making = new Set();

  const show = (/** @type {Row[]} */ rows) => {
    const focused = body.contains(document.activeElement) ? document.activeElement?.getAttribute("href") : null;
    body.replaceChildren(...rows.map((row) => rowOf(row, making, () => void made(row))));
    if (focused) [...body.querySelectorAll("a")].find((link) => link.getAttribute("href") === focused)?.focus();
  };
  const tell = async () => {
    const formats = formatRows(await get(`${address}/formats`), address, model.gaussians);
    show([...formats, ...files.filter((row) => row.name !== "model.ply")]);
  };
  /** Wait until the file of a row has been made, which its download has asked for. @param {Row} row */
  const made = async (row) => {
    if (!row.madeAt || making.has(row.madeAt)) return;
    making.add(row.madeAt);
    const said = h("div", { "data-of": row.name }, h("p", { class: "hint" }, `The server makes ${row.name}. The download begins when it is there.`));
    state.querySelector(`[data-of="${row.name}"]`)?.remove();
    state.append(said);
    try {
      await tell();
      await request("GET", row.madeAt, { headers: { Range: "bytes=0-0" } });
      said.remove();
    } catch (error) {
      said.replaceChildren(noticeOf(/** @type {Error} */ (error)));
    } finally {
      making.delete(row.madeAt);
      await tell().catch(() => {}); // the rows as they were stand
    }
  };

  show(files);
  await tell().catch((error) => state.append(noticeOf(error, "warning")));
}

/**
 * The formats that the server converts the model to, then the page in one file.
 * @param {any} answer that of `/v1/models/{id}/formats`
 * @param {string} address that of the model
 * @param {number} gaussians of the model
 * @returns {Row[]}
 */
function formatRows(answer, address, gaussians) {
  /** @type {Row[]} */
  const rows = answer.formats.map((/** @type {any} */ { format, name, address: href, loses, readers, bytes: size, conversion }) => {
    const plain = format === "ply";
    return {
      name: plain ? "model.ply" : name,
      href: plain ? `${address}/files/model.ply` : href,
      what: `Read by ${readers.join(", ")}.`,
      loses,
      size,
      madeAt: size === null ? href : undefined,
      ...(plain ? { psnr: answer.psnr === null ? "" : `${answer.psnr.toFixed(2)} dB` } : qualityOf(conversion)),
    };
  });
  const inOneFile = smallFormat(gaussians);
  const held = rows[answer.formats.findIndex((/** @type {any} */ { format }) => format === inOneFile)];
  if (held) {
    rows.push({
      ...held, name: "Page in one file (.html)", href: `${address}/download/html`, size: null, loses: undefined,
      what: `The model with its viewer, to open without a server or to mail. It holds the .${inOneFile}.`,
    });
  }
  return rows;
}

/** @param {any} conversion that of a format; null until it was made @returns {{psnr?: string, loss?: string}} */
function qualityOf(conversion) {
  if (conversion === null || conversion.psnr === null) return {};
  const psnr = `${conversion.psnr.toFixed(2)} dB`;
  if (conversion.compared_with === "renderings") return { psnr, loss: "against model.ply" };
  if (conversion.psnr_before === null) return { psnr };
  const less = conversion.psnr_before - conversion.psnr;
  if (Math.abs(less) < 0.005) return { psnr, loss: "as model.ply" };
  return { psnr, loss: `${Math.abs(less).toFixed(2)} dB ${less < 0 ? "more" : "less"} than model.ply` };
}

/**
 * @param {Row} row
 * @param {Set<string>} making
 * @param {() => void} onAsked
 */
function rowOf({ name, href, what, loses, size, psnr = "", loss = "", madeAt }, making, onAsked) {
  const unmade = madeAt && making.has(madeAt) ? "being made" : "made on demand";
  return h("tr", { role: "row" },
    h("td", { role: "cell" }, h("a", { href, download: "", onclick: onAsked }, name), h("div", { class: "muted small" }, what),
      loses && h("details", { class: "muted small" }, h("summary", {}, "What it loses"), loses)),
    h("td", { role: "cell", class: "number" }, size === null ? unmade : bytes(size)),
    h("td", { role: "cell", class: "number" }, psnr, loss && h("div", { class: "muted small" }, loss)));
}
