// Meshes: made by the server in the background, kept with the model, and saved.

import { get, request, send } from "../api.js";
import { h } from "../dom.js";
import { bytes, number } from "../format.js";
import { noticeOf } from "../shell.js";
import { follow } from "./kept.js";

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
  const stop = h("button", { type: "button", class: "quiet", hidden: true }, "Stop");
  const state = h("p", { class: "hint", role: "status" });
  const place = h("div");
  const kept = h("ul", { class: "kept" });
  const refused = (/** @type {Error} */ error) => place.append(noticeOf(error));

  async function start() {
    place.replaceChildren();
    if (box.checked && !(stage.edit.on && stage.edit.crop.checked)) {
      state.textContent = "There is no box yet: open Crop and clean above, and move its sides.";
      stage.edit.button.focus();
      return;
    }
    make.disabled = true;
    try {
      await show(await send("POST", `${address}/meshes`, {
        format: format.value, faces: Number(faces.value),
        ...(colors.value && !colors.disabled ? { texture: Number(colors.value) } : {}),
        ...(box.checked ? { box: stage.edit.box } : {}),
      }));
    } catch (error) {
      refused(/** @type {Error} */ (error));
    } finally {
      make.disabled = false;
    }
  }

  /** Say what is done until a mesh is whole. @param {any} begun */
  async function show(begun) {
    make.disabled = true;
    try {
      const mesh = await follow(begun, stop, ({ progress }) => {
        const count = progress?.total ? `, ${progress.done} of ${progress.total}` : "";
        state.textContent = `${progress ? progress.stage : "waiting"}${count}. This takes some minutes; the server continues if this page is closed.`;
      }, refused);
      state.textContent = !mesh ? "Stopped." : mesh.state === "failed" ? `${mesh.problem.detail} ${mesh.problem.advice ?? ""}` : "";
      if (mesh?.state === "succeeded") await list();
    } catch (error) {
      state.textContent = "";
      throw error;
    } finally {
      make.disabled = false;
    }
  }

  /** List the meshes that are kept, and return those that are not whole yet. */
  async function list() {
    /** @type {any[]} */
    const meshes = (await get(`${address}/meshes`)).meshes;
    kept.replaceChildren(...meshes.filter(({ state }) => state === "succeeded").map((mesh) => {
      const name = `.${mesh.request.format}, ${number(mesh.facts.triangles)} triangles${mesh.request.texture ? " with a texture" : ""}${mesh.request.box ? " of a box" : ""}, ${bytes(mesh.bytes)}`;
      return h("li", {},
        h("a", { class: "button quiet", href: mesh.links.file, download: `${model.name || model.id}-mesh.${mesh.request.format}` }, `Save ${name}`),
        h("button", { type: "button", class: "quiet", "aria-label": `Delete the mesh ${name}`, onclick: () => remove(mesh) }, "Delete"));
    }));
    return meshes.filter(({ state }) => state === "queued" || state === "running");
  }

  /** @param {any} mesh */
  async function remove(mesh) {
    try {
      await request("DELETE", mesh.links.self);
      await list();
    } catch (error) {
      refused(/** @type {Error} */ (error));
    }
  }

  section.append(h("h2", { id: "mesh-title" }, "Mesh"),
    h("p", { class: "muted" }, "Triangles with colours, for programs that show no splats: the surfaces on which the photos agree."),
    h("div", { class: "row" },
      h("div", { class: "field" }, h("label", { for: "mesh-format" }, "File"), format),
      h("div", { class: "field" }, h("label", { for: "mesh-colors" }, "Colours"), colors),
      h("div", { class: "field" }, h("label", { for: "mesh-faces" }, "Most triangles"), faces)),
    h("label", { class: "row", for: "mesh-box" }, box, "Only what lies in the box of Crop and clean"),
    h("div", { class: "row" }, make, stop), state, place, kept);
  try {
    const [unfinished] = await list();
    if (unfinished) await show(unfinished);
  } catch (error) {
    refused(/** @type {Error} */ (error));
  }
}
