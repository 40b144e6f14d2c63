// The log of a job: its last lines, warnings first to be seen, and the whole as a file.

import { h } from "../dom.js";
import { clock } from "../format.js";

/** @typedef {{at: string, level: string, message: string, about?: string | null}} Line */

/** @type {WeakMap<object, HTMLLIElement>} */
const items = new WeakMap();

/** Show lines in a list; it stays at its end if it is there. @param {HTMLElement} list @param {Line[]} lines */
export function showLog(list, lines) {
  const atEnd = list.scrollHeight - list.scrollTop - list.clientHeight < 30;
  for (const line of lines) if (!items.has(line)) items.set(line, itemOf(line));
  const rows = lines.map((line) => /** @type {HTMLLIElement} */ (items.get(line)));
  while (list.firstChild && list.firstChild !== rows[0]) list.firstChild.remove();
  list.append(...rows.slice(list.children.length));
  if (atEnd) list.scrollTop = list.scrollHeight;
}

/** @param {Line} line */
function itemOf({ at, level, message }) {
  return h("li", { "data-level": level },
    h("time", { datetime: at, class: "muted number" }, clock(at)), " ",
    level !== "info" && level !== "debug" && h("strong", {}, `${level}: `), message);
}

/** The warnings among log lines, but those about single photos, which are in the table of photos. @param {Line[]} lines */
export function warningsOf(lines) {
  return lines.filter(({ level, about }) => level === "warning" && about !== "unused_photos").map(({ message }) => message);
}
