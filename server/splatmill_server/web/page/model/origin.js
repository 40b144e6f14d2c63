// Where a model comes from that was made of another one.

import { get, modelAddress } from "../api.js";
import { h } from "../dom.js";
import { nameOf } from "../format.js";

/**
 * A paragraph about the model that this one was made from, and what was left out; null for a model that was trained.
 * @param {any} report
 */
export async function originOf(report) {
  const { edit } = report;
  if (!edit?.model) return null;
  const first = await get(modelAddress(edit.model)).catch(() => null);
  const parts = [
    edit.box && "what lies outside of a box",
    edit.min_opacity && `Gaussians of less opacity than ${edit.min_opacity}`,
    edit.selection && "what was selected by hand",
    edit.max_size && `Gaussians larger than ${Number(edit.max_size.toPrecision(3))} units`,
  ].filter(Boolean);
  const without = parts.length > 1 ? `${parts.slice(0, -1).join(", ")} and ${parts.at(-1)}` : parts[0];
  return h("p", { class: "hint", id: "origin" }, "Made from ",
    first ? h("a", { href: `/models/${encodeURIComponent(edit.model)}` }, nameOf(first, "Model")) : "a model that was deleted",
    ` without ${without}. The training, its photos and its cameras are those of that model.`,
    (edit.box || edit.selection) && " The photos show what was left out, so they do not measure the quality of what is left.");
}
