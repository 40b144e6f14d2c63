// The names of the files in a zip, from the list at its end. Nothing is unpacked; the server does that.

const END = 0x06054b50;
const ENTRY = 0x02014b50;
const END_BYTES = 22;
const LONGEST_COMMENT = 65535;

const UTF8 = 0x800;

/** Encodings of names without the flag of UTF-8. The worker chooses among more (images/archives/zip_names.py): here,
 * folders and suffixes count, which a wrong one breaks where the second byte of a character is a backslash. */
const ENCODINGS = ["utf-8", "shift_jis", "euc-kr", "gb18030", "big5", "ibm866"];

/** Bytes of the list that are read at most. */
const LONGEST_LIST = 16 << 20;

/**
 * Return the names of the files in a zip, or null where the list cannot be read, as in a zip of more than 4 GB.
 * @param {Blob} zip
 * @returns {Promise<string[] | null>}
 */
export async function namesIn(zip) {
  const tail = await view(zip, Math.max(0, zip.size - END_BYTES - LONGEST_COMMENT), zip.size);
  for (let at = tail.byteLength - END_BYTES; at >= 0; at--) {
    if (tail.getUint32(at, true) !== END) continue;
    const [size, begin] = [tail.getUint32(at + 12, true), tail.getUint32(at + 16, true)];
    if (begin + size > zip.size || size > LONGEST_LIST) return null;
    return names(await view(zip, begin, begin + size));
  }
  return null;
}

/**
 * The names of the files in each zip among some files, by the path of the zip; one whose list cannot be read is left out.
 * @param {import("./given.js").Given[]} given
 * @param {string[]} archives suffixes with their dot, in lower case
 * @returns {Promise<Map<string, string[]>>}
 */
export async function listsIn(given, archives) {
  const lists = new Map();
  for (const { path, file } of given) {
    if (!archives.some((ending) => path.toLowerCase().endsWith(ending))) continue;
    const inside = await namesIn(file).catch(() => null); // a file that cannot be read is named when it is sent
    if (inside) lists.set(path, inside);
  }
  return lists;
}

/** @param {DataView} list @returns {string[] | null} */
function names(list) {
  const encoded = [];
  const unmarked = new Set();
  for (let at = 0; at + 46 <= list.byteLength; ) {
    if (list.getUint32(at, true) !== ENTRY) return null;
    const length = list.getUint16(at + 28, true);
    if (at + 46 + length > list.byteLength) return null;
    encoded.push(new Uint8Array(list.buffer, list.byteOffset + at + 46, length));
    if (!(list.getUint16(at + 8, true) & UTF8)) unmarked.add(encoded[encoded.length - 1]);
    at += 46 + length + list.getUint16(at + 30, true) + list.getUint16(at + 32, true);
  }
  const text = new TextDecoder(ENCODINGS.find((encoding) => decodes([...unmarked], encoding)));
  const marked = new TextDecoder();
  return encoded
    .map((name) => (unmarked.has(name) ? text : marked).decode(name).replaceAll("\\", "/"))
    .filter((name) => !name.endsWith("/"));
}

/** @param {Uint8Array[]} names @param {string} encoding */
function decodes(names, encoding) {
  const text = new TextDecoder(encoding, { fatal: true });
  try {
    names.forEach((name) => text.decode(name));
  } catch {
    return false;
  }
  return true;
}

/** @param {Blob} zip @param {number} begin @param {number} end */
async function view(zip, begin, end) {
  return new DataView(await zip.slice(begin, end).arrayBuffer());
}
