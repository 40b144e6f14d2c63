// Going on with a phone: the address of this page as a QR code, or why a phone would not reach it.

import { isLoopback, pathOfPage } from "../address.js";
import { get } from "../api.js";
import { h } from "../dom.js";
import { noticeOf, viewerInstalled } from "../shell.js";

const SVG = "http://www.w3.org/2000/svg";

/** Empty modules around the code, which readers need to find it. */
const BORDER = 4;

/**
 * Return what is shown for phones.
 * @param {URL} address of this page
 * @param {{local?: boolean | null, lan?: {url: string, fingerprint: string} | null}} info how other machines reach the server
 * @param {boolean} signedIn whether the server asks for a key
 */
export async function phoneHelp(address, { local = null, lan = null }, signedIn) {
  if (lan && isLoopback(address.hostname)) address = new URL(pathOfPage().slice(1) + address.search, `${lan.url}/`);
  if (isLoopback(address.hostname)) {
    return h("div", {},
      h("p", {}, `This page is open under ${address.host}, an address that only this machine reaches.`),
      local === false
        ? h("p", {}, "The server listens for other machines too. Open this page under the name or the network address of this machine, and the code for phones appears here.")
        : h("p", {}, "To use it with a phone in the same network, stop the server and start it with ", h("code", {}, "splatmill up --lan"), ". It then answers other devices too, with a key that it makes, and this page shows a code for the phone."));
  }
  const link = h("a", { href: address.href }, address.href);
  const code = h("div", {}, viewerInstalled && await qrCode(address.href));
  return h("div", { class: "row" }, code,
    h("div", { class: "about-code" },
      viewerInstalled
        ? h("p", {}, "Point the phone's camera at the code. It leads to ", link, ".")
        : h("p", {}, "Open ", link, " on the phone. This server draws no QR code of it, because the page's JavaScript packages are not installed; ", h("code", {}, "make install"), " fetches them."),
      lan && h("p", {}, "The phone warns once that it does not know the certificate, because this server has signed it itself. It is the right one if the phone shows the fingerprint ", h("code", {}, lan.fingerprint), "."),
      signedIn && h("p", {}, "The phone will ask for an API key."),
      lan && signedIn && keyOf(code)));
}

/** A button that shows the key for phones, and has the code carry it. @param {HTMLElement} code the place of the code */
function keyOf(code) {
  const place = h("div", {}, h("button", { type: "button", onclick: async () => {
    try {
      const { url, key } = await get("/v1/lan");
      if (key && viewerInstalled) code.replaceChildren(await qrCode(`${url}/sign-in#key=${encodeURIComponent(key)}`, "QR code that signs a phone in"));
      place.replaceChildren(...(key
        ? [h("p", { tabindex: -1 }, "API key: ", h("code", {}, key)), h("p", {}, viewerInstalled && "The code carries the key now. ", "Whoever has the key, or a picture of the code, can use all of the service.")]
        : [h("p", { tabindex: -1 }, "This server has stored keys, which it cannot show again. Use one of them on the phone.")]));
      place.querySelector("p")?.focus();
    } catch (error) {
      place.append(noticeOf(/** @type {Error} */ (error)));
    }
  } }, "Show the key"));
  return place;
}

/** A QR code, dark on light in both themes, since some readers take no other. @param {string} text @param {string} [label] what it leads to */
async function qrCode(text, label = `QR code of ${text}`) {
  const { encodeQR } = await import("qr");
  const rows = encodeQR(text, "raw", { border: BORDER, ecc: "medium" });
  const side = rows.length;
  const drawing = document.createElementNS(SVG, "svg");
  drawing.setAttribute("viewBox", `0 0 ${side} ${side}`);
  drawing.setAttribute("class", "qr");
  drawing.setAttribute("role", "img");
  drawing.setAttribute("aria-label", label);
  const path = document.createElementNS(SVG, "path");
  path.setAttribute("d", rows.flatMap((row, y) => row.map((dark, x) => (dark ? `M${x} ${y}h1v1h-1z` : ""))).join(""));
  drawing.append(path);
  return drawing;
}
