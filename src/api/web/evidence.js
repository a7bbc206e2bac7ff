// An alert's evidence in full: every number, the frame with its model and residual, and the files.

import { el, fact, fullStamp, shown } from "./words.js";

export function evidence(link, alert, more, isOpen) {
  const rows = Object.entries(alert.evidence ?? {}).map(([k, v]) => fact(k, v));
  rows.push(["raised", fullStamp(Date.parse(alert.raised_at))], ["from frame", `${alert.source.frame} (${alert.source.kind})`], ["id", alert.id]);
  if (alert.source.file) rows.push(["file", shown(alert.source.file)]);
  const table = el("table", {}, el("tbody", {}, ...rows.map(([k, v]) => el("tr", {}, el("td", {}, shown(k)), el("td", {}, el("bdi", {}, v))))));
  const details = el("details", { open: isOpen, className: "numbers" }, el("summary", {}, "Evidence in full"), more.length ? el("ul", { className: "evidence" }, ...more) : "");
  if (alert.source.file) details.append(fit(link, alert, details));
  details.append(table, downloads(link, alert));
  return details;
}

// The frame, the model and the residual, drawn when the reader opens the details.
function fit(link, alert, details) {
  const image = el("img", { alt: "The frame, the model that explains it, and the residual" });
  const box = el("figure", { className: "fit", hidden: true }, image, el("figcaption", {}, "Frame, model, residual (blue −5 σ, black 0, orange +5 σ)"));
  let tries = 3;
  const load = async () => {
    if (!details.open || image.src) return;
    try {
      const answer = await link.request(`/v1/alerts/${encodeURIComponent(alert.id)}/evidence.png?panels=all`);
      image.src = URL.createObjectURL(await answer.blob());
      image.onload = () => URL.revokeObjectURL(image.src);
      box.hidden = false;
    } catch {
      // A new alert's recording takes a moment; an old one's may have made way for newer ones.
      if (--tries > 0) setTimeout(load, 1500);
    }
  };
  details.addEventListener("toggle", load);
  return box;
}

function downloads(link, alert) {
  const box = el("p", { className: "downloads" });
  if (!alert.source.file) return box;
  for (const [ending, words] of [["npy", "Frames (.npy)"], ["json", "Claims (.json)"]]) {
    const button = el("button", { type: "button" }, words);
    button.addEventListener("click", async () => {
      try {
        await link.save(`/v1/alerts/${encodeURIComponent(alert.id)}/evidence.${ending}`, `${alert.id}.${ending}`);
      } catch (e) {
        button.replaceWith(el("span", { className: "quiet" }, e.message));
      }
    });
    box.append(button);
  }
  return box;
}
