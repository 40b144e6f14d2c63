// The settings of a training as a form, made from `/v1/options`: the same names, ranges and help as on the command line.

import { h } from "../dom.js";
import { number } from "../format.js";
import { titleOf } from "./titles.js";

/**
 * @typedef {object} Option
 * @property {string} name
 * @property {"integer" | "number" | "text" | "list" | "choice" | "duration" | "bytes" | "flag"} type
 * @property {any} default
 * @property {number | null} minimum
 * @property {number | null} maximum
 * @property {string[] | null} choices
 * @property {string} group
 * @property {string} help
 */

/** The settings that are shown at first. */
const FIRST = ["preset", "within", "time_budget", "image_size"];

/** The titles of the groups, as on the command line. */
const GROUPS = { budget: "Length and size of the training", photos: "Photos", cameras: "Recovering the cameras", engine: "Engine" };

/** What can be typed, by type. */
const EXAMPLES = { duration: "for example 90s, 5m or 1h30m", bytes: "for example 1.5GB", list: "one in each line" };

const NUMBER = /^-?\d+(\.\d+)?$/;

export class OptionsForm {
  /**
   * @param {Option[]} options
   * @param {() => void} onChange
   */
  constructor(options, onChange) {
    this.options = options;
    this.onChange = onChange;
    /** @type {Map<string, {label: string, control: () => string, put: (text: string) => void, error: HTMLElement, inputs: HTMLInputElement[]}>} */
    this.fields = new Map();
    /** Settings that are shown at first. */
    this.first = h("div", { class: "settings-first" }, FIRST.flatMap((name) => options.filter((option) => option.name === name)).map((option) => this.field(option)));
    /** All others, by group. */
    this.all = h("div", { class: "stack" }, Object.entries(GROUPS).map(([group, title]) => {
      const inside = options.filter((option) => option.group === group && !FIRST.includes(option.name));
      return inside.length > 0 && h("fieldset", {}, h("legend", {}, title), h("div", { class: "settings" }, inside.map((option) => this.field(option))));
    }));
  }

  /** What was typed, without the fields that were left alone. @returns {Record<string, string>} */
  typed() {
    /** @type {Record<string, string>} */
    const texts = {};
    for (const [name, { control }] of this.fields) if (control() !== "") texts[name] = control();
    return texts;
  }

  /** Put in what was typed before. @param {Record<string, string>} typed */
  restore(typed) {
    for (const [name, text] of Object.entries(typed)) this.fields.get(name)?.put(text);
  }

  /**
   * Put in the options of a job; those that are as by default are left alone.
   * @param {Record<string, any>} values
   */
  fill(values) {
    /** @type {Record<string, string>} */
    const typed = {};
    for (const { name, default: usual } of this.options) {
      const value = values[name] ?? null;
      const text = Array.isArray(value) ? value.join("\n") : String(value);
      if (value !== null && text !== "" && text !== String(usual)) typed[name] = text;
    }
    this.restore(typed);
  }

  /** The options of a request. What is not a number is sent as it is, so that the server says what is wrong with it. */
  values() {
    /** @type {Record<string, any>} */
    const values = {};
    const typed = this.typed();
    for (const { name, type } of this.options) {
      const text = typed[name]?.trim();
      if (!text) continue;
      if (type === "flag") values[name] = text === "true";
      else if (type === "list") values[name] = text.split("\n").map((line) => line.trim()).filter(Boolean);
      else values[name] = ["integer", "number"].includes(type) && NUMBER.test(text) ? Number(text) : text;
    }
    return values;
  }

  /**
   * Show the errors of a problem beside their fields; returns whether each had a field.
   * @param {import("../api.js").Problem | null} problem null removes what is shown
   */
  show(problem) {
    for (const { error, inputs } of this.fields.values()) {
      error.replaceChildren();
      for (const input of inputs) input.removeAttribute("aria-invalid");
    }
    if (!problem) return true;
    /** @type {{where: string, what: string}[]} */
    const errors = problem.facts.errors ?? [];
    const placed = errors.filter(({ where, what }) => {
      const [root, name] = where.split(".");
      const field = root === "options" ? this.fields.get(name) : undefined;
      if (!field) return false;
      field.error.textContent = this.plain(what);
      for (const input of field.inputs) input.setAttribute("aria-invalid", "true");
      field.error.closest("details")?.setAttribute("open", "");
      return true;
    });
    return errors.length > 0 && placed.length === errors.length;
  }

