// The list of alerts: what stands first, then the past page by page.

import { KIND, clock, el, fact, lasting, metres } from "./words.js";
import { claimIcon, icon } from "./marks.js";

const ICON = { unclaimed_emitter: "unclaimed", position_mismatch: "mismatch" };

export class Alerts {
  constructor(link, on) {
    this.link = link;
    this.on = on; // { pick(place), changed() }
    this.known = new Map();
    this.cards = new Map();
    this.all = false;
    this.cursor = null;
    this.now = Date.now();
    const $ = (id) => document.getElementById(id);
    [this.list, this.count, this.older, this.announce] = ["list", "count", "older", "announce"].map($);
    this.standing = $("standing");
    this.past = $("past");
    this.standing.addEventListener("click", () => this.choose(false));
    this.past.addEventListener("click", () => this.choose(true));
    this.older.addEventListener("click", () => this.more());
  }

  // The first message: what stands now. What we believed to stand and is not there has cleared meanwhile.
  reset(standing) {
    const ids = new Set(standing.map((a) => a.id));
    for (const alert of standing) this.known.set(alert.id, alert);
    for (const alert of this.known.values()) {
      if (alert.state !== "cleared" && !ids.has(alert.id)) this.refresh(alert.id);
    }
    this.recent();
    this.render();
  }

  async refresh(id) {
    try {
      this.take(await this.link.json(`/v1/alerts/${encodeURIComponent(id)}`));
    } catch (e) {
      if (e.status === 404) this.known.delete(id);
    }
    this.render();
  }

  async recent() {
    try {
      const page = await this.link.json("/v1/alerts?limit=100");
      for (const alert of page.alerts) this.take(alert);
      this.cursor = page.next_cursor;
      this.render();
    } catch {
      // The stream says when the daemon is away.
    }
  }

  async more() {
    const page = await this.link.json(`/v1/alerts?limit=100&cursor=${encodeURIComponent(this.cursor)}`);
    for (const alert of page.alerts) this.take(alert);
    this.cursor = page.next_cursor;
    this.render();
  }

  take(alert) {
    this.known.set(alert.id, alert);
  }

  event(name, alert) {
    this.take(alert);
    if (name === "alert.raised") this.announce.textContent = `Alert: ${KIND[alert.kind] ?? alert.kind}${alert.user ? `, user ${alert.user}` : ""}`;
    this.render();
  }

  choose(all) {
    this.all = all;
    this.standing.setAttribute("aria-pressed", String(!all));
    this.past.setAttribute("aria-pressed", String(all));
    this.render();
  }

  // `now` is the frames' clock, which a replay has of its own.
  tick(now) {
    this.now = now;
    for (const card of this.cards.values()) card.when.textContent = this.when(card.alert);
  }

  when(alert) {
    const raised = Date.parse(alert.raised_at);
    if (alert.cleared_at) return `${clock(raised)}, lasted ${lasting(Date.parse(alert.cleared_at) - raised)}`;
    return `since ${clock(raised)}, ${lasting(this.now - raised)}`;
  }

  render() {
    const rank = { critical: 0, warning: 1, info: 2 };
    const standing = [...this.known.values()].filter((a) => a.state !== "cleared");
    const shown = this.all ? [...this.known.values()] : standing;
    shown.sort((a, b) => Date.parse(b.raised_at) - Date.parse(a.raised_at) || (a.id < b.id ? 1 : -1));
    if (!this.all) shown.sort((a, b) => (a.state !== "open") - (b.state !== "open") || rank[a.severity] - rank[b.severity]);
    const open = standing.filter((a) => a.state === "open").length;
    this.count.textContent = standing.length ? `· ${open} open${standing.length > open ? `, ${standing.length - open} acknowledged` : ""}` : "";
    document.title = open ? `(${open}) oapwatch` : "oapwatch";
    const ids = new Set(shown.map((a) => a.id));
    for (const id of this.cards.keys()) if (!ids.has(id)) this.cards.delete(id);
    const nodes = shown.map((alert) => this.card(alert).node);
    if (!nodes.length) nodes.push(el("li", { className: "none" }, this.all ? "No alert has ever been raised." : "No alert stands."));
    // Moving a node that has the focus would lose it.
    if (nodes.length !== this.list.children.length || nodes.some((n, k) => n !== this.list.children[k])) {
      const focused = document.activeElement;
      this.list.replaceChildren(...nodes);
      if (this.list.contains(focused)) focused.focus();
    }
    this.older.hidden = !(this.all && this.cursor);
    this.on.changed();
  }

  card(alert) {
    const known = this.cards.get(alert.id);
    if (known && JSON.stringify(known.alert) === JSON.stringify(alert)) return known;
    const wasOpen = known?.node.querySelector("details")?.open;
    const mark = ICON[alert.kind] ? icon(ICON[alert.kind]) : alert.kind === "user_unseen" ? claimIcon(true) : icon("pending");
    const when = el("span", {}, this.when(alert));
    const where = alert.user ? [el("strong", {}, alert.user)] : [];
    if (alert.x_m !== null) where.push(` at ${metres(alert.x_m)}, ${metres(alert.y_m)} m`);
    if (alert.claimed?.x_m !== undefined) where.push(`${alert.x_m !== null ? "," : ""} claims ${metres(alert.claimed.x_m)}, ${metres(alert.claimed.y_m)} m`);
    const rows = Object.entries(alert.evidence ?? {}).map(([k, v]) => fact(k, v));
    rows.push(["severity", alert.severity], ["from frame", `${alert.source.frame} (${alert.source.kind})`], ["id", alert.id]);
    const table = el("table", {}, el("tbody", {}, ...rows.map(([k, v]) => el("tr", {}, el("td", {}, k), el("td", {}, v)))));
    const error = el("p", { className: "error", hidden: true });
    const acts = el("div", { className: "acts" });
    if (alert.state === "open") {
      const button = el("button", { type: "button" }, "Acknowledge");
      button.addEventListener("click", () => this.acknowledge(alert.id, button, error));
      acts.append(button);
    }
    const place = alert.x_m !== null ? [alert.x_m, alert.y_m] : alert.claimed?.x_m !== undefined ? [alert.claimed.x_m, alert.claimed.y_m] : null;
    if (place) {
      const button = el("button", { type: "button" }, "Show");
      button.addEventListener("click", () => this.on.pick(place, alert));
      acts.append(button);
    }
    const node = el("li", { className: `${alert.kind} ${alert.state} ${alert.severity}` },
      el("div", { className: "head" }, mark, el("strong", {}, KIND[alert.kind] ?? alert.kind), el("span", { className: "state" }, alert.state)),
      el("p", {}, ...where, where.length ? el("br") : "", when),
      acts, error,
      el("details", { open: Boolean(wasOpen) }, el("summary", {}, "Evidence"), table));
    const hadFocus = known?.node.contains(document.activeElement);
    const card = { node, when, alert };
    if (known?.node.isConnected) known.node.replaceWith(node);
    if (hadFocus) node.querySelector("summary").focus();
    this.cards.set(alert.id, card);
    return card;
  }

  async acknowledge(id, button, error) {
    button.disabled = true;
    try {
      this.take(await this.link.json(`/v1/alerts/${encodeURIComponent(id)}/acknowledge`, { method: "POST" }));
      this.render();
    } catch (e) {
      button.disabled = false;
      error.textContent = `Not acknowledged: ${e.message}`;
      error.hidden = false;
    }
  }
}
