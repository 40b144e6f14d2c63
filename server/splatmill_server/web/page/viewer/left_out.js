/**
 * What an edit would leave out of a model, as a modifier of PlayCanvas' work buffer: dimmed, or not drawn. What was
 * selected on views is tinted in place of dimmed.
 *
 * @import {Vec} from "./pose.js"
 * @typedef {object} LeftOut
 * @property {{min: Vec, max: Vec} | null} box  Gaussians with their centre outside are left out
 * @property {number} opacity  Gaussians of less are left out
 * @property {number} size  Gaussians with a larger standard deviation along any axis are left out
 * @property {Uint8Array | null} [mask]  255 for each Gaussian that was selected, in rows of ROW
 * @property {boolean} hidden  whether what is left out is not drawn
 */

import { ROW } from "./selection.js";

/** Share of the opacity that is left to what is dimmed. */
const DIMMED = 0.25;
/** A length that no model reaches. */
const FAR = 1e30;

export const MODIFIER = `
uniform vec3 left_out_min;
uniform vec3 left_out_max;
uniform vec3 left_out_limits;
uniform sampler2D left_out_mask;
void modifySplatCenter(inout vec3 center) {
}
void modifySplatRotationScale(vec3 originalCenter, vec3 modifiedCenter, inout vec4 rotation, inout vec3 scale) {
}
void modifySplatColor(vec3 center, inout vec4 color) {
  ivec2 place = ivec2(int(splat.index) % ${ROW}, int(splat.index) / ${ROW});
  if (place.y < textureSize(left_out_mask, 0).y && texelFetch(left_out_mask, place, 0).r > 0.5) {
    color = left_out_limits.z > 0.0 ? vec4(mix(color.rgb, vec3(1.0, 0.35, 0.1), 0.75), color.a) : vec4(0.0);
    return;
  }
  vec3 size = getScale();
  bool outside = any(lessThan(center, left_out_min)) || any(greaterThan(center, left_out_max));
  if (outside || color.a < left_out_limits.x || max(size.x, max(size.y, size.z)) > left_out_limits.y) {
    color = vec4(vec3(0.4 * dot(color.rgb, vec3(0.3, 0.6, 0.1))), color.a * left_out_limits.z);
  }
}
`;

/** The uniforms of the modifier. @param {LeftOut} limits */
export function parametersOf({ box, opacity, size, hidden }) {
  return {
    left_out_min: box?.min ?? [-FAR, -FAR, -FAR],
    left_out_max: box?.max ?? [FAR, FAR, FAR],
    left_out_limits: [opacity, Math.min(size, FAR), hidden ? 0 : DIMMED],
  };
}
