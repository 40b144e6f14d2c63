// Going on with a phone: the address of this page as a QR code, or why a phone would not reach it.

import { isLoopback, pathOfPage } from "../address.js";
import { h } from "../dom.js";
import { viewerInstalled } from "../shell.js";

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
  return h("div", { class: "row" }, viewerInstalled && await qrCode(address.href),
    h("div", { class: "about-code" },
      viewerInstalled
        ? h("p", {}, "Point the phone's camera at the code. It leads to ", link, ".")
        : h("p", {}, "Open ", link, " on the phone. This server draws no QR code of it, because the page's JavaScript packages are not installed; ", h("code", {}, "make install"), " fetches them."),
      lan && h("p", {}, "The phone warns once that it does not know the certificate, because this server has signed it itself. It is the right one if the phone shows the fingerprint ", h("code", {}, lan.fingerprint), "."),
      signedIn && h("p", {}, lan ? "The phone will ask for the API key. The terminal where the server was started shows the key, and a code that carries it." : "The phone will ask for an API key.")));
}

/** A QR code, dark on light in both themes, since some readers take no other. @param {string} text */
async function qrCode(text) {
  const { encodeQR } = await import("qr");
  const rows = encodeQR(text, "raw", { border: BORDER, ecc: "medium" });
  const side = rows.length;
  const drawing = document.createElementNS(SVG, "svg");
  drawing.setAttribute("viewBox", `0 0 ${side} ${side}`);
  drawing.setAttribute("class", "qr");
  drawing.setAttribute("role", "img");
  drawing.setAttribute("aria-label", `QR code of ${text}`);
  const path = document.createElementNS(SVG, "path");
  path.setAttribute("d", rows.flatMap((row, y) => row.map((dark, x) => (dark ? `M${x} ${y}h1v1h-1z` : ""))).join(""));
  drawing.append(path);
  return drawing;
}
