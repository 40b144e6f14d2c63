// How many features two pictures share, each with a place that fits those of the others.

/** @import {Features} from "./features.js" */

const WORDS = 8; // of a descriptor
/** Bits of 256 in which descriptors of one place differ at most, and how much nearer the best has to be than the next. */
const MOST_BITS = 72;
const RATIO = 0.85;
/** How far a place may lie from where a match moves it, over the longer side; views of a scene are not flat. */
const TOLERANCE = 0.08;
/** Factor by which sizes, and radians by which directions may differ. */
const SIZE = 1.6;
const TURN = 0.5;

/** @param {number} v */
function ones(v) {
  v -= (v >>> 1) & 0x55555555;
  v = (v & 0x33333333) + ((v >>> 2) & 0x33333333);
  return (((v + (v >>> 4)) & 0x0f0f0f0f) * 0x01010101) >>> 24;
}

/**
 * The number of features that agree on how one picture lies on the other.
 * @param {Features} one @param {Features} other
 */
export function shared(one, other) {
  const pairs = matched(one, other);
  let most = 0;
  for (const [i, j] of pairs) {
    const factor = one.sizes[i] / other.sizes[j];
    const turn = other.angles[j] - one.angles[i];
    const [c, s] = [factor * Math.cos(turn), factor * Math.sin(turn)];
    let fits = 0;
    for (const [k, l] of pairs) {
      const [x, y] = [one.places[2 * k] - one.places[2 * i], one.places[2 * k + 1] - one.places[2 * i + 1]];
      const dx = other.places[2 * j] + c * x - s * y - other.places[2 * l];
      const dy = other.places[2 * j + 1] + s * x + c * y - other.places[2 * l + 1];
      const size = one.sizes[k] / other.sizes[l] / factor;
      const angle = Math.abs(Math.atan2(Math.sin(other.angles[l] - one.angles[k] - turn), Math.cos(other.angles[l] - one.angles[k] - turn)));
      if (Math.hypot(dx, dy) < TOLERANCE && size < SIZE && size > 1 / SIZE && angle < TURN) fits++;
    }
    most = Math.max(most, fits);
  }
  return most;
}

/** Features that are each other's nearest, clearly. @param {Features} one @param {Features} other @returns {[number, number][]} */
function matched(one, other) {
  const [n, m] = [one.sizes.length, other.sizes.length];
  const nearest = new Int32Array(n).fill(-1);
  const best = new Int32Array(n).fill(999);
  const next = new Int32Array(n).fill(999);
  const back = new Int32Array(m).fill(-1);
  const backBest = new Int32Array(m).fill(999);
  for (let i = 0; i < n; i++) {
    for (let j = 0; j < m; j++) {
      let d = 0;
      for (let k = 0; k < WORDS; k++) d += ones(one.bits[WORDS * i + k] ^ other.bits[WORDS * j + k]);
      if (d < best[i]) {
        // The same corner on another size of the picture is no rival.
        next[i] = best[i];
        best[i] = d;
        nearest[i] = j;
      } else if (d < next[i]) next[i] = d;
      if (d < backBest[j]) {
        backBest[j] = d;
        back[j] = i;
      }
    }
  }
  /** @type {[number, number][]} */
  const pairs = [];
  for (let i = 0; i < n; i++) {
    const j = nearest[i];
    if (j >= 0 && back[j] === i && best[i] <= MOST_BITS && best[i] <= RATIO * next[i]) pairs.push([i, j]);
  }
  return pairs;
}
