/**
 * Distances rendered by the server: asking for them, reading them, and showing them as colours.
 *
 * @import {Pose} from "./pose.js"
 */
import { matrixOf } from "./pose.js";

/**
 * How far ahead a stored model is at a place of a view, which the server renders as one pixel; null where nothing is.
 * @param {string} model  address of the model, as /v1/models/{id}
 * @param {Pose} pose @param {number} dx @param {number} dy  of the place, at distance 1 @param {number} focal  pixels
 * @returns {Promise<number | null>}  throws an Error with the server's reason
 */
export async function depthOfPixel(model, pose, dx, dy, focal) {
  const camera = { width: 1, height: 1, fx: focal, fy: focal, cx: 0.5 - dx * focal, cy: 0.5 - dy * focal };
  const fields = { ...camera, camera_to_world: matrixOf(pose).flat().join(","), output: "depth", format: "npy" };
  const query = new URLSearchParams(Object.entries(fields).map(([name, value]) => [name, `${value}`]));
  const answer = await fetch(`${model}/render?${query}`).catch(() => null);
  if (!answer) throw new Error("The server could not be reached for the distance.");
  if (!answer.ok) {
    const problem = await answer.json().catch(() => ({}));
    throw new Error(problem.detail ?? `The server answered ${answer.status} in place of the distance.`);
  }
  const [depth] = readArray(await answer.arrayBuffer()).data;
  return depth > 0 ? depth : null;
}

/**
 * Read an array of float32 in NumPy's format, version 1, in C order.
 * @param {ArrayBuffer} bytes
 * @returns {{data: Float32Array, shape: number[]}}
 */
export function readArray(bytes) {
  const view = new DataView(bytes);
  const start = 10 + view.getUint16(8, true);
  const header = new TextDecoder("latin1").decode(new Uint8Array(bytes, 10, start - 10));
  const shape = /'shape': \(([^)]*)\)/.exec(header)?.[1].split(",").filter((n) => n.trim()).map(Number);
  if (!header.includes("'<f4'") || header.includes("'fortran_order': True") || !shape) {
    throw new Error(`The server sent an array of another kind than float32: ${header.trim()}.`);
  }
  return { data: new Float32Array(bytes.slice(start)), shape };
}

/** Colours from near to far, RGB: from light yellow over red to dark violet, even in lightness. */
const SCALE = [
  [252, 253, 191], [254, 176, 120], [241, 96, 93], [183, 55, 121], [114, 31, 129], [44, 17, 95], [12, 8, 38],
]; // prettier-ignore

/**
 * The colours of distances, by their inverse, so that near things have most of the scale. Pixels at which nothing was
 * hit are transparent.
 * @param {Float32Array} depth  0 where nothing was hit
 */
export function depthColors(depth) {
  const hit = depth.filter((z) => z > 0).sort();
  // Two in a hundred at either end do not count: a single Gaussian close to the camera would take the whole scale.
  const near = hit[Math.floor(0.02 * hit.length)] ?? 1;
  const far = Math.max(hit[Math.floor(0.98 * hit.length)] ?? 1, near * 1.0001);
  const pixels = new Uint8ClampedArray(4 * depth.length);
  for (let i = 0; i < depth.length; i++) {
    if (!(depth[i] > 0)) continue;
    const share = Math.min(1, Math.max(0, (1 / near - 1 / depth[i]) / (1 / near - 1 / far)));
    const at = share * (SCALE.length - 1);
    const from = Math.min(SCALE.length - 2, Math.floor(at));
    for (let c = 0; c < 3; c++) {
      pixels[4 * i + c] = SCALE[from][c] + (at - from) * (SCALE[from + 1][c] - SCALE[from][c]);
    }
    pixels[4 * i + 3] = 255;
  }
  return { pixels, near, far };
}

/** The colour scale as a CSS gradient, from near to far. */
export const GRADIENT = `linear-gradient(to right, ${SCALE.map((rgb) => `rgb(${rgb.join(" ")})`).join(", ")})`;
