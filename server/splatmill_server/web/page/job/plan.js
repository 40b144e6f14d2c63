// The plan of a training in the sentences that it brings: each decision with the fact behind it, and what was left out.

import { h } from "../dom.js";
import { number } from "../format.js";

const NOT_DECISIONS = ["reasons", "left_out", "forced", "schedule", "seed"];

/** @param {any} plan @returns {HTMLElement[]} */
export function planParts(plan) {
  const reasons = plan.reasons ?? {};
  const names = [...new Set([...Object.keys(reasons), ...Object.keys(plan).filter((name) => !NOT_DECISIONS.includes(name))])];
  const decided = names.map((name) => [name, value(plan, name), reasons[name] ?? ""]).filter(([, shown, why]) => shown || why);
  const left = Object.entries(plan.left_out ?? {});
  return [
    h("dl", { class: "decisions" }, decided.flatMap(([name, shown, why]) => [
      h("dt", {}, words(name), shown && h("span", { class: "number" }, `: ${shown}`)), h("dd", {}, why)])),
    ...(left.length
      ? [h("h3", {}, "Left out, and why"),
        h("dl", { class: "decisions" }, left.flatMap(([name, why]) => [h("dt", {}, words(name)), h("dd", {}, String(why))]))]
      : []),
  ];
}

/** @param {any} plan @param {string} name */
function value(plan, name) {
  const decided = name === "sh_degree" ? plan.schedule?.degree : plan[name];
  if (decided === true) return "yes";
  if (typeof decided === "number") return Number.isInteger(decided) ? number(decided) : String(Number(decided.toPrecision(4)));
  return typeof decided === "string" ? decided : "";
}

/** @param {string} name */
function words(name) {
  return name.replaceAll("_", " ");
}
