// What visitors see first: the start view with its picture, and whether the scene turns.

import { h, toggle } from "../dom.js";
import { noticeOf } from "../shell.js";
import { LOADING } from "../viewer/errors.js";

/** @import {Stage} from "./stage.js" */

export class Visitors {
  /** @param {Stage} stage */
  constructor(stage) {
    this.stage = stage;
    this.button = toggle("For visitors", (on) => {
      this.panel.hidden = !on;
    });
    this.state = h("div", { role: "status" });
    this.here = h("button", { type: "button", class: "primary", onclick: () => void this.begin() }, "Begin with this view");
    this.turns = h("input", {
      type: "checkbox", id: "visitors-turn", checked: stage.presentation.auto_rotate === true,
      onchange: () => void this.save({ auto_rotate: this.turns.checked }, this.turns.checked ? "The scene turns for visitors." : "The scene stands still for visitors."),
    });
    this.panel = h("section", { class: "panel card", hidden: true, "aria-label": "For visitors" },
      h("h2", {}, "For visitors"),
      h("div", { class: "row" }, this.here,
        h("button", { type: "button", class: "quiet", onclick: () => void this.save({ start_view: null }, "The view begins where a photo was taken. Open the page again to see it.") }, "Begin with a photo's view")),
      h("div", { class: "row" }, this.turns, h("label", { for: "visitors-turn" }, "Turn the scene slowly until somebody moves it")),
      this.state,
      h("p", { class: "hint" }, "Links, frames in other pages and the page in one file begin with this view, and with a picture of it. So does this page."));
  }

  async begin() {
    const { view, shown } = this.stage;
    if (!view) {
      this.state.replaceChildren(h("p", { class: "error" }, LOADING));
      return;
    }
    const { camera_to_world, width, height } = view.getCamera();
    const { focal } = view;
    // As a pinhole: of a camera with a field of view alone, only the height is kept in sight.
    const start_view = { camera_to_world, width, height, fx: focal, fy: focal, cx: width / 2, cy: height / 2 };
    this.here.disabled = true;
    this.state.replaceChildren(h("p", { class: "hint" }, "The server renders the picture."));
    await this.save({ start_view, background: shown.background }, "Visitors begin with this view.");
    this.here.disabled = false;
  }

  /** @param {Partial<import("../viewer/presented.js").Presentation>} change @param {string} done */
  async save(change, done) {
    try {
      await this.stage.save(change);
      if (change.start_view) this.stage.view?.settle();
      this.state.replaceChildren(h("p", {}, done));
    } catch (error) {
      this.turns.checked = this.stage.presentation.auto_rotate === true;
      this.state.replaceChildren(noticeOf(/** @type {Error} */ (error)));
    }
  }
}
