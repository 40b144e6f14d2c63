// A list that is filtered, loaded page by page, and keeps its filters in the page's address.

import { get } from "../api.js";
import { byId, h, toggle } from "../dom.js";
import { nameOf } from "../format.js";

const TYPING_MS = 250; // a pause in typing after which the list is asked for again

/** The orders of a list, by the value of the parameter `sort`. */
const ORDERS = { "": "Newest first", name: "Name", size: "Largest first", psnr: "Highest dB first" };

/**
 * Show the records of a list in `#list`, filtered by the form `#filters`, with `#more` for the next page.
 * @param {object} list
 * @param {"jobs" | "models"} list.noun
 * @param {number} list.limit records of a page
 * @param {(filters: Record<string, string>) => import("../api.js").Query} list.query what the server is asked for
 * @param {(record: any) => HTMLElement} list.entry returns the entry of a record, an `<li>`
 * @param {() => (Node | string)} list.empty what to say where there is nothing at all
 * @param {(records: any[]) => Promise<unknown>} list.deleteAll deletes the records that were selected
 * @param {(record: any) => boolean} [list.deletable] whether a record can be selected
 * @param {(ids: string[]) => void} [list.compare] shows two records beside each other
 * @returns {Promise<{reload: () => Promise<void>, remove: (id: string) => void, update: (record: any) => void, records: () => any[]}>}
 */