  /** The errors that are shown, each with the name of its setting. */
  get errors() {
    return [...this.fields.values()].filter(({ error }) => error.textContent).map(({ label, error }) => `${label}: ${error.textContent}`);
  }

  /** Lead to the first field with an error. */
  lead() {
    const wrong = [...this.fields.values()].find(({ error }) => error.textContent);
    (wrong?.inputs.find((input) => input.checked) ?? wrong?.inputs[0])?.focus();
  }

  /** @param {Option} option */
  field(option) {
    const id = `option-${option.name}`;
    const error = h("p", { class: "error", id: `${id}-error`, "aria-live": "polite" });
    const described = `${id}-help ${id}-error`;
    const label = titleOf(option.name);
    const help = h("p", { class: "hint", id: `${id}-help` }, this.plain(option.help), option.minimum !== null && option.maximum !== null && option.type !== "list" ? ` ${range(option)}` : "");
    if (option.type === "choice" && option.name === "preset") return this.radios(option, label, error, help);
    const control = this.control(option, { id, "aria-describedby": described });
    const boolean = control instanceof HTMLInputElement && control.type === "checkbox";
    this.fields.set(option.name, {
      label,
      control: () => (boolean ? (control.checked ? "true" : "") : control.value),
      put: (text) => {
        if (boolean) control.checked = text === "true";
        else control.value = text;
      },
      error,
      inputs: [/** @type {HTMLInputElement} */ (control)],
    });
    if (boolean) return h("div", { class: "field" }, h("label", { class: "row", for: id }, control, label), help, error);
    return h("div", { class: "field" }, h("label", { for: id }, label), control, help, error);
  }

  /** A text in which settings have the names of this form. @param {string} text */
  plain(text) {
    const named = this.options.map(({ name }) => name).filter((name) => name.includes("_"));
    return named.reduce((said, name) => said.replaceAll(name, `"${titleOf(name)}"`), text);
  }

  /** @param {Option} option @param {Record<string, string>} attributes */
  control(option, attributes) {
    const common = { ...attributes, name: option.name, onchange: this.onChange, oninput: this.onChange, autocomplete: "off", spellcheck: "false" };
    if (option.type === "choice") {
      return h("select", common, (option.choices ?? []).map((choice) => h("option", { value: choice === option.default ? "" : choice }, choice)));
    }
    if (option.type === "flag") return h("input", { ...common, type: "checkbox" });
    if (option.type === "list") return h("textarea", { ...common, rows: 2, placeholder: EXAMPLES.list });
    const example = option.type === "duration" || option.type === "bytes" ? EXAMPLES[option.type] : "not set";
    const inputmode = option.type === "integer" ? "numeric" : option.type === "number" ? "decimal" : "text";
    return h("input", { ...common, type: "text", inputmode, placeholder: option.default === null ? example : String(option.default) });
  }

  /** @param {Option} option @param {string} label @param {HTMLElement} error @param {HTMLElement} help */
  radios(option, label, error, help) {
    const inputs = (option.choices ?? []).map((choice) => h("input", {
      type: "radio", name: option.name, value: choice, checked: choice === option.default, onchange: this.onChange,
    }));
    this.fields.set(option.name, {
      label,
      control: () => inputs.find((input) => input.checked && input.value !== option.default)?.value ?? "",
      put: (text) => {
        for (const input of inputs) input.checked = input.value === text;
      },
      error,
      inputs,
    });
    return h("fieldset", { class: "choice", "aria-describedby": `${help.id} ${error.id}` }, h("legend", {}, label),
      h("div", { class: "segments" }, inputs.map((input) => h("label", {}, input, h("span", {}, input.value)))), help, error);
  }
}

/** @param {Option} option */
function range({ minimum, maximum, type }) {
  if (type === "duration" || type === "bytes") return "";
  return `From ${number(minimum ?? 0)} to ${number(maximum ?? 0)}.`;
}
