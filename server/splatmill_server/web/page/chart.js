// Error against run time as a line chart, with the same figures as a table.
//
//     const chart = new ErrorChart(byId("curve"));
//     chart.update(rows);            // the rows of /v1/jobs/{id}/curve; call it again as they come
//
// A page that uses it links chart.css.

import { h } from "./dom.js";
import { decibels, number, seconds } from "./format.js";

/**
 * @typedef {object} CurveRow
 * @property {number} seconds training time
 * @property {number} step
 * @property {number} gaussians
 * @property {number | null} [psnr] of held-out photos, dB
 * @property {number | null} [ssim]
 * @property {number | null} [train_psnr] of some training photos
 * @property {number | null} [train_ssim]
 */

/** Pixels; the width is that of the element. */
const HEIGHT = 280;
const NARROWEST = 260;
const MARGIN = { left: 46, right: 14, top: 26, bottom: 42 };

const MEASURES = {
  psnr: { name: "PSNR in dB", held: "psnr", trained: "train_psnr", text: decibels },
  ssim: { name: "SSIM", held: "ssim", trained: "train_ssim", text: (/** @type {number} */ x) => x.toFixed(4) },
};

/** The chart with its controls, a summary in words, and the table. */
export class ErrorChart {
  /** @param {HTMLElement} container */
  constructor(container) {
    /** @type {CurveRow[]} */
    this.rows = [];
    this.measure = /** @type {"psnr" | "ssim"} */ ("psnr");
    this.log = true;
    this.width = 640;
    this.figure = h("div", { class: "chart-drawing" });
    this.legend = h("ul", { class: "chart-legend", hidden: true },
      h("li", { class: "held-out" }, "held-out photos"), h("li", { class: "trained-on" }, "photos trained on"));
    this.table = h("tbody");
    this.summary = h("p", { class: "muted small" });
    const id = `chart-${Math.random().toString(36).slice(2)}`;
    const measure = h("select", { id: `${id}-measure`, onchange: () => this.choose(measure.value, this.log) },
      h("option", { value: "psnr" }, "PSNR"), h("option", { value: "ssim" }, "SSIM"));
    const scale = h("select", { id: `${id}-scale`, onchange: () => this.choose(this.measure, scale.value === "log") },
      h("option", { value: "log" }, "logarithmic"), h("option", { value: "linear" }, "linear"));
    container.replaceChildren(
      h("div", { class: "chart-tools" },
        h("div", { class: "field" }, h("label", { for: measure.id }, "Measure"), measure),
        h("div", { class: "field" }, h("label", { for: scale.id }, "Time axis"), scale),
        this.legend),
      h("figure", { class: "chart" }, this.figure, h("figcaption", {}, this.summary)),
      h("details", {}, h("summary", {}, "The same figures as a table"),
        h("div", { class: "scroll", tabindex: 0, role: "region", "aria-label": "Measurements" },
          h("table", { class: "table" },
            h("thead", {}, h("tr", {}, ["Training time", "Step", "Gaussians", "PSNR held out", "PSNR trained on", "SSIM held out", "SSIM trained on"]
              .map((title, column) => h("th", { scope: "col", class: column ? "number" : null }, title)))),
            this.table))));
    new ResizeObserver(() => {
      const width = Math.max(NARROWEST, Math.round(this.figure.clientWidth));
      if (width === this.width) return;
      this.width = width;
      this.draw();
    }).observe(this.figure);
    this.draw();
  }

  /** @param {string} measure @param {boolean} log */
  choose(measure, log) {
    this.measure = measure === "ssim" ? "ssim" : "psnr";
    this.log = log;
    this.draw();
  }

  /** @param {CurveRow[]} rows */
  update(rows) {
    this.rows = [...rows].sort((a, b) => a.step - b.step);
    this.table.replaceChildren(...this.rows.map((row) => h("tr", {},
      h("th", { scope: "row" }, seconds(row.seconds)),
      [number(row.step), number(row.gaussians), figure(row.psnr, 2), figure(row.train_psnr, 2), figure(row.ssim, 4), figure(row.train_ssim, 4)]
        .map((text) => h("td", { class: "number" }, text)))));
    this.draw();
  }

  draw() {
    const { name, held, trained, text } = MEASURES[this.measure];
    const value = (/** @type {CurveRow} */ row, /** @type {string} */ key) => /** @type {any} */ (row)[key];
    const rows = this.rows.filter((row) => [held, trained].some((key) => isNumber(value(row, key))));
    const last = rows.at(-1);
    this.summary.textContent = last
      ? `${isNumber(value(last, held)) ? `${text(value(last, held))} on photos that training does not see, ` : ""}after `
        + `${seconds(last.seconds)} of training and ${number(last.step)} steps. The clock stops while this is measured.`
      : "Nothing was measured yet: the first measurement follows soon after training begins.";
    this.legend.hidden = !last;
    if (!last) {
      this.figure.replaceChildren();
      return;
    }
    const axes = new Axes(rows.map((row) => row.seconds), rows.flatMap((row) => [value(row, held), value(row, trained)].filter(isNumber)), this.log, this.width);
    const drawing = svg("svg", {
      viewBox: `0 0 ${this.width} ${HEIGHT}`, role: "img",
      "aria-label": `${name} against training time. ${this.summary.textContent} The table below has all figures.`,
    });
    drawing.append(...axes.elements(name));
    for (const [key, css] of [[trained, "trained-on"], [held, "held-out"]]) {
      const points = rows.filter((row) => isNumber(value(row, key)))
        .map((row) => ({ row, x: axes.x(row.seconds), y: axes.y(value(row, key)) }));
      if (!points.length) continue;
      drawing.append(svg("polyline", { class: `series ${css}`, points: points.map(({ x, y }) => `${x.toFixed(1)},${y.toFixed(1)}`).join(" ") }));
      for (const { row, x, y } of points) {
        const point = svg("circle", { class: `point ${css}`, cx: x.toFixed(1), cy: y.toFixed(1), r: 3.5 });
        const title = svg("title");
        title.textContent = `${text(value(row, key))} after ${seconds(row.seconds)}, ${number(row.gaussians)} Gaussians`;
        point.append(title);
        drawing.append(point);
      }
    }
    this.figure.replaceChildren(drawing);
  }
}

