// Whether a photo is a panorama of 360 by 180 degrees, as the worker decides it (images/panoramas/panoramas.py): by its XMP, or
// by its shape and edges; a test compares them.

/** Pixels of the reduced photo whose edges are compared. */
export const SIZE = [512, 256];

/** Bytes at the beginning and at the end of a file among which its XMP is looked for. */
export const XMP_BYTES = 256 << 10;

/** Difference of the outer columns, of the outer rows, and spread of the first column, as the worker has them. */
const SEAM = 2;
const POLES = 0.35;
const TEXTURED = 0.25;

const FIELD = /GPano:(\w{1,40})\s*(?:=\s*["']|>)\s*([\w.]{1,40})/g;
const FILL = "If it is a part of a panorama, fill it up to 360 by 180 degrees and mask what was filled; if it is an ordinary photo, remove its metadata (XMP).";
const WHOLE = "360-degree photo: it is cut into six views.";

/**
 * The verdict on a photo as a panorama; null where it is an ordinary photo.
 * @param {string} xmp text in which its XMP is
 * @param {number} width pixels @param {number} height
 * @param {() => Uint8ClampedArray} pixels of the photo reduced to SIZE, RGBA
 * @returns {import("./verdicts.js").Verdict | null}
 */
export function panoramaOf(xmp, width, height, pixels) {
  const fields = new Map([...xmp.matchAll(FIELD)].map(([, name, value]) => [name, value]));
  const projection = fields.get("ProjectionType");
  const isWide = Math.abs(width - 2 * height) <= 2;
  if (projection === undefined) return isWide ? byEdges(pixels()) : null;
  if (projection.toLowerCase() !== "equirectangular") {
    return { kind: "bad", text: `It is a panorama (${projection} by its metadata), which is not read: give equirectangular ones, or ordinary photos cut from it.` };
  }
  const [across, down] = ["Width", "Height"].map((side) => {
    const share = Number(fields.get(`CroppedAreaImage${side}Pixels`)) / Number(fields.get(`FullPano${side}Pixels`));
    return share > 0 && Number.isFinite(share) ? share : 1;
  });
  if (Math.min(across, down) < 0.99) {
    return { kind: "bad", text: `Its metadata says that it is a part of a panorama, ${Math.round(100 * across)}% of its width and ${Math.round(100 * down)}% of its height. ${FILL}` };
  }
  if (!isWide) return { kind: "bad", text: `Its metadata says that it is a panorama, which is twice as wide as high, and it has ${width} × ${height} pixels. ${FILL}` };
  return { kind: "good", text: WHOLE };
}

/** @param {Uint8ClampedArray} rgba @returns {import("./verdicts.js").Verdict | null} */
function byEdges(rgba) {
  const [width, height] = SIZE;
  const grey = Float64Array.from({ length: width * height }, (_, i) => 0.299 * rgba[4 * i] + 0.587 * rgba[4 * i + 1] + 0.114 * rgba[4 * i + 2]);
  const mean = (/** @type {number[]} */ values) => values.reduce((sum, value) => sum + value, 0) / values.length;
  const spread = (/** @type {number[]} */ values) => Math.sqrt(mean(values.map((value) => value ** 2)) - mean(values) ** 2);
  const middle = (/** @type {number[]} */ values) => [...values].sort((a, b) => a - b)[values.length >> 1];
  const rows = Array.from({ length: height }, (_, y) => y);
  const step = (/** @type {number} */ x, /** @type {number} */ y) => Math.abs(grey[y * width + x + 1] - grey[y * width + x]);
  const columns = Array.from({ length: width - 1 }, (_, x) => x);
  const first = rows.map((y) => grey[y * width]);
  const textured = spread(first) >= TEXTURED * spread([...grey]) && spread([...grey]) > 0;
  const seam = mean(rows.map((y) => Math.abs(grey[y * width] - grey[y * width + width - 1])));
  if (!textured || seam > SEAM * middle(columns.map((x) => mean(rows.map((y) => step(x, y)))))) return null;
  const along = rows.map((y) => mean(columns.map((x) => step(x, y))));
  return Math.max(along[0], along[height - 1]) <= POLES * middle(along) ? { kind: "good", text: WHOLE }
    : { kind: "hint", text: "Its left and right edges meet, as those of a 360-degree photo: the server decides by the others of its folder." };
}
