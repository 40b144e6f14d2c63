// What the address of this page says about who can reach it.

/** Whether only the machine itself reaches a host by this name. @param {string} host */
export function isLoopback(host) {
  return host === "localhost" || host.endsWith(".localhost") || host === "[::1]" || /^127(\.\d+){3}$/.test(host);
}
