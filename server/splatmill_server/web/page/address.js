// The addresses of this server, and who can reach them.

/** The path of the server on its host: "/", or where a proxy has put it. This file is at page/DIGEST/address.js below. */
const ROOT = new URL("../../", import.meta.url).pathname;

/**
 * The address of a path of the server's own, such as /v1/jobs; one that an answer names may begin with ROOT already.
 * @param {string} path
 */
export function at(path) {
  return path.startsWith("/") && !path.startsWith(ROOT) ? ROOT + path.slice(1) : path;
}

/** The path of this page below the server's. */
export function pathOfPage() {
  return location.pathname.slice(ROOT.length - 1);
}

/** Whether only the machine itself reaches a host by this name. @param {string} host */
export function isLoopback(host) {
  return host === "localhost" || host.endsWith(".localhost") || host === "[::1]" || /^127(\.\d+){3}$/.test(host);
}
