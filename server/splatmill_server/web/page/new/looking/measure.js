// What is measured on one photo: how blurred, how dark or bright, and a hash by which nearly equal photos are found.
// Everything here is a function of pixels and runs in a worker.

/** Pixels of the longest side on which photos are measured: blur that this size does not show is not trained either. */
export const MEASURED_SIDE = 800;

/** Pixels averaged on either side by the filter of the blur measure. */
const REACH = 4;

/** Columns and rows of the hash. */
const HASH_SIDE = 16;

/** Alpha of 255 below which a pixel counts as transparent. */
const OPAQUE = 128;

/**
 * @typedef {object} Measures
 * @property {number} blur 0 (sharp) to 1
 * @property {number} dark grey level of 255 that a tenth of the pixels exceeds
 * @property {number} bright grey level of 255 that nine tenths of the pixels exceed
 * @property {Uint8Array} hash
 */

/**
 * Measure RGBA pixels.
 * @param {Uint8ClampedArray} pixels
 * @param {number} width
 * @param {number} height
 * @returns {Measures}
 */
export function measure(pixels, width, height) {
  const grey = new Float32Array(width * height);
  const counts = new Uint32Array(256);
  let opaque = 0;
  for (let i = 0; i < grey.length; i++) {
    const at = 4 * i;
    const level = 0.299 * pixels[at] + 0.587 * pixels[at + 1] + 0.114 * pixels[at + 2];
    grey[i] = level;
    if (pixels[at + 3] >= OPAQUE) {
      counts[Math.round(level)]++;
      opaque++;
    }
  }
  return {
    blur: blur(grey, width, height),
    dark: quantile(counts, opaque, 0.9),
    bright: quantile(counts, opaque, 0.1),
    hash: differenceHash(grey, width, height),
  };
}

/**
 * How blurred a picture is: how little a blur changes the differences between neighbours (Crete, Dolmiere, Ladret and
 * Nicolas 2007, "The blur effect"), the larger of both directions, because a camera that moves blurs one of them.
 *
 * The measure compares a picture with itself, so it depends less on what the picture shows than a sum of edges does.
 * @param {Float32Array} grey [height, width]
 * @param {number} width
 * @param {number} height
 */
export function blur(grey, width, height) {
  return Math.max(blurAlong(grey, height, width, width, 1), blurAlong(grey, width, height, 1, width));
}

/**
 * @param {Float32Array} grey
 * @param {number} lines
 * @param {number} length of a line
 * @param {number} nextLine distance in the array between lines
 * @param {number} next distance in the array along a line
 */
function blurAlong(grey, lines, length, nextLine, next) {
  if (length < 2 * REACH + 3) return 0;
  let own = 0;
  let lost = 0;
  for (let line = 0; line < lines; line++) {
    const begin = line * nextLine;
    let sum = 0;
    for (let i = 0; i <= 2 * REACH; i++) sum += grey[begin + i * next];
    for (let i = REACH + 1; i < length - REACH; i++) {
      const at = begin + i * next;
      const before = sum;
      sum += grey[at + REACH * next] - grey[at - (REACH + 1) * next];
      const difference = Math.abs(grey[at] - grey[at - next]);
      own += difference;
      lost += Math.max(0, difference - Math.abs(sum - before) / (2 * REACH + 1));
    }
  }
  return own > 0 ? (own - lost) / own : 1;
}

/**
 * The number of pixels of each level of a mask: of alpha where it has transparent pixels, and else of grey.
 * @param {Uint8ClampedArray} pixels RGBA
 */
export function levels(pixels) {
  const drawn = pixels.some((value, at) => at % 4 === 3 && value < 255);
  const counts = new Uint32Array(256);
  for (let at = 0; at < pixels.length; at += 4) {
    counts[drawn ? pixels[at + 3] : Math.round(0.299 * pixels[at] + 0.587 * pixels[at + 1] + 0.114 * pixels[at + 2])]++;
  }
  return counts;
}

/** @param {Uint32Array} counts of each level @param {number} total @param {number} share */
function quantile(counts, total, share) {
  let passed = 0;
  for (let level = 0; level < counts.length; level++) {
    passed += counts[level];
    if (passed > share * total) return level;
  }
  return total > 0 ? counts.length - 1 : 0;
}

/**
 * The difference hash of a picture: for each cell of a coarse grid, whether it is brighter than its neighbour.
 * @param {Float32Array} grey [height, width]
 * @param {number} width
 * @param {number} height
 * @returns {Uint8Array} one byte of 0 or 1 for each of HASH_SIDE^2 cells
 */
export function differenceHash(grey, width, height) {
  const columns = HASH_SIDE + 1;
  const sums = new Float64Array(columns * HASH_SIDE);
  const counts = new Uint32Array(columns * HASH_SIDE);
  for (let y = 0; y < height; y++) {
    const row = Math.floor((y * HASH_SIDE) / height) * columns;
    for (let x = 0; x < width; x++) {
      const cell = row + Math.floor((x * columns) / width);
      sums[cell] += grey[y * width + x];
      counts[cell]++;
    }
  }
  const hash = new Uint8Array(HASH_SIDE * HASH_SIDE);
  for (let y = 0; y < HASH_SIDE; y++) {
    for (let x = 0; x < HASH_SIDE; x++) {
      const cell = y * columns + x;
      hash[y * HASH_SIDE + x] = sums[cell] * counts[cell + 1] < sums[cell + 1] * counts[cell] ? 1 : 0;
    }
  }
  return hash;
}

/** Number of cells in which two hashes differ. @param {Uint8Array} one @param {Uint8Array} other */
export function distance(one, other) {
  let differing = 0;
  for (let i = 0; i < one.length; i++) differing += one[i] === other[i] ? 0 : 1;
  return differing;
}
