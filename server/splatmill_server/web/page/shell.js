// What every page has around its contents: header, navigation, theme switch, who is signed in, and notices.

import { at, pathOfPage } from "./address.js";
import { adviceOf } from "./advice.js";
import { OUTDATED, Problem, isOutdated, request, signIn, whole } from "./api.js";
import { h } from "./dom.js";

const THEME = "splatmill.theme";
const THEMES = /** @type {const} */ (["auto", "light", "dark"]);
const NAVIGATION = [
  { href: "/", text: "New" },
  { href: "/jobs", text: "Jobs" },
  { href: "/models", text: "Models" },
];

/** Whether the JavaScript of the 3D viewer is installed on the server. */
export const viewerInstalled = document.documentElement.dataset.viewer !== "missing";

/**
 * Put the header before `<main id="main">` and find out who is signed in.
 * @param {object} [more]
 * @param {boolean} [more.open] the page needs no session (sign-in and shared links)
 * @param {boolean} [more.visitor] the page does not ask who looks
 * @param {boolean} [more.viewer] the page shows the 3D viewer, and says so where it is not installed
 * @returns {Promise<any>} the answer of `/v1/me`; null on an open page without a session
 */
export async function startShell({ open = false, visitor = false, viewer = false } = {}) {
  const main = /** @type {HTMLElement} */ (document.getElementById("main"));
  main.tabIndex = -1;
  const person = h("div", { class: "row push" }, themeSwitch());
  document.body.prepend(
    h("a", { class: "skip", href: "#main" }, "Skip to the contents"),
    h("header", { class: "bar" },
      h(visitor ? "span" : "a", { class: "brand", ...(visitor ? {} : { href: "/" }) }, h("img", { src: icon(), alt: "", width: 26, height: 26 }), h("span", {}, "Splatmill")),
      open ? null : h("nav", { "aria-label": "Pages" }, NAVIGATION.map(({ href, text }) =>
        h("a", { href, "aria-current": isCurrent(href) }, text))),
      person));
  window.addEventListener("unhandledrejection", (event) => {
    if (event.reason instanceof Problem) {
      event.preventDefault();
      notify(event.reason);
    } else void sayOutdated();
  });
  window.addEventListener("error", () => void sayOutdated());
  if (viewer && !viewerInstalled) {
    main.prepend(h("div", { class: "notice", "data-kind": "warning" },
      h("p", {}, "The 3D viewer is not installed on this server, so pictures come from the server's renderer."),
      h("p", {}, "To install it, run `make install` where npm or PyPI can be reached, and reload this page.")));
  }
  const caller = visitor ? null : await me(open);
  if (caller && caller.key_name !== "no key") {
    person.prepend(h("span", { class: "who", title: `Owner: ${caller.owner}` }, caller.key_name),
      h("button", { class: "quiet small", type: "button", onclick: signOut }, "Sign out"));
  }
  return caller;
}

let saysOutdated = false;

/** Say why a page fails whose server was replaced while it was open. */
async function sayOutdated() {
  if (saysOutdated || !(await isOutdated())) return;
  saysOutdated = true;
  notify(OUTDATED.detail, "warning", { text: "Reload", act: () => location.reload() });
}

/** @param {boolean} open */
async function me(open) {
  try {
    return await whole((await request("GET", "/v1/me", { stay: true })).json());
  } catch (error) {
    if (!(error instanceof Problem)) throw error;
    if (error.status === 401) {
      if (!open) signIn();
    } else notify(error);
    return null;
  }
}

async function signOut() {
  await request("DELETE", "/v1/session", { stay: true });
  location.assign(at("/sign-in"));
}

/** The icon's address, which the page's head names with its digest. */
function icon() {
  return /** @type {HTMLLinkElement} */ (document.querySelector('link[rel="icon"]')).href;
}

/** @param {string} href */
function isCurrent(href) {
  const here = pathOfPage();
  if (here === href) return "page";
  return href !== "/" && here.startsWith(`${href}/`) ? "true" : null;
}

function themeSwitch() {
  const select = h("select", { "aria-label": "Theme", class: "theme", onchange: () => setTheme(select.value) },
    THEMES.map((name) => h("option", { value: name }, { auto: "Auto", light: "Light", dark: "Dark" }[name])));
  select.value = document.documentElement.dataset.theme ?? "auto";
  return select;
}

/** @param {string} name */
function setTheme(name) {
  if (name === "auto") delete document.documentElement.dataset.theme;
  else document.documentElement.dataset.theme = name;
  try {
    localStorage.setItem(THEME, name);
  } catch {
    // Storage is off in this browser: the choice holds for this page.
  }
  document.dispatchEvent(new CustomEvent("themechange"));
}

/**
 * Show a message until it is closed; those of the kind "good" close by themselves. Screen readers read it out.
 * @param {string | Error} message a Problem shows its advice too
 * @param {"info" | "good" | "warning" | "error"} [kind]
 * @param {{text: string, act: () => unknown}} [action] a button of the message; it stays longer then
 */
export function notify(message, kind = message instanceof Error ? "error" : "info", action) {
  let region = document.querySelector(".notices");
  if (!region) {
    region = h("div", { class: "notices" });
    document.body.append(region);
  }
  const box = noticeOf(message, kind);
  const close = () => box.remove();
  if (action) {
    box.querySelector(".row")?.append(h("button", { class: "small push", type: "button", onclick: () => {
      close();
      return action.act();
    } }, action.text));
  }
  box.querySelector(".row")?.append(h("button", { class: action ? "quiet small" : "quiet small push", type: "button", "aria-label": "Close the message", onclick: close }, "✕"));
  region.append(box);
  if (kind === "good") setTimeout(close, action ? 20_000 : 6000);
}

/**
 * Return a message as an element, for a place in the page.
 * @param {string | Error} message
 * @param {"info" | "good" | "warning" | "error"} [kind]
 */
export function noticeOf(message, kind = message instanceof Error ? "error" : "info") {
  const advice = message instanceof Problem ? adviceOf(message) : "";
  return h("div", { class: "notice", "data-kind": kind, role: kind === "error" ? "alert" : "status" },
    h("div", { class: "row" }, h("div", {},
      h("p", {}, message instanceof Error ? message.message : message),
      advice && h("p", {}, advice))));
}

/**
 * Ask before something that cannot be undone; resolves to whether the answer was yes.
 * @param {object} question
 * @param {string} question.title
 * @param {string} question.text what will happen
 * @param {string} question.action the button that does it
 * @param {string} [question.keep] the button that does nothing
 * @returns {Promise<boolean>}
 */
export function confirmAction({ title, text, action, keep = "Cancel" }) {
  return new Promise((resolve) => {
    const dialog = h("dialog", { "aria-labelledby": "confirm-title" },
      h("form", { method: "dialog", class: "stack" },
        h("h2", { id: "confirm-title" }, title), h("p", {}, text),
        h("div", { class: "row" },
          h("button", { class: "push", value: "no", autofocus: true }, keep),
          h("button", { class: "danger", value: "yes" }, action))));
    dialog.addEventListener("close", () => {
      resolve(dialog.returnValue === "yes");
      dialog.remove();
    });
    document.body.append(dialog);
    dialog.showModal();
  });
}
