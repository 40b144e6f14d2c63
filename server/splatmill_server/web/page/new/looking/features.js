// Corners of a small picture with binary descriptors, by which pictures of the same place are recognised.
//
// Corners by the smaller eigenvalue of the gradients (Shi and Tomasi, 1994) on three sizes of the picture, spread over it;
// descriptors by comparisons of pixels in a pattern turned to the corner's direction (Rublee and others, 2011, "ORB").

/** Sizes of the picture on which corners are found, over its own. */
const SIZES = [1, 0.7, 0.5];
/** Corners of each size, and cells along a side over which they are spread. */
const CORNERS = 140;
const CELLS = 8;
/** Pixels around a corner that its descriptor compares. */
const REACH = 12;
const WORDS = 8; // of 32 bits

/**
 * @typedef {object} Features
 * @property {Float32Array} places  x and y in turn, over the longer side of the picture
 * @property {Float32Array} sizes  of the picture on which each was found
 * @property {Float32Array} angles  direction of each, radians
 * @property {Uint32Array} bits  descriptors, WORDS words each
 */

/** Pairs of places in a disc of REACH pixels, the same on every run. */
const PATTERN = pattern();

/**
 * The features of a picture.
 * @param {Float32Array} grey [height, width]
 * @param {number} width @param {number} height
 * @returns {Features}
 */
export function featuresOf(grey, width, height) {
  /** @type {{x: number, y: number, size: number, angle: number, bits: Uint32Array}[]} */
  const all = [];
  const side = Math.max(width, height);
  for (const size of SIZES) {
    const [w, h] = [Math.round(width * size), Math.round(height * size)];
    if (Math.min(w, h) < 3 * REACH) continue;
    const level = smoothed(size === 1 ? grey : resized(grey, width, height, w, h), w, h);
    for (const [x, y] of corners(level, w, h)) {
      const angle = direction(level, w, x, y);
      all.push({ x: x / size / side, y: y / size / side, size, angle, bits: describe(level, w, x, y, angle) });
    }
  }
  const bits = new Uint32Array(WORDS * all.length);
  all.forEach((one, index) => bits.set(one.bits, WORDS * index));
  return {
    places: Float32Array.from(all.flatMap(({ x, y }) => [x, y])), bits,
    sizes: Float32Array.from(all, ({ size }) => size), angles: Float32Array.from(all, ({ angle }) => angle),
  };
}

/** @param {Float32Array} grey @param {number} width @param {number} height @param {number} w @param {number} h */
function resized(grey, width, height, w, h) {
  const small = new Float32Array(w * h);
  const soft = smoothed(grey, width, height);
  for (let y = 0; y < h; y++) {
    const fy = Math.min(height - 1.001, Math.max(0, ((y + 0.5) * height) / h - 0.5));
    const y0 = Math.floor(fy);
    for (let x = 0; x < w; x++) {
      const fx = Math.min(width - 1.001, Math.max(0, ((x + 0.5) * width) / w - 0.5));
      const x0 = Math.floor(fx);
      const at = y0 * width + x0;
      const [tx, ty] = [fx - x0, fy - y0];
      small[y * w + x] = (1 - ty) * ((1 - tx) * soft[at] + tx * soft[at + 1]) + ty * ((1 - tx) * soft[at + width] + tx * soft[at + width + 1]);
    }
  }
  return small;
}

/** The picture under a binomial filter of 3 x 3. @param {Float32Array} grey @param {number} w @param {number} h */
function smoothed(grey, w, h) {
  const across = new Float32Array(w * h);
  const soft = new Float32Array(w * h);
  for (let y = 0; y < h; y++) {
    for (let x = 0; x < w; x++) {
      const at = y * w + x;
      across[at] = (grey[x > 0 ? at - 1 : at] + 2 * grey[at] + grey[x < w - 1 ? at + 1 : at]) / 4;
    }
  }
  for (let at = 0; at < w * h; at++) soft[at] = (across[at >= w ? at - w : at] + 2 * across[at] + across[at < w * (h - 1) ? at + w : at]) / 4;
  return soft;
}

