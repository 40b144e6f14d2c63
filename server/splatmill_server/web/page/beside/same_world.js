// Whether two models lie in the same coordinates: their photos were taken from the same places.

/** Largest distance between the places of one photo in both models, over the distance between its own model's photos. */
const CLOSE = 0.01;

/**
 * @param {any[]} one cameras of a model's photos, with `name` and `camera`
 * @param {any[]} other
 */
export function sameWorld(one, other) {
  const places = new Map(other.map(({ name, camera }) => [name, place(camera)]));
  const common = one.flatMap(({ name, camera }) => {
    const its = places.get(name);
    return its ? [[place(camera), its]] : [];
  });
  if (common.length < 2) return false;
  const first = common[0][0];
  const spread = Math.max(...common.map(([own]) => apart(own, first)));
  return common.every(([own, its]) => apart(own, its) <= CLOSE * spread);
}

/** @param {any} camera @returns {number[]} */
function place(camera) {
  return [0, 1, 2].map((axis) => camera.camera_to_world[axis][3]);
}

/** @param {number[]} one @param {number[]} other */
function apart(one, other) {
  return Math.hypot(...one.map((value, axis) => value - other[axis]));
}
