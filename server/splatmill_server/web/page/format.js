// Figures as people read them. All return text.

const whole = new Intl.NumberFormat("en");

/** @param {number} count */
export function number(count) {
  return whole.format(Math.round(count));
}

/**
 * The name of a record, or what it is and the beginning of its id where it has none: "Model 3c4207ce".
 * @param {{name?: string | null, id: string}} record @param {"Job" | "Model" | "Photos" | "Link"} kind
 */
export function nameOf({ name, id }, kind) {
  return name || `${kind} ${id.slice(0, 8)}`;
}

/** How many there are of something: "1 photo", "1,200 photos". @param {number} many @param {string} noun in the singular */
export function count(many, noun) {
  return `${number(many)} ${noun}${Math.round(many) === 1 ? "" : "s"}`;
}

/** Bytes in units of 1,000, as downloads show them. @param {number} count */
export function bytes(count) {
  const units = ["bytes", "kB", "MB", "GB", "TB"];
  let unit = 0;
  while (count >= 1000 && unit < units.length - 1) [count, unit] = [count / 1000, unit + 1];
  if (unit === 0 && Math.round(count) === 1) return "1 byte";
  return `${unit === 0 || count >= 100 ? Math.round(count) : count.toFixed(1)} ${units[unit]}`;
}

/** A duration: "8.3 s", "2 min 05 s", "1 h 20 min". @param {number} given seconds */
export function seconds(given) {
  if (given < 9.95) return `${given.toFixed(1)} s`;
  const rounded = Math.round(given);
  if (rounded < 60) return `${rounded} s`;
  if (rounded < 3600) return `${Math.floor(rounded / 60)} min ${String(rounded % 60).padStart(2, "0")} s`;
  return `${Math.floor(rounded / 3600)} h ${Math.floor((rounded % 3600) / 60)} min`;
}

/** @param {number | null | undefined} psnr dB, or null where it was not measured */
export function decibels(psnr) {
  return psnr === null || psnr === undefined ? "not measured" : `${psnr.toFixed(1)} dB`;
}

const moments = new Intl.DateTimeFormat("en", { dateStyle: "medium", timeStyle: "short", hourCycle: "h23" });
const days = new Intl.DateTimeFormat("en", { dateStyle: "long" });
const clocks = new Intl.DateTimeFormat("en", { timeStyle: "medium", hourCycle: "h23" });

/** A moment, in the reader's own time zone: "Nov 27, 2026, 13:42". @param {string} iso */
export function moment(iso) {
  return moments.format(new Date(iso));
}

/** The day of a moment: "November 27, 2026". @param {number} given milliseconds since 1970 */
export function day(given) {
  return days.format(given);
}

/** The time of day of a moment: "13:42:05". @param {string} iso */
export function clock(iso) {
  return clocks.format(new Date(iso));
}

/** How long ago a moment was: "3 minutes ago". @param {string} iso */
export function ago(iso) {
  const passed = (Date.now() - Date.parse(iso)) / 1000;
  const relative = new Intl.RelativeTimeFormat("en", { numeric: "auto" });
  /** @type {[number, Intl.RelativeTimeFormatUnit][]} */
  const units = [[86400, "day"], [3600, "hour"], [60, "minute"]];
  for (const [length, unit] of units) {
    if (Math.abs(passed) >= length) return relative.format(-Math.trunc(passed / length), unit);
  }
  return passed < -1 ? "in a moment" : "just now";
}
