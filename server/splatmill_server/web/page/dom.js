// Elements as function calls. Text is set as text, never as HTML, so names chosen by users cannot become markup.

import { at } from "./address.js";
import { ago, moment } from "./format.js";

/** @typedef {Node | string | number | false | null | undefined} Child */

/**
 * Return a new element.
 *
 * Properties whose name begins with `on` are listeners; `class`, `data-...`, `aria-...` and others are attributes; false,
 * null and undefined leave an attribute out, true gives it no value. A `href` or `src` that begins with a slash is a path of
 * this server.
 * @template {keyof HTMLElementTagNameMap} T
 * @param {T} tag
 * @param {Record<string, any>} [attributes]
 * @param {...(Child | Child[])} children
 * @returns {HTMLElementTagNameMap[T]}
 */
export function h(tag, attributes = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name.startsWith("on")) element.addEventListener(name.slice(2).toLowerCase(), value);
    else if (value === true) element.setAttribute(name, "");
    else if (value !== false && value !== null && value !== undefined) element.setAttribute(name, name === "href" || name === "src" ? at(String(value)) : String(value));
  }
  append(element, children);
  return element;
}

/**
 * A word with a link to what it means on these pages.
 * @param {string} text @param {string} id of its entry in glossary.html
 */
export function term(text, id) {
  return h("a", { class: "term", href: `/glossary#${id}` }, text);
}

/** How long ago something happened, with the moment as its title. @param {string} iso */
export function when(iso) {
  return h("time", { datetime: iso, title: moment(iso) }, ago(iso));
}

/**
 * Append children, leaving out those that are false or null.
 * @param {Element} element
 * @param {(Child | Child[])[]} children
 */
export function append(element, children) {
  for (const child of children.flat()) {
    if (child !== false && child !== null && child !== undefined) element.append(child instanceof Node ? child : String(child));
  }
}

/**
 * Return the element with this id. Throws if the page has none, which is a mistake of the page.
 * @template {HTMLElement} [T=HTMLElement]
 * @param {string} id
 * @returns {T}
 */
export function byId(id) {
  const element = document.getElementById(id);
  if (!element) throw new Error(`The page has no element #${id}.`);
  return /** @type {T} */ (element);
}

/** Return a button that is either pressed or not. @param {string} text @param {(on: boolean) => void} change */
export function toggle(text, change) {
  const button = h("button", { type: "button", "aria-pressed": "false", onclick: () => {
    const on = button.getAttribute("aria-pressed") !== "true";
    button.setAttribute("aria-pressed", String(on));
    change(on);
  } }, text);
  return button;
}
