// The photos as a grid, each with its verdict and a button that leaves it out, and the other files as a list.

import { adviceOf } from "../advice.js";
import { h } from "../dom.js";
import { bytes, count, number } from "../format.js";

/** @typedef {import("./items.js").Item} Item */

/** Photos that are shown before somebody asks for all of them. */
const SHOWN = 60;

const KINDS = { photo: "photo", video: "video", archive: "zip archive", mask: "mask", pose: "cameras", scan: "points to start from", ignored: "not used" };

export class Gallery {
  /**
   * @param {HTMLElement} photos a list
   * @param {HTMLElement} others a list
   * @param {HTMLButtonElement} more shows all photos
   * @param {(item: Item) => void} onToggle called when somebody leaves a file out or takes it in again
   */
  constructor(photos, others, more, onToggle) {
    this.photos = photos;
    this.others = others;
    this.more = more;
    this.onToggle = onToggle;
    this.whole = false;
    this.onlyBad = false;
    /** @type {Map<number, Tile>} */
    this.tiles = new Map();
  }

  /** Show the files as they are now. @param {import("./items.js").Items} items */
  show(items) {
    const photos = items.photos.filter((item) => !this.onlyBad || item.left || item.verdict.kind === "bad" || item.problem);
    const shown = this.whole ? photos : photos.slice(0, SHOWN);
    this.more.hidden = shown.length === photos.length;
    this.more.textContent = `Show all ${number(photos.length)} photos`;
    this.fill(this.photos, shown, (item) => new PhotoTile(item, this.onToggle));
    this.fill(this.others, items.all.filter((item) => item.kind !== "photo" && item.kind !== "mask").slice(0, SHOWN), (item) => new FileRow(item, this.onToggle));
  }

  /**
   * Let a list have the tiles of these items, keeping those that it has, so that the focus stays where it is.
   * @param {HTMLElement} list
   * @param {Item[]} wanted
   * @param {(item: Item) => Tile} made
   */
  fill(list, wanted, made) {
    const tiles = wanted.map((item) => {
      let tile = this.tiles.get(item.id);
      if (!tile || tile.parentless(list)) {
        tile?.element.remove();
        tile = made(item);
        this.tiles.set(item.id, tile);
      }
      tile.update(item);
      return tile.element;
    });
    const kept = new Set(tiles);
    for (const child of [...list.children]) if (!kept.has(/** @type {HTMLElement} */ (child))) child.remove();
    tiles.forEach((element, index) => {
      if (list.children[index] !== element) list.insertBefore(element, list.children[index] ?? null);
    });
  }
}

/** One file of a list. */
class Tile {
  constructor() {
    /** @type {HTMLElement} */
    this.element = h("li");
  }

  /** Whether it stands in another list than this one. @param {HTMLElement} list */
  parentless(list) {
    return this.element.parentElement !== null && this.element.parentElement !== list;
  }

  /** @param {Item} _item */
  update(_item) {}
}

class PhotoTile extends Tile {
  /** @param {Item} item @param {(item: Item) => void} onToggle */
  constructor(item, onToggle) {
    super();
    this.picture = h("div", { class: "thumbnail" });
    this.name = h("span", { class: "name" });
    this.verdict = h("p", { class: "verdict" });
    this.button = h("button", { type: "button", class: "small", onclick: () => onToggle(item) });
    this.element = h("li", { class: "photo" }, this.picture, h("div", { class: "about" }, this.name, this.verdict, this.button));
  }

  /** @param {Item} item */
  update(item) {
    const image = this.picture.querySelector("img");
    if (item.thumbnail && !image) this.picture.append(h("img", { src: item.thumbnail, alt: "", width: 240, height: 180, decoding: "async" }));
    this.element.dataset.verdict = item.problem ? "bad" : item.left ? "left" : item.verdict.kind;
    this.element.toggleAttribute("data-stored", item.stored);
    this.name.textContent = item.name;
    this.name.title = item.name;
    this.verdict.textContent = textOf(item);
    this.button.textContent = item.left ? "Use it" : "Leave out";
    this.button.setAttribute("aria-label", item.left ? `Use ${item.name}` : `Leave out ${item.name}`);
    this.button.hidden = item.stored;
  }
}

class FileRow extends Tile {
  /** @param {Item} item @param {(item: Item) => void} onToggle */
  constructor(item, onToggle) {
    super();
    this.text = h("span");
    this.verdict = h("p", { class: "verdict" });
    this.button = h("button", { type: "button", class: "small push", onclick: () => onToggle(item) });
    this.element = h("li", { class: "file row" }, this.text, this.verdict, this.button);
  }

  /** @param {Item} item */
  update(item) {
    this.element.dataset.verdict = item.problem ? "bad" : item.left ? "left" : item.kind === "ignored" ? "ignored" : "good";
    this.text.textContent = `${item.name} (${KINDS[item.kind]}, ${bytes(item.file.size)})`;
    this.verdict.textContent = item.kind === "photo" ? "" : item.problem || item.left || item.stored || item.lost ? textOf(item) : insideOf(item);
    this.button.textContent = item.left ? "Use it" : "Leave out";
    this.button.setAttribute("aria-label", item.left ? `Use ${item.name}` : `Leave out ${item.name}`);
    this.button.hidden = item.stored || item.kind === "ignored";
  }
}

/** @param {Item} item */
function textOf(item) {
  if (item.problem) return `${item.problem.message} ${adviceOf(item.problem)}`.trim();
  if (item.left) return "Left out";
  if (item.stored) return "On the server";
  return item.lost ?? item.verdict.text;
}

/** @param {Item} item */
function insideOf(item) {
  if (item.kind !== "archive" || !item.inside) return "";
  return `${count(item.inside.length, "file")} inside`;
}
