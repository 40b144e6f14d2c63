/**
 * Lengths in the unit that people have set for a model.
 *
 * @import {Vec} from "./pose.js"
 * @typedef {{factor: number, unit: string}} Scale  factor: length in the unit of 1 in the model
 * @typedef {{points: [Vec, Vec], name?: string | null}} Measurement
 */
import { length, sub } from "./pose.js";

/** A length in the unit of a scale, or in units of the model. @param {number} units @param {Scale | null} [scale] */
export function lengthText(units, scale) {
  const value = Number((scale ? units * scale.factor : units).toPrecision(3));
  return `${value.toLocaleString("en", { maximumFractionDigits: 6 })} ${scale?.unit ?? "units"}`;
}

/** The lines of measurements, as the overlay draws them. @param {Measurement[]} measurements @param {Scale | null} [scale] */
export function measuredLines(measurements, scale) {
  return measurements.map(({ points, name }) => {
    const text = lengthText(length(sub(points[0], points[1])), scale);
    return { points: [...points], label: name ? `${name}: ${text}` : text };
  });
}
