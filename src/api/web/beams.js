// The table of beams: one row a beam, kept while the beam lasts, so that the pointer and the focus stay where they are.

import { STATUS, el, metres, named } from "./words.js";

const EVERY_MS = 400;
const ORDER = { unclaimed: 0, mismatch: 1, pending: 3, verified: 4, ignored: 5, known: 6 };
const UNSEEN = 2;

export class Beams {
  constructor(on) {
    this.on = on; // { point(key or null), pick(key, place) }
    this.rows = new Map(); // key → { node, cells }
    this.drawn = 0;
    this.picked = null;
    const $ = (id) => document.getElementById(id);
    [this.body, this.count, this.find] = ["rows", "beam-count", "find-beam"].map($);
    this.find.addEventListener("input", () => this.again());
  }

  // Draws what was given last, at once.
  again() {
    this.drawn = 0;
    if (this.scene) this.show(this.scene);
  }

  words() {
    return this.find.value.trim().toLowerCase();
  }

  show(scene) {
    this.scene = scene;
    if (Date.now() - this.drawn < EVERY_MS) return;
    this.drawn = Date.now();
    const said = new Map(scene.claims.map((c) => [c.user, c]));
    const entries = scene.emitters.map((e) => {
      const claim = said.get(e.user);
      const off = claim ? metres(Math.hypot(claim.x_m - e.x_m, claim.y_m - e.y_m)) : "";
      const sigma = e.cov_m2 ? metres(Math.sqrt(e.cov_m2[0][0] + e.cov_m2[1][1])) : "";
      return { key: `b${e.track}`, order: ORDER[e.status], name: e.user, place: [e.x_m, e.y_m], kind: e.status, texts: [e.station ? `${e.station} ${e.track}` : `${e.track}`, e.user ?? "nobody", STATUS[e.status], metres(e.x_m), metres(e.y_m), sigma, off] };
    });
    for (const user of scene.unseen) {
      const claim = said.get(user);
      const at = claim ? [metres(claim.x_m), metres(claim.y_m)] : ["", ""];
      entries.push({ key: `u${user}`, order: UNSEEN, name: user, place: claim ? [claim.x_m, claim.y_m] : null, kind: "absent", texts: ["–", user, "not seen", ...at, "", ""] });
    }
    const words = this.words();
    const fits = (e) => !words || e.texts.slice(0, 3).join(" ").toLowerCase().includes(words);
    const collate = (a, b) => a.texts[1].localeCompare(b.texts[1], undefined, { numeric: true });
    const shown = entries.filter(fits).sort((a, b) => a.order - b.order || collate(a, b) || (a.key < b.key ? -1 : 1));
    const keys = new Set(shown.map((e) => e.key));
    for (const [key, row] of this.rows) {
      if (keys.has(key)) continue;
      row.node.remove();
      this.rows.delete(key);
    }
    shown.forEach((entry, k) => {
      const row = this.row(entry);
      if (this.body.children[k] !== row.node) this.body.insertBefore(row.node, this.body.children[k] ?? null);
    });
    const { emitters, unseen } = scene;
    this.count.textContent = `${emitters.length} seen${unseen.length ? `, ${unseen.length} claimed and not seen` : ""}${words ? `; ${shown.length} found` : ""}`;
  }

  row(entry) {
    let row = this.rows.get(entry.key);
    if (!row) {
      const cells = entry.texts.map((_, k) => el("td", k > 2 ? { className: "n" } : {}));
      const node = el("tr", { tabIndex: 0, title: "Show on the map" }, ...cells);
      row = { node, cells, said: [] };
      const pick = () => row.entry.place && this.on.pick(row.entry.key, row.entry.place);
      node.addEventListener("click", pick);
      node.addEventListener("keydown", (e) => e.key === "Enter" && pick());
      node.addEventListener("pointerenter", () => this.on.point(row.entry.key));
      node.addEventListener("pointerleave", () => this.on.point(null));
      node.addEventListener("focus", () => this.on.point(row.entry.key));
      node.addEventListener("blur", () => this.on.point(null));
      this.rows.set(entry.key, row);
    }
    row.entry = entry;
    entry.texts.forEach((text, k) => {
      if (row.said[k] === text) return;
      row.said[k] = text;
      row.cells[k].replaceChildren(k === 1 ? named(text) : text);
    });
    row.cells[2].className = entry.kind;
    row.node.className = `${entry.kind === "absent" ? "quiet" : ""} ${entry.key === this.picked ? "picked" : ""}`;
    return row;
  }

  // A beam was chosen on the map.
  pick(key) {
    this.picked = key;
    if (key && !this.rows.has(key)) this.find.value = "";
    this.again();
    this.rows.get(key)?.node.scrollIntoView({ block: "nearest" });
  }
}
