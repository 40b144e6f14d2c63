/**
 * Cameras of the viewer: poses with OpenCV axes (x right, y down, z forward), in the coordinates of the model.
 *
 * @typedef {[number, number, number]} Vec
 * @typedef {{right: Vec, down: Vec, forward: Vec, position: Vec}} Pose  the columns of a camera-to-world matrix
 * @typedef {Object} Camera  a camera as the API writes it: its pose, its size in pixels, and its projection
 * @property {number[][]} camera_to_world  4x4, row by row
 * @property {number} width
 * @property {number} height
 * @property {number | null} [fov_y_deg]  vertical field of view in degrees, in place of fx, fy, cx and cy
 * @property {number | null} [fx]
 * @property {number | null} [fy]
 * @property {number | null} [cx]
 * @property {number | null} [cy]
 * @property {string} [convention]  opencv (where it is left out) or opengl
 */

/** @param {Vec} a @param {Vec} b @returns {Vec} */
export const add = (a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
/** @param {Vec} a @param {Vec} b @returns {Vec} */
export const sub = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
/** @param {Vec} a @param {number} s @returns {Vec} */
export const times = (a, s) => [a[0] * s, a[1] * s, a[2] * s];
/** @param {Vec} a @param {Vec} b */
export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
/** @param {Vec} a @param {Vec} b @returns {Vec} */
export const cross = (a, b) => [
  a[1] * b[2] - a[2] * b[1],
  a[2] * b[0] - a[0] * b[2],
  a[0] * b[1] - a[1] * b[0],
];
/** @param {Vec} a */
export const length = (a) => Math.hypot(a[0], a[1], a[2]);
/** @param {Vec} a @param {Vec} otherwise  @returns {Vec} */
export const unit = (a, otherwise = [0, 0, 1]) => (length(a) > 1e-12 ? times(a, 1 / length(a)) : otherwise);
/** @param {Vec[]} points @returns {Vec} */
export const mean = (points) =>
  times(points.reduce(add, /** @type {Vec} */ ([0, 0, 0])), 1 / Math.max(1, points.length));

/**
 * A vector turned about a unit axis (Rodrigues' formula).
 * @param {Vec} v @param {Vec} axis @param {number} angle  radians
 */
export function turned(v, axis, angle) {
  const c = Math.cos(angle);
  return add(
    add(times(v, c), times(cross(axis, v), Math.sin(angle))),
    times(axis, dot(axis, v) * (1 - c)),
  );
}

/**
 * The pose of a camera of the API.
 * @param {Camera} camera
 * @returns {Pose}
 */
export function poseOf(camera) {
  const m = camera.camera_to_world;
  const sign = camera.convention === "opengl" ? -1 : 1;
  /** @param {number} j @param {number} s @returns {Vec} */
  const column = (j, s) => [s * m[0][j], s * m[1][j], s * m[2][j]];
  return {
    right: column(0, 1),
    down: column(1, sign),
    forward: column(2, sign),
    position: column(3, 1),
  };
}

/**
 * The camera-to-world matrix of a pose, row by row.
 * @param {Pose} pose
 */
export function matrixOf({ right, down, forward, position }) {
  return [0, 1, 2].map((i) => [right[i], down[i], forward[i], position[i]]).concat([[0, 0, 0, 1]]);
}

/**
 * Half the width and half the height that a camera sees at distance 1.
 * @param {Camera} camera
 * @returns {{x: number, y: number}}
 */
export function tangentsOf(camera) {
  if (typeof camera.fov_y_deg === "number") {
    const y = Math.tan((camera.fov_y_deg * Math.PI) / 360);
    return { x: (y * camera.width) / camera.height, y };
  }
  return { x: camera.width / (2 * (camera.fx ?? 1)), y: camera.height / (2 * (camera.fy ?? 1)) };
}

/**
 * An upright pose at `eye` that faces `target`.
 * @param {Vec} eye @param {Vec} target @param {Vec} up
 * @returns {Pose}
 */
export function lookingAt(eye, target, up) {
  const forward = unit(sub(target, eye));
  const side = cross(forward, up);
  const right = unit(length(side) > 1e-6 ? side : cross(forward, anyNormal(forward)));
  return { right, down: cross(forward, right), forward, position: eye };
}

/** @param {Vec} v @returns {Vec} */
function anyNormal(v) {
  const least = v.map(Math.abs).indexOf(Math.min(...v.map(Math.abs)));
  return unit(cross(v, /** @type {Vec} */ ([0, 1, 2].map((i) => (i === least ? 1 : 0)))));
}

/**
 * A pose turned about an axis through a point.
 * @param {Pose} pose @param {Vec} pivot @param {Vec} axis @param {number} angle  radians
 * @returns {Pose}
 */
export function turnedAbout(pose, pivot, axis, angle) {
  const forward = unit(turned(pose.forward, axis, angle));
  const right = unit(cross(turned(pose.down, axis, angle), forward));
  return {
    right,
    down: cross(forward, right),
    forward,
    position: add(pivot, turned(sub(pose.position, pivot), axis, angle)),
  };
}

/**
 * Where a pose sees a point: pixels from the upper left corner, and the depth, which is not positive behind the camera.
 * @param {Pose} pose @param {Vec} point @param {number} focal  in pixels
 * @param {number} width @param {number} height  of the picture, in pixels
 */
export function projected(pose, point, focal, width, height) {
  const offset = sub(point, pose.position);
  const depth = dot(offset, pose.forward);
  return {
    x: width / 2 + (focal * dot(offset, pose.right)) / depth,
    y: height / 2 + (focal * dot(offset, pose.down)) / depth,
    depth,
  };
}

/**
 * What the cameras of the photos tell about a scene.
 *
 * up: what is known to be up, or the mean of the directions that are up in the photos.
 * focus: the origin where up is known and most cameras have the origin ahead; else the point nearest to all optical
 *   axes (least squares), or where these are almost parallel, or meet behind the cameras, a point in front of the
 *   cameras' mean position.
 * middle: the mean position.
 * spread: the distance of the farthest camera from it.
 *
 * @param {Camera[]} cameras  at least one
 * @param {Vec | null} [known]
 */
export function surroundings(cameras, known) {
  const poses = cameras.map(poseOf);
  const middle = mean(poses.map((pose) => pose.position));
  const ahead = unit(mean(poses.map((pose) => pose.forward)), poses[0].forward);
  const distances = poses.map((pose) => length(sub(pose.position, middle)));
  const spread = Math.max(...distances);
  /** @type {Vec} */
  const origin = [0, 0, 0];
  const focus = known && inFront(poses, origin) ? origin : nearestToAxes(poses) ?? add(middle, times(ahead, 3 * (spread || 1)));
  const up = known ?? unit(times(mean(poses.map((pose) => pose.down)), -1), [0, -1, 0]);
  return { up, focus, middle, spread };
}

/** Radius of the dense middle, in median distances from its centre: far shells lie outside of it. */
const MIDDLE = 4;

/** Points from which the dense middle is found, at most. */
const MOST_POINTS = 50_000;

/**
 * The dense middle of a scene without cameras: the median point, and the distance from there within which 95 % of the
 * points lie that are no more than MIDDLE median distances away.
 *
 * @param {ArrayLike<number>} points  x, y and z in turn, of at least one point
 */
export function denseMiddle(points) {
  const count = points.length / 3;
  const step = Math.ceil(count / MOST_POINTS);
  /** @type {Vec[]} */
  const some = [];
  for (let i = 0; i < count; i += step) some.push([points[3 * i], points[3 * i + 1], points[3 * i + 2]]);
  /** @param {number[]} values @param {number} share */
  const quantile = (values, share) => values.sort((a, b) => a - b)[Math.min(values.length - 1, Math.floor(share * values.length))];
  /** @param {number} axis */
  const median = (axis) => quantile(some.map((point) => point[axis]), 0.5);
  /** @type {Vec} */
  const focus = [median(0), median(1), median(2)];
  const distances = some.map((point) => length(sub(point, focus)));
  const most = MIDDLE * quantile(distances, 0.5);
  return { focus, reach: quantile(distances.filter((distance) => distance <= most), 0.95) || 1 };
}

/**
 * The point nearest to all optical axes; null where it is not well defined or not in front of most cameras.
 * @param {Pose[]} poses
 * @returns {Vec | null}
 */
function nearestToAxes(poses) {
  // Normal equations: the sum of (I - d d^T) (p - c) over the cameras is zero.
  const a = [0, 1, 2].map(() => [0, 0, 0]);
  const b = [0, 0, 0];
  for (const { forward: d, position: c } of poses) {
    for (let i = 0; i < 3; i++) {
      for (let j = 0; j < 3; j++) {
        const entry = (i === j ? 1 : 0) - d[i] * d[j];
        a[i][j] += entry / poses.length;
        b[i] += (entry * c[j]) / poses.length;
      }
    }
  }
  const [r0, r1, r2] = /** @type {Vec[]} */ (a);
  const det = dot(r0, cross(r1, r2));
  // 4/27 for axes in all directions, 0 for parallel ones.
  if (!(Math.abs(det) > 1e-4)) return null;
  const [b0, b1, b2] = b;
  const point = times(
    add(add(times(cross(r1, r2), b0), times(cross(r2, r0), b1)), times(cross(r0, r1), b2)),
    1 / det,
  );
  return inFront(poses, point) ? point : null;
}

/** Whether most cameras have a point ahead of them. @param {Pose[]} poses @param {Vec} point */
function inFront(poses, point) {
  return 2 * poses.filter((pose) => dot(sub(point, pose.position), pose.forward) > 0).length > poses.length;
}
