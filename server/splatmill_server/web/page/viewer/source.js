/**
 * Opens a file of splats. Its first bytes tell its format, because addresses such as `download/sog` have no suffix.
 */
import { ViewerError } from "./errors.js";

/**
 * @typedef {{url?: string, bytes?: ArrayBuffer | Uint8Array | Blob, levels?: boolean, what?: string}} Source  a file of a model
 *   levels: whether it is a .lod.zip, whose parts are loaded one after the other
 *   what: what is loaded, in words; left out, "the model"
 */

const DRAWN = "The viewer draws .ply, compressed .ply and .sog.";

/** How files begin that the viewer draws, and the suffix by which PlayCanvas chooses a reader. */
const READ = { ply: "ply", PK: "sog" };

/** How files of other formats begin. Those of .splat and .ksplat have no sign of their own. */
const OTHER = { "\x1f\x8b": ".spz", NGSP: ".spz", glTF: ".glb" };

/**
 * Open a file; its bytes are still to be read.
 * @param {Source} source
 * @returns {Promise<{format: string, contents: Response}>}  format: "ply" or "sog"
 * @throws {ViewerError}  where it cannot be had, is empty, or has another format
 */
export async function opened(source) {
  const answer = source.bytes ? new Response(/** @type {BodyInit} */ (source.bytes)) : await fetched(source.url);
  if (!answer.body) throw empty();
  const [start, whole] = answer.body.tee();
  const first = await beginning(start);
  const format = known(READ, first);
  if (format) return { format, contents: new Response(whole, { headers: answer.headers }) };
  void whole.cancel();
  if (!first) throw empty();
  const other = known(OTHER, first);
  if (other) throw new ViewerError("format", `${DRAWN} This is a file of the format ${other}.`);
  const codes = [...first].map((letter) => letter.charCodeAt(0).toString(16).padStart(2, "0")).join(" ");
  throw new ViewerError("format", `${DRAWN} This file is none of them: it begins with the bytes ${codes}.`);
}

/** @param {Record<string, string>} formats @param {string} seen */
function known(formats, seen) {
  return Object.entries(formats).find(([sign]) => seen.startsWith(sign))?.[1];
}

function empty() {
  return new ViewerError("empty", "The file of the model is empty.");
}

/**
 * The first four bytes, as letters, or all where there are fewer.
 * @param {ReadableStream<Uint8Array>} stream
 */
async function beginning(stream) {
  const reader = stream.getReader();
  let text = "";
  try {
    while (text.length < 4) {
      const { value, done } = await reader.read();
      if (done) break;
      text += String.fromCharCode(...value.subarray(0, 4 - text.length));
    }
  } catch (error) {
    throw new ViewerError("unreadable", "The connection ended while the model was loaded.", { cause: error });
  }
  void reader.cancel();
  return text;
}

/** @param {string | undefined} url */
async function fetched(url) {
  const answer = await fetch(url ?? "").catch((error) => {
    throw new ViewerError("unreadable", "The server could not be reached for the model.", { cause: error });
  });
  if (!answer.ok) {
    throw new ViewerError("unreadable", `The model could not be loaded: the server answered ${answer.status}.`);
  }
  return answer;
}
