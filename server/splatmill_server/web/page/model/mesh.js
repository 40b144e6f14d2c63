// Meshes: made by the server in the background, kept with the model, and saved.

import { h } from "../dom.js";
import { bytes, number } from "../format.js";
import { keptOf } from "./kept.js";

/**
 * @import {Shown} from "./model.js"
 * @import {Stage} from "./stage.js"
 */

const FACES = [100_000, 500_000, 2_000_000];
const TEXTURES = [2048, 4096];

/**
 * @param {HTMLElement} section
 * @param {Shown} shown
 * @param {Stage} stage
 */
export async function showMesh(section, { model, address }, stage) {
  const format = h("select", { id: "mesh-format", onchange: () => (colors.disabled = format.value !== "glb") },
    h("option", { value: "glb" }, ".glb, for Blender and the web"), h("option", { value: "ply" }, ".ply, for MeshLab and CloudCompare"));
  const faces = h("select", { id: "mesh-faces" }, FACES.map((count) => h("option", { value: count, selected: count === 500_000 }, number(count))));
  const colors = h("select", { id: "mesh-colors", onchange: () => { if (colors.value) faces.value = String(FACES[0]); } },
    h("option", { value: "" }, "of the corners"), TEXTURES.map((side) => h("option", { value: side }, `a texture of ${number(side)} pixels`)));
  const box = h("input", { type: "checkbox", id: "mesh-box" });
  const make = h("button", { type: "button", onclick: start }, "Make a mesh");
  const { stop, state, place, kept, begin, open } = keptOf(address, "meshes", make, {
    progress: ({ progress }) => {
      const count = progress?.total ? `, ${progress.done} of ${progress.total}` : "";
      return `${progress ? progress.stage : "waiting"}${count}. This takes some minutes; the server continues if this page is closed.`;
    },
    failure: ({ detail, advice }) => `${detail} ${advice ?? ""}`,
    entry: (mesh) => {
      const name = `.${mesh.request.format}, ${number(mesh.facts.triangles)} triangles${mesh.request.texture ? " with a texture" : ""}${mesh.request.box ? " of a box" : ""}, ${bytes(mesh.bytes)}`;
      const download = `${model.name || model.id}-mesh.${mesh.request.format}`;
      return { name: `the mesh ${name}`, use: h("a", { class: "button quiet", href: mesh.links.file, download }, `Save ${name}`) };
    },
  });

  async function start() {
    place.replaceChildren();
    if (box.checked && !(stage.edit.on && stage.edit.crop.checked)) {
      state.textContent = "There is no box yet: open Crop and clean above, and move its sides.";
      stage.edit.button.focus();
      return;
    }
    await begin({
      format: format.value, faces: Number(faces.value),
      ...(colors.value && !colors.disabled ? { texture: Number(colors.value) } : {}),
      ...(box.checked ? { box: stage.edit.box } : {}),
    });
  }

  section.append(h("h2", { id: "mesh-title" }, "Mesh"),
    h("p", { class: "muted" }, "Triangles with colours, for programs that show no splats: the surfaces on which the photos agree."),
    h("div", { class: "row" },
      h("div", { class: "field" }, h("label", { for: "mesh-format" }, "File"), format),
      h("div", { class: "field" }, h("label", { for: "mesh-colors" }, "Colours"), colors),
      h("div", { class: "field" }, h("label", { for: "mesh-faces" }, "Most triangles"), faces)),
    h("label", { class: "row", for: "mesh-box" }, box, "Only what lies in the box of Crop and clean"),
    h("div", { class: "row" }, make, stop), state, place, kept);
  await open();
}
