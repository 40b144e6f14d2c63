// Exchanges an API key for the cookie of a session, which scripts cannot read, and leads back to where the reader was.

import { at } from "../address.js";
import { adviceOf } from "../advice.js";
import { Problem, request } from "../api.js";
import { byId } from "../dom.js";
import { startShell } from "../shell.js";

const form = byId("form");
const key = /** @type {HTMLInputElement} */ (byId("key"));
const error = byId("key-error");

/** The page to go to: one of this server's own, whatever the address says. */
function next() {
  const asked = new URLSearchParams(location.search).get("next") ?? at("/");
  const address = new URL(asked, location.origin);
  const own = asked.startsWith("/") && address.origin === location.origin && address.pathname.startsWith(at("/"));
  return own ? address.pathname + address.search : at("/");
}

/** Exchange the key of the form for a session, and go to where the reader was. */
async function signIn() {
  error.textContent = "";
  key.removeAttribute("aria-invalid");
  // A header holds ASCII only; a key that was copied with something else cannot be right.
  const secret = key.value.trim();
  try {
    if (!/^[\x21-\x7e]+$/.test(secret)) throw new Error("A key consists of letters, digits and a few signs, without spaces.");
    await request("POST", "/v1/session", { headers: { Authorization: `Bearer ${secret}` }, stay: true });
    location.replace(next());
  } catch (refused) {
    const wrong = refused instanceof Problem && refused.status === 401;
    const message = wrong ? "The server does not know this key. It may have been revoked." : /** @type {Error} */ (refused).message;
    error.textContent = message + (refused instanceof Problem && !wrong ? ` ${adviceOf(refused)}` : "");
    key.setAttribute("aria-invalid", "true");
    key.select();
  }
}

form.addEventListener("submit", (event) => {
  event.preventDefault();
  void signIn();
});

// A code that a phone has read carries a key after "#", which browsers send to no server. It does not stay in the address.
const carried = new URLSearchParams(location.hash.slice(1)).get("key");
if (carried) history.replaceState(null, "", location.pathname + location.search);

const caller = await startShell({ open: true });
if (carried && caller?.key_name !== "no key") {
  key.value = carried;
  await signIn();
} else if (caller) {
  form.hidden = true;
  byId("already").hidden = false;
  byId("already-text").textContent = caller.key_name === "no key"
    ? "This server has no keys, so nobody has to sign in."
    : `You are signed in with the key ${caller.key_name}.`;
  /** @type {HTMLAnchorElement} */ (byId("on")).href = next();
} else {
  key.focus();
}
