/**
 * Which Gaussians a selection holds, by their centres.
 *
 * The renderer computes the same in `render_service/selection.py`: both with the same operations in the same order, so
 * that what people see selected is what an edit leaves out.
 *
 * @typedef {object} Stroke  a line drawn on a view, as the API writes it
 * @property {number[][]} camera_to_world  pose of the view, 4x4, row by row, with OpenCV axes
 * @property {[number, number][]} points  x / z and y / z in the coordinates of the view
 * @property {number} [radius]  of the brush, in the unit of `points`; left out for a closed line
 * @property {number} [far]  largest distance along the viewing direction
 * @property {boolean} [subtract]  whether its Gaussians are taken out of the selection
 */

/** Share by which the bounds of a line are widened before what is outside of them is left out: roundings are smaller. */
const SLACK = 1e-9;

/** Gaussians of a row of the texture that holds a mask. */
export const ROW = 2048;

/**
 * The Gaussians of strokes, each added or taken out in turn.
 * @param {number} count  of all Gaussians
 * @param {{stroke: Stroke, inside: Uint32Array}[]} strokes  with the indices of the Gaussians in each
 * @param {boolean} inverted  whether all others are meant
 * @returns {{mask: Uint8Array, selected: number}}  255 for each Gaussian that is selected, padded to whole rows
 */
export function maskOf(count, strokes, inverted) {
  const mask = new Uint8Array(ROW * Math.ceil(count / ROW));
  for (const { stroke, inside } of strokes) for (const index of inside) mask[index] = stroke.subtract ? 0 : 255;
  let selected = 0;
  for (let index = 0; index < count; index++) {
    if (inverted) mask[index] = 255 - mask[index];
    if (mask[index]) selected++;
  }
  return { mask, selected };
}

/**
 * The indices of the Gaussians whose centres a stroke holds.
 * @param {Float32Array} centers  x, y and z in turn
 * @param {Stroke} stroke
 */
export function within(centers, { camera_to_world: m, points, radius, far = Infinity }) {
  const [lowU, highU] = boundsOf(points.map(([u]) => u), radius);
  const [lowV, highV] = boundsOf(points.map(([, v]) => v), radius);
  const inside = [];
  for (let i = 0; i < centers.length / 3; i++) {
    const x = centers[3 * i] - m[0][3];
    const y = centers[3 * i + 1] - m[1][3];
    const z = centers[3 * i + 2] - m[2][3];
    const depth = x * m[0][2] + y * m[1][2] + z * m[2][2];
    if (!(depth > 0 && depth <= far)) continue;
    const u = (x * m[0][0] + y * m[1][0] + z * m[2][0]) / depth;
    const v = (x * m[0][1] + y * m[1][1] + z * m[2][1]) / depth;
    if (!(u >= lowU && u <= highU && v >= lowV && v <= highV)) continue;
    if (radius === undefined ? isInside(u, v, points) : isBrushed(u, v, points, radius)) inside.push(i);
  }
  return Uint32Array.from(inside);
}

/** The least and greatest coordinate that a line holds. @param {number[]} values @param {number} [radius] @returns {[number, number]} */
function boundsOf(values, radius = 0) {
  const [low, high] = [Math.min(...values), Math.max(...values)];
  const reach = radius + SLACK * (radius + Math.max(Math.abs(low), Math.abs(high)));
  return [low - reach, high + reach];
}

/** Whether a point lies in a closed line, by the even-odd rule. @param {number} u @param {number} v @param {[number, number][]} line */
function isInside(u, v, line) {
  let inside = false;
  for (let i = 0; i < line.length; i++) {
    const [au, av] = line[i];
    const [bu, bv] = line[(i + 1) % line.length];
    if (v < Math.min(av, bv) || v >= Math.max(av, bv)) continue;
    if (u < (bu - au) * (v - av) / (bv - av) + au) inside = !inside;
  }
  return inside;
}

/** Whether a point is at most `radius` from a line. @param {number} u @param {number} v @param {[number, number][]} line @param {number} radius */
function isBrushed(u, v, line, radius) {
  for (let i = 0; i < Math.max(1, line.length - 1); i++) {
    const [au, av] = line[i];
    const [bu, bv] = line[Math.min(i + 1, line.length - 1)];
    const [du, dv, pu, pv] = [bu - au, bv - av, u - au, v - av];
    const square = du * du + dv * dv;
    const along = square > 0 ? Math.min(1, Math.max(0, (pu * du + pv * dv) / square)) : 0;
    const [qu, qv] = [pu - along * du, pv - along * dv];
    if (qu * qu + qv * qv <= radius * radius) return true;
  }
  return false;
}