export async function listing({ noun, limit, query, entry, empty, deleteAll, deletable = () => true, compare }) {
  const form = /** @type {HTMLFormElement} */ (byId("filters"));
  const box = byId("list");
  const more = /** @type {HTMLButtonElement} */ (byId("more"));
  const count = byId("count");
  const tags = /** @type {HTMLDataListElement} */ (byId("known-tags"));
  /** @type {Map<string, {record: any, element: HTMLElement}>} */
  const shown = new Map();
  /** @type {string | null} */
  let cursor = null;
  let asked = new AbortController();
  let timer = 0;

  const filters = () => Object.fromEntries([...new FormData(form)].map(([name, value]) => [name, String(value)]));

  byId("favourite").closest("label")?.before(h("div", { class: "field" }, h("label", { for: "sort" }, "Sort by"),
    h("select", { id: "sort", name: "sort" }, Object.entries(ORDERS).map(([value, text]) => h("option", { value }, text)))));
  for (const [name, value] of new URLSearchParams(location.search)) {
    const control = form.elements.namedItem(name);
    if (control instanceof HTMLInputElement && control.type === "checkbox") control.checked = control.value === value;
    else if (control instanceof HTMLInputElement || control instanceof HTMLSelectElement) control.value = value;
  }

  // Several records are selected by checkboxes, which are shown only then.
  /** @type {Set<string>} */
  const selected = new Set();
  const deleteSelected = h("button", { class: "danger", type: "button", disabled: true, hidden: true, onclick: async () => {
    const chosen = [...shown.values()].map(({ record }) => record).filter(({ id }) => selected.has(id));
    selected.clear();
    saySelected();
    await deleteAll(chosen);
  } });
  const compareSelected = h("button", { type: "button", disabled: true, hidden: true, title: "Two of them", onclick: () => compare?.([...selected]) }, "Compare");
  const selecting = toggle("Select", (on) => {
    selected.clear();
    box.classList.toggle("selecting", on);
    for (const check of box.querySelectorAll(".select input")) /** @type {HTMLInputElement} */ (check).checked = false;
    deleteSelected.hidden = !on;
    compareSelected.hidden = !on || !compare;
    saySelected();
  });
  form.append(h("div", { class: "row push" }, compareSelected, deleteSelected, selecting));

  function saySelected() {
    deleteSelected.disabled = selected.size === 0;
    compareSelected.disabled = selected.size !== 2;
    deleteSelected.textContent = selected.size ? `Delete ${selected.size} selected` : "Delete selected";
  }

  /** @param {any} record */
  function checkbox(record) {
    const check = h("input", { type: "checkbox", "aria-label": `Select ${nameOf(record, noun === "jobs" ? "Job" : "Model")}`, disabled: !deletable(record), onchange: () => {
      if (check.checked) selected.add(record.id);
      else selected.delete(record.id);
      saySelected();
    } });
    check.checked = selected.has(record.id);
    return h("label", { class: "select" }, check);
  }

  /** Whether a tag is among those of the records that were loaded. @param {string} tag */
  function knows(tag) {
    return [...tags.options].some(({ value }) => value === tag);
  }

  /** @param {any} record */
  function show(record) {
    const element = entry(record);
    element.append(checkbox(record));
    const known = shown.get(record.id);
    if (known) known.element.replaceWith(element);
    else box.append(element);
    shown.set(record.id, { record, element });
    for (const tag of record.tags) if (!knows(tag)) tags.append(h("option", { value: tag }));
  }

  function say() {
    const { sort, ...chosen } = filters();
    const filtered = Object.values(chosen).some(Boolean);
    more.hidden = cursor === null;
    box.hidden = shown.size === 0;
    if (shown.size > 0) count.textContent = `${shown.size}${cursor ? " or more" : ""} ${shown.size === 1 ? noun.slice(0, -1) : noun}`;
    else if (filtered) count.textContent = `No ${noun} match. Change the filter to see others.`;
    else count.replaceChildren(empty());
  }

  async function load() {
    asked.abort();
    asked = new AbortController();
    const { signal } = asked;
    more.disabled = true;
    try {
      // A page of a filtered list may hold none although others follow.
      for (let before = shown.size; shown.size === before; ) {
        const page = await get(`/v1/${noun}`, { ...query(filters()), limit, cursor }, signal);
        page[noun].forEach(show);
        cursor = page.cursor;
        if (!cursor) break;
      }
      say();
    } catch (error) {
      if (!signal.aborted) throw error;
    } finally {
      more.disabled = false;
    }
  }

  async function reload() {
    const chosen = new URLSearchParams(Object.entries(filters()).filter(([, value]) => value));
    history.replaceState(null, "", chosen.size ? `?${chosen}` : location.pathname);
    shown.clear();
    selected.clear();
    saySelected();
    box.replaceChildren();
    cursor = null;
    await load();
  }

  form.addEventListener("submit", (event) => {
    event.preventDefault();
    reload();
  });
  form.addEventListener("input", (event) => {
    const field = event.target;
    clearTimeout(timer);
    if (field instanceof HTMLInputElement && field.list && field.value && !knows(field.value)) return; // a tag counts once it is whole
    timer = setTimeout(reload, field instanceof HTMLInputElement && field.type === "search" ? TYPING_MS : 0);
  });
  byId("tag").addEventListener("change", reload);
  more.addEventListener("click", async () => {
    const last = shown.size;
    await load();
    /** @type {HTMLElement | null | undefined} */ ([...shown.values()][last]?.element.querySelector("a"))?.focus();
  });
  await reload();

  return {
    reload,
    records: () => [...shown.values()].map(({ record }) => record),
    update(record) {
      const known = shown.get(record.id);
      // An entry that somebody is in keeps its focus: it is left alone unless something has changed.
      if (!known || JSON.stringify(known.record) === JSON.stringify(record)) return;
      const focused = known.element.contains(document.activeElement)
        ? document.activeElement?.getAttribute("data-focus") : undefined;
      show(record);
      if (focused) /** @type {HTMLElement | null} */ (shown.get(record.id)?.element.querySelector(`[data-focus="${focused}"]`))?.focus();
    },
    remove(id) {
      const known = shown.get(id);
      if (!known) return;
      const left = known.element.contains(document.activeElement); // the focus has to go on to another entry
      const beside = known.element.nextElementSibling ?? known.element.previousElementSibling;
      known.element.remove();
      shown.delete(id);
      selected.delete(id);
      saySelected();
      say();
      if (left) (/** @type {HTMLElement | null} */ (beside?.querySelector("a")) ?? byId("main")).focus();
    },
  };
}
