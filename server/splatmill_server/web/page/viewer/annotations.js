/**
 * Annotations over a view: a numbered pin at each point, which shows its text when it is pressed.
 *
 * @import {View} from "../viewer.js"
 * @import {Vec} from "./pose.js"
 * @typedef {{point: Vec, text: string}} Annotation
 */

export class Annotations {
  /** @param {View} view @param {Annotation[]} [list] */
  constructor(view, list = []) {
    this.view = view;
    this.element = document.createElement("div");
    this.element.className = "pins";
    view.element.after(this.element);
    /** @type {{annotation: Annotation, pin: HTMLButtonElement, text: HTMLElement}[]} */
    this.shown = [];
    view.addEventListener("frame", () => this.place());
    this.show(list);
  }

  /** Show these in place of those before. @param {Annotation[]} list */
  show(list) {
    this.shown = list.map((annotation, index) => {
      const pin = document.createElement("button");
      pin.type = "button";
      pin.className = "pin";
      pin.textContent = `${index + 1}`;
      pin.setAttribute("aria-label", `Annotation ${index + 1}: ${annotation.text}`);
      pin.setAttribute("aria-expanded", "false");
      const text = document.createElement("p");
      text.className = "pin-text";
      text.textContent = annotation.text;
      text.hidden = true;
      pin.addEventListener("click", () => this.open(text.hidden ? index : -1));
      return { annotation, pin, text };
    });
    this.element.replaceChildren(...this.shown.flatMap(({ pin, text }) => [pin, text]));
    this.place();
  }

  /** Show the text of one annotation alone; none for -1. @param {number} index */
  open(index) {
    this.shown.forEach(({ pin, text }, each) => {
      text.hidden = each !== index;
      pin.setAttribute("aria-expanded", String(each === index));
    });
    this.place();
  }

  /** Put the pins where their points are seen. Those behind the camera or outside of the view are hidden. */
  place() {
    const { clientWidth: width, clientHeight: height } = this.view.canvas;
    for (const { annotation, pin, text } of this.shown) {
      const { x, y, depth } = this.view.project(annotation.point);
      const visible = depth > 0 && x >= 0 && y >= 0 && x <= width && y <= height;
      pin.hidden = !visible;
      text.classList.toggle("away", !visible);
      if (!visible) continue;
      pin.style.translate = `${x}px ${y}px`;
      // The text stays within the view, above its pin, or below it near the upper edge.
      const [wide, high] = [text.offsetWidth, text.offsetHeight];
      const left = Math.max(4, Math.min(width - wide - 4, x - wide / 2));
      const top = y - high - 20 > 4 ? y - high - 20 : Math.min(height - high - 4, y + 20);
      text.style.translate = `${left}px ${top}px`;
    }
  }

  dispose() {
    this.element.remove();
    this.shown = [];
  }
}
