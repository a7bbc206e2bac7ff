// Zones, known lights and maintenance: drawn on the map, listed, approved, drawn anew and ended.

import { el, metres, named, stamp } from "./words.js";

const EVERY_MS = 5000;
// Share of the view from which ignored ground is warned of.
const MUCH = 0.1;
const KINDS = { ignore: "Ignore: beams that nobody claims raise nothing", restricted: "Restricted: any beam whose user is not listed is critical", watch: "Watch: alerts there are named" };

export class Places {
  constructor(link, map) {
    this.link = link;
    this.map = map;
    this.zones = [];
    this.lights = [];
    this.windows = [];
    this.half = null;
    const $ = (id) => document.getElementById(id);
    [this.list, this.warning, this.error] = ["place-list", "place-warning", "place-error"].map($);
    this.form = { node: $("zone-form"), name: $("zone-name"), kind: $("zone-kind"), users: $("zone-users"), words: $("zone-words"), save: $("zone-save") };
    for (const [kind, words] of Object.entries(KINDS)) this.form.kind.append(new Option(words, kind));
    $("zone-draw").addEventListener("click", () => this.draw());
    $("zone-cancel").addEventListener("click", () => this.drawn());
    $("zone-undo").addEventListener("click", () => this.map.undoCorner());
    this.form.node.addEventListener("submit", (e) => {
      e.preventDefault();
      this.save();
    });
    $("quiet-form").addEventListener("submit", (e) => {
      e.preventDefault();
      this.maintain($("quiet-by").value, Number($("quiet-hours").value), $("quiet-note").value);
    });
    map.on.corners = (corners) => this.corners(corners);
    setInterval(() => document.hidden || this.load(), EVERY_MS);
    this.load();
  }

  // `now` is the frames' clock, `half` the half-widths of the view.
  tick(now, half) {
    this.now = now;
    if (String(this.half) === String(half)) return;
    this.half = half;
    this.render();
  }

  async load() {
    try {
      const [zones, lights, windows] = await Promise.all([this.link.request("/v1/zones"), this.link.json("/v1/known-lights"), this.link.json("/v1/maintenance")]);
      this.tag = zones.headers.get("ETag");
      this.zones = (await zones.json()).features;
      this.lights = lights.known_lights;
      this.windows = windows.maintenance;
    } catch {
      return; // The stream says when the daemon is away.
    }
    this.render();
  }

  // Does what changes something, and says why it failed.
  async change(path, options) {
    this.error.hidden = true;
    try {
      if (options.body) options.headers = { "Content-Type": "application/json", ...options.headers };
      await this.link.request(path, options);
      return true;
    } catch (e) {
      this.error.textContent = `Not done: ${e.message}`;
      this.error.hidden = false;
      return false;
    } finally {
      await this.load();
    }
  }

  render() {
    this.map.showPlaces(this.zones, this.lights);
    const rows = [...this.zones.map((z) => this.zoneRow(z)), ...this.lights.map((l) => this.lightRow(l)), ...this.windows.map((w) => this.windowRow(w))];
    const said = JSON.stringify([this.zones, this.lights.map((l) => ({ ...l, last_seen: null })), this.windows]);
    if (said !== this.said) this.list.replaceChildren(...(rows.length ? rows : [el("li", { className: "quiet" }, "No zone, no known light, no maintenance.")]));
    this.said = said;
    this.warn();
  }

  // The maintenance that is in force.
  maintenance(now) {
    return this.windows.find((w) => Date.parse(w.from) <= now && now < Date.parse(w.until));
  }

  // Ground on which a stranger raises nothing.
  warn() {
    if (!this.half) return;
    const view = 4 * this.half[0] * this.half[1];
    const ignored = this.zones.filter((z) => z.properties.kind === "ignore").reduce((sum, z) => sum + z.properties.area_m2, 0);
    const lit = this.lights.reduce((sum, l) => sum + l.unseen_area_m2, 0);
    const share = (ignored + lit) / view;
    this.warning.hidden = share < MUCH;
    this.warning.textContent = `Ignored zones and known lights cover ${Math.round(100 * share)} % of the view: a stranger there raises nothing.`;
  }

  row(title, facts, isFixed, ...buttons) {
    return el("li", {}, el("p", {}, ...title), el("p", { className: "quiet" }, ...facts), isFixed ? el("p", { className: "quiet" }, "Set in the config.") : el("p", { className: "acts" }, ...buttons));
  }

  button(words, act) {
    const node = el("button", { type: "button" }, words);
    node.addEventListener("click", act);
    return node;
  }

