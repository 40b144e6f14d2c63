// The frame of a link for pages of others: the viewer alone, and a way to the link's own page.

import { byId, h } from "../dom.js";
import { showShared } from "./shared_model.js";

if (await showShared()) {
  byId("view").append(h("a", { class: "by", href: location.pathname.replace(/\/embed\/?$/, ""), target: "_blank", rel: "noopener" }, "Open the page"));
}