/** The strongest corners, spread over the picture. @param {Float32Array} grey @param {number} w @param {number} h @returns {[number, number][]} */
function corners(grey, w, h) {
  const [xx, yy, xy] = [0, 0, 0].map(() => new Float32Array(w * h));
  for (let y = 1; y < h - 1; y++) {
    for (let x = 1; x < w - 1; x++) {
      const at = y * w + x;
      const dx = grey[at + 1] - grey[at - 1];
      const dy = grey[at + w] - grey[at - w];
      xx[at] = dx * dx;
      yy[at] = dy * dy;
      xy[at] = dx * dy;
    }
  }
  const [sxx, syy, sxy] = [xx, yy, xy].map((sums) => smoothed(smoothed(sums, w, h), w, h));
  const strength = new Float32Array(w * h);
  for (let at = 0; at < w * h; at++) {
    const half = (sxx[at] - syy[at]) / 2;
    strength[at] = (sxx[at] + syy[at]) / 2 - Math.sqrt(half * half + sxy[at] * sxy[at]);
  }
  /** @type {{x: number, y: number, s: number}[][]} */
  const cells = Array.from({ length: CELLS * CELLS }, () => []);
  for (let y = REACH + 2; y < h - REACH - 2; y++) {
    for (let x = REACH + 2; x < w - REACH - 2; x++) {
      const at = y * w + x;
      const s = strength[at];
      if (!(s > 4)) continue; // flat: noise of a few grey levels
      let most = true;
      for (let j = -2; j <= 2 && most; j++) for (let i = -2; i <= 2; i++) if (strength[at + j * w + i] > s) most = false;
      if (most) cells[Math.floor((y * CELLS) / h) * CELLS + Math.floor((x * CELLS) / w)].push({ x, y, s });
    }
  }
  for (const cell of cells) cell.sort((a, b) => b.s - a.s);
  /** @type {[number, number][]} */
  const chosen = [];
  for (let rank = 0; chosen.length < CORNERS; rank++) {
    const row = cells.flatMap((cell) => (cell[rank] ? [cell[rank]] : [])).sort((a, b) => b.s - a.s);
    if (!row.length) break;
    for (const { x, y } of row.slice(0, CORNERS - chosen.length)) chosen.push([x, y]);
  }
  return chosen;
}

/** The direction from a corner to the centroid of the brightness around it. @param {Float32Array} grey @param {number} w @param {number} x @param {number} y */
function direction(grey, w, x, y) {
  let [mx, my] = [0, 0];
  for (let j = -REACH; j <= REACH; j++) {
    const wide = Math.floor(Math.sqrt(REACH * REACH - j * j));
    for (let i = -wide; i <= wide; i++) {
      const level = grey[(y + j) * w + x + i];
      mx += i * level;
      my += j * level;
    }
  }
  return Math.atan2(my, mx);
}

/** @param {Float32Array} grey @param {number} w @param {number} x @param {number} y @param {number} angle */
function describe(grey, w, x, y, angle) {
  const bits = new Uint32Array(WORDS);
  const [c, s] = [Math.cos(angle), Math.sin(angle)];
  const at = (/** @type {number} */ k) => grey[(y + Math.round(s * PATTERN[k] + c * PATTERN[k + 1])) * w + x + Math.round(c * PATTERN[k] - s * PATTERN[k + 1])];
  for (let bit = 0; bit < 32 * WORDS; bit++) if (at(4 * bit) < at(4 * bit + 2)) bits[bit >> 5] |= 1 << (bit & 31);
  return bits;
}

function pattern() {
  const places = new Float32Array(4 * 32 * WORDS);
  let seed = 1;
  const next = () => (seed = (seed * 48271) % 0x7fffffff) / 0x7fffffff;
  for (let k = 0; k < places.length; k += 2) {
    // Nearer to the corner more often: what lies there changes least with the view.
    const radius = (REACH - 0.5) * Math.sqrt(next()) * (0.5 + 0.5 * next());
    const angle = 2 * Math.PI * next();
    places[k] = radius * Math.cos(angle);
    places[k + 1] = radius * Math.sin(angle);
  }
  return places;
}
