// The upload of one file: in one request, or a large one in pieces that go on at the server's offset after any break
// (docs/programming/uploads.md). The same file is the same upload, so nothing has to be remembered to continue it.

import { problemOfAnswer, transfer } from "./transfer.js";

/** Bytes of one request. A larger file is sent in several. */
export const PIECE = 8 << 20;

/**
 * @typedef {object} Sendable
 * @property {string} role
 * @property {string} name
 * @property {File} file
 * @property {string} digest SHA-256 in hex
 */

/**
 * Make one attempt to send a file. Throws Problem, and an AbortError.
 * @param {string} capture
 * @param {Sendable} item
 * @param {(position: number) => void} onPosition called with the bytes of the file that the server has or that were sent
 * @param {AbortSignal} signal
 */
export async function sendFile(capture, item, onPosition, signal) {
  const path = item.name.split("/").map(encodeURIComponent).join("/");
  const address = `/v1/captures/${capture}/${item.role}/${path}`;
  const headers = { "Content-Type": "application/octet-stream", "X-Content-SHA256": item.digest };
  if (item.file.size > PIECE) return sendInPieces(address, item.file, headers, onPosition, signal);
  checked(await transfer("PUT", address, { headers, body: item.file, onSent: onPosition, signal }));
  onPosition(item.file.size);
}

/**
 * @param {string} address
 * @param {File} file
 * @param {Record<string, string>} headers
 * @param {(position: number) => void} onPosition
 * @param {AbortSignal} signal
 */
async function sendInPieces(address, file, headers, onPosition, signal) {
  const begin = { ...headers, "Upload-Complete": "?0", "Upload-Length": String(file.size) };
  const begun = checked(await transfer("PUT", address, { headers: begin, signal }));
  let offset = Number(begun.header("Upload-Offset"));
  const upload = begun.header("Location");
  if (begun.header("Upload-Complete") === "?1" || !upload) return onPosition(file.size); // the capture holds it already
  while (true) {
    onPosition(offset);
    const start = offset;
    const end = Math.min(start + PIECE, file.size);
    const answer = await transfer("PATCH", upload, {
      headers: {
        "Content-Type": "application/partial-upload",
        "Upload-Offset": String(start),
        "Upload-Complete": end === file.size ? "?1" : "?0",
      },
      body: file.slice(start, end),
      onSent: (sent) => onPosition(start + sent),
      signal,
    });
    if (answer.status === 409 && answer.json?.code === "upload_offset_differs" && answer.header("Upload-Offset")) {
      offset = Number(answer.header("Upload-Offset")); // an answer was lost; the server says where it stands
      continue;
    }
    checked(answer);
    if (end === file.size) return onPosition(file.size);
    offset = end;
  }
}

/** @param {import("./transfer.js").Answer} answer */
function checked(answer) {
  if (answer.status < 200 || answer.status >= 300) throw problemOfAnswer(answer);
  return answer;
}
