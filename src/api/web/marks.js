// One shape a status, so that colour is never the only difference.

import { svg } from "./words.js";

export function shape(status) {
  switch (status) {
    case "verified":
      return [svg("circle", { class: "shape fill", r: 7 })];
    case "mismatch":
      return [svg("path", { class: "shape fill", d: "M0-10 10 0 0 10-10 0Z" })];
    case "unclaimed":
      return [
        svg("rect", { class: "shape fill", x: -10, y: -10, width: 20, height: 20, rx: 3 }),
        svg("path", { class: "cross", d: "M-5-5 5 5M5-5-5 5" }),
      ];
    case "known":
    case "ignored":
      return [svg("path", { class: "shape fill", d: "M0-8 8 6H-8Z" })];
    default:
      return [svg("circle", { class: "edge", r: 7, "stroke-dasharray": "4 3" })];
  }
}

export function icon(status) {
  return svg("svg", { viewBox: "-12 -12 24 24", "aria-hidden": "true" }, svg("g", { class: `beam ${status}` }, ...shape(status)));
}

export function claimIcon(unseen) {
  const kind = unseen ? "claim unseen-user" : "claim";
  return svg("svg", { viewBox: "-12 -12 24 24", "aria-hidden": "true" }, svg("circle", { class: kind, r: 9 }));
}