  zoneRow({ properties: p, geometry }) {
    const cost = p.kind === "ignore" ? `Any light on ${Math.round(p.area_m2)} m² goes unseen. ` : "";
    const users = p.users ? [`For ${p.users.join(", ")}.`] : [];
    const edit = geometry.type === "Polygon" && geometry.coordinates.length === 1 ? [this.button("Edit", () => this.draw(p, geometry.coordinates[0].slice(0, -1)))] : [];
    return this.row(["Zone ", el("strong", {}, named(p.name)), `, ${p.kind}`], [cost, ...users], p.source === "config", ...edit, this.button("Remove", () => this.put(this.zones.filter((z) => z.properties.name !== p.name))));
  }

  lightRow(l) {
    const learned = l.learned
      ? ` A beam in its spot with less than ${Math.round(100 * l.unseen_share)} % of its light, or in its place and like it, goes unseen; that is ${metres(l.unseen_area_m2)} m².`
      : " What it is like is being learned.";
    const why = l.note ? [el("q", {}, named(l.note)), " "] : [];
    const who = [l.by ? ["by ", named(l.by)] : [], l.until ? [` until ${stamp(Date.parse(l.until), this.now)}`] : []].flat();
    return this.row(["Known light at ", `${metres(l.x_m)}, ${metres(l.y_m)} m, radius ${metres(l.radius_m)} m`, l.is_seen ? "" : ", out now"], [...why, ...who, learned], l.source === "config",
      this.button("Show", () => this.map.pick([l.x_m, l.y_m])), this.button("End approval", () => this.change(`/v1/known-lights/${encodeURIComponent(l.id)}`, { method: "DELETE" })));
  }

  windowRow(w) {
    const note = w.note ? [el("q", {}, named(w.note))] : [];
    return this.row(["Maintenance ", `${stamp(Date.parse(w.from), this.now)} to ${stamp(Date.parse(w.until), this.now)} by `, named(w.by)], ["Alerts are recorded and not sent. ", ...note], w.is_fixed, this.button("End now", () => this.change(`/v1/maintenance/${encodeURIComponent(w.id)}`, { method: "DELETE" })));
  }

  async approve(alert, note, until) {
    const body = { alert: alert.id };
    if (note.trim()) body.note = note.trim();
    if (until) body.until = until;
    await this.link.json("/v1/known-lights", { method: "POST", body: JSON.stringify(body), headers: { "Content-Type": "application/json" } });
    await this.load();
  }

  maintain(by, hours, note) {
    const until = new Date((this.now ?? Date.now()) + hours * 3600e3).toISOString();
    return this.change("/v1/maintenance", { method: "POST", body: JSON.stringify({ by, until, note: note.trim() || null }) });
  }

  put(features) {
    const headers = this.tag ? { "If-Match": this.tag } : {};
    return this.change("/v1/zones", { method: "PUT", headers, body: JSON.stringify({ type: "FeatureCollection", features }) });
  }

  // Begins to draw a zone, or to change one.
  draw(properties = null, corners = []) {
    this.edited = properties?.name ?? null;
    this.kept = properties ?? {};
    this.form.node.hidden = false;
    this.form.name.value = properties?.name ?? "";
    this.form.kind.value = properties?.kind ?? "ignore";
    this.form.users.value = (properties?.users ?? []).join(", ");
    this.map.draft(corners.map((c) => [c[0], c[1]]));
    this.form.name.focus();
  }

  drawn() {
    this.form.node.hidden = true;
    this.map.draft(null);
  }

  corners(corners) {
    this.form.words.textContent = `${corners.length} corners. Click the map to add one, drag one to move it.`;
    this.form.save.disabled = corners.length < 3;
  }

  async save() {
    const corners = this.map.corners;
    const users = this.form.users.value.split(",").map((u) => u.trim()).filter(Boolean);
    const { tolerated_distance_m, severity, webhooks } = this.kept;
    const properties = { ...(this.form.kind.value === "watch" ? { tolerated_distance_m, severity } : {}), ...(this.form.kind.value === "ignore" ? {} : { webhooks }), name: this.form.name.value.trim(), kind: this.form.kind.value };
    if (users.length) properties.users = users;
    const feature = { type: "Feature", properties, geometry: { type: "Polygon", coordinates: [[...corners, corners[0]]] } };
    const others = this.zones.filter((z) => z.properties.name !== this.edited);
    if (await this.put([...others, feature])) this.drawn();
  }
}
