// SHA-256 of a file: by the browser where it has that and the file fits into memory, else by a library, piece by piece.
// Pages that came over plain http from another machine have no `crypto.subtle`.

/** Bytes of a file that is read as a whole. */
const WHOLE = 32 << 20;

/** Bytes read at a time. */
const PIECE = 4 << 20;

/**
 * Return the SHA-256 of a file in lower-case hex. Throws if the file cannot be read.
 * @param {Blob} file
 * @param {string} library address of the module with `sha256`, since a worker has no import map; "" if there is none
 * @returns {Promise<string>}
 */
export async function sha256(file, library) {
  if (globalThis.crypto?.subtle && (file.size <= WHOLE || !library)) {
    return hex(new Uint8Array(await crypto.subtle.digest("SHA-256", await file.arrayBuffer())));
  }
  return sha256InPieces(file, library);
}

/**
 * The same, without the browser's own.
 * @param {Blob} file
 * @param {string} library
 */
export async function sha256InPieces(file, library) {
  const { sha256: algorithm } = await import(library);
  const sum = algorithm.create();
  for (let at = 0; at < file.size; at += PIECE) {
    sum.update(new Uint8Array(await file.slice(at, at + PIECE).arrayBuffer()));
  }
  return hex(sum.digest());
}

/** @param {Uint8Array} bytes */
function hex(bytes) {
  return [...bytes].map((byte) => byte.toString(16).padStart(2, "0")).join("");
}