/** The scales of a chart, and its grid. */
class Axes {
  /** @param {number[]} times @param {number[]} values @param {boolean} log @param {number} width */
  constructor(times, values, log, width) {
    this.width = width;
    const positive = times.filter((time) => time > 0);
    this.log = log && positive.length > 0 && Math.max(...positive) > 1.5 * Math.min(...positive);
    const longest = Math.max(...times, 1e-3);
    this.times = this.log ? [Math.min(...positive), longest] : [0, longest];
    const [low, high] = [Math.min(...values), Math.max(...values)];
    const room = Math.max((high - low) * 0.08, 1e-4 * Math.max(1, Math.abs(high)));
    this.values = [low - room, high + room];
  }

  /** @param {number} time seconds */
  x(time) {
    const [low, high] = this.times;
    const share = this.log ? Math.log(Math.max(time, low) / low) / Math.log(high / low) : (time - low) / (high - low || 1);
    return MARGIN.left + share * (this.width - MARGIN.left - MARGIN.right);
  }

  /** @param {number} value */
  y(value) {
    const [low, high] = this.values;
    return HEIGHT - MARGIN.bottom - ((value - low) / (high - low)) * (HEIGHT - MARGIN.top - MARGIN.bottom);
  }

  /** Grid, ticks and titles. @param {string} name of the vertical axis */
  elements(name) {
    const bottom = HEIGHT - MARGIN.bottom;
    const parts = [label(4, 16, name, "title", "start"), label((MARGIN.left + this.width) / 2, HEIGHT - 6, "training time", "title", "middle")];
    for (const value of ticks(this.values[0], this.values[1], 5)) {
      const y = this.y(value);
      parts.push(line(MARGIN.left, y, this.width - MARGIN.right, y, "grid-line"), label(MARGIN.left - 7, y + 4, plain(value), "", "end"));
    }
    for (const time of this.log ? decades(this.times[0], this.times[1]) : ticks(this.times[0], this.times[1], 6)) {
      const x = this.x(time);
      parts.push(line(x, bottom, x, bottom + 5, "axis"), label(x, bottom + 19, time < 60 ? `${plain(time)} s` : seconds(time), "", "middle"));
    }
    return [...parts, line(MARGIN.left, bottom, this.width - MARGIN.right, bottom, "axis")];
  }
}

/** Round numbers between two ends, about `count` of them. @param {number} low @param {number} high @param {number} count */
export function ticks(low, high, count) {
  const rough = (high - low) / count;
  if (!(rough > 0)) return [low];
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = power * ([1, 2, 5, 10].find((factor) => factor * power >= rough) ?? 10);
  const values = [];
  for (let index = Math.ceil(low / step); index * step <= high * (1 + 1e-12); index++) values.push(Number((index * step).toPrecision(10)));
  return values;
}

/** 1, 2 and 5 times powers of ten between two ends; at most eight. @param {number} low @param {number} high */
export function decades(low, high) {
  const values = [];
  for (let power = Math.floor(Math.log10(low)); power <= Math.ceil(Math.log10(high)); power++) {
    for (const factor of [1, 2, 5]) {
      const value = Number((factor * 10 ** power).toPrecision(3));
      if (value >= low * 0.999 && value <= high * 1.001) values.push(value);
    }
  }
  return values.length > 8 ? values.filter((value) => /^(0\.0*)?10*$/.test(plain(value))) : values;
}

/** @param {unknown} value @returns {value is number} */
function isNumber(value) {
  return typeof value === "number" && Number.isFinite(value);
}

/** @param {number | null | undefined} value @param {number} digits */
function figure(value, digits) {
  return isNumber(value) ? value.toFixed(digits) : "-";
}

/** @param {number} value */
function plain(value) {
  return String(Number(value.toPrecision(6)));
}

/** @param {string} tag @param {Record<string, string | number>} [attributes] */
function svg(tag, attributes = {}) {
  const element = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, String(value));
  return element;
}

/** @param {number} x1 @param {number} y1 @param {number} x2 @param {number} y2 @param {string} css */
function line(x1, y1, x2, y2, css) {
  return svg("line", { x1, y1, x2, y2, class: css });
}

/** @param {number} x @param {number} y @param {string} text @param {string} css @param {string} anchor */
function label(x, y, text, css, anchor) {
  const element = svg("text", { x, y, class: css, "text-anchor": anchor });
  element.textContent = text;
  return element;
}
