// The list of alerts: what stands, or all page by page; filtered, sorted, grouped; acknowledged one by one or together.

import { SEVERITIES, clock, el, fullStamp, kindName, lasting, metres, named, shown, stamp } from "./words.js";
import { claimIcon, icon } from "./marks.js";
import { evidence } from "./evidence.js";
import { sentences } from "./sentences.js";
import { Thumbnails } from "./thumbnails.js";

const ICON = { unclaimed_emitter: "unclaimed", position_mismatch: "mismatch", known_light_changed: "known", user_out_of_zone: "mismatch" };
const AT_ONCE = 4;
// Sentences on a card; the others, and the numbers, are one click away.
const SENTENCES = 2;

export class Alerts {
  constructor(link, on) {
    this.link = link;
    this.on = on; // { pick(place, alert), changed(), raised(alert), approve(alert, note, until) }
    this.known = new Map();
    this.cards = new Map();
    this.fresh = new Set(); // raised just now
    this.thumbnails = new Thumbnails(link);
    this.all = false;
    this.at = null; // the time shown; null is the present
    this.cursor = null;
    this.now = Date.now();
    const $ = (id) => document.getElementById(id);
    [this.list, this.count, this.older, this.announce, this.badge] = ["list", "count", "older", "announce", "open-count"].map($);
    this.standing = $("standing");
    this.past = $("past");
    this.tools = { text: $("find"), kind: $("kind"), severity: $("severity"), sort: $("sort"), group: $("group") };
    this.together = { box: $("together"), button: $("acknowledge-all"), note: $("note-all"), error: $("together-error") };
    this.standing.addEventListener("click", () => this.choose(false));
    this.past.addEventListener("click", () => this.choose(true));
    this.older.addEventListener("click", () => this.more());
    for (const tool of Object.values(this.tools)) tool.addEventListener("input", () => this.render());
    $("clear").addEventListener("click", () => {
      for (const tool of [this.tools.text, this.tools.kind, this.tools.severity]) tool.value = "";
      this.render();
    });
    this.clear = $("clear");
    $("table").addEventListener("click", (e) => this.table(e.target));
    this.together.button.addEventListener("click", () => this.acknowledgeAll(this.shown().filter((a) => a.state === "open")));
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
    if (name === "alert.raised") {
      this.announce.textContent = `Alert, ${alert.severity}: ${kindName(alert.kind)}${alert.user ? `, user ${shown(alert.user)}` : ""}`;
      this.fresh.add(alert.id);
      this.on.raised(alert);
    }
    this.render();
  }

  choose(all) {
    this.all = all;
    this.standing.setAttribute("aria-pressed", String(!all));
    this.past.setAttribute("aria-pressed", String(all));
    this.render();
  }

  // Shows what stood at a time of the past; null is the present.
  moment(at) {
    if (this.at === at) return;
    this.at = at;
    this.render();
  }

  // `now` is the frames' clock, which a replay has of its own.
  tick(now) {
    this.now = now;
    for (const card of this.cards.values()) {
      const text = this.when(card.alert);
      if (card.when.textContent !== text) card.when.textContent = text;
    }
  }

  when(alert) {
    const raised = Date.parse(alert.raised_at);
    const until = this.at ?? this.now;
    if (alert.cleared_at && !(this.at !== null && Date.parse(alert.cleared_at) > this.at)) {
      return `${stamp(raised, this.now)}, lasted ${lasting(Date.parse(alert.cleared_at) - raised)}`;
    }
    return `since ${stamp(raised, this.now)}, ${lasting(until - raised)}`;
  }

  stood(alert) {
    if (this.at === null) return alert.state !== "cleared";
    return Date.parse(alert.raised_at) <= this.at && !(alert.cleared_at && Date.parse(alert.cleared_at) <= this.at);
  }

  // The alerts on the list, in order.
  shown() {
    const { text, kind, severity, sort } = this.tools;
    const words = text.value.trim().toLowerCase().split(/\s+/).filter(Boolean);
    const said = (a) => `${a.id} ${kindName(a.kind)} ${a.user ?? ""} ${a.site ?? ""} ${a.station ?? ""} ${a.severity} ${a.state} ${a.acknowledgement?.note ?? ""} ${a.acknowledgement?.by ?? ""}`.toLowerCase();
    const fits = (a) =>
      (this.all && this.at === null ? true : this.stood(a)) &&
      (!kind.value || a.kind === kind.value) &&
      (!severity.value || a.severity === severity.value) &&
      words.every((word) => said(a).includes(word));
    const newest = (a, b) => Date.parse(b.raised_at) - Date.parse(a.raised_at) || (a.id < b.id ? 1 : -1);
    const urgent = (a, b) => (a.state !== "open") - (b.state !== "open") || SEVERITIES.indexOf(a.severity) - SEVERITIES.indexOf(b.severity) || newest(a, b);
    const order = {
      urgent: this.all ? newest : urgent,
      newest,
      oldest: (a, b) => newest(b, a),
      user: (a, b) => (a.user ?? "\uffff").localeCompare(b.user ?? "\uffff", undefined, { numeric: true }) || newest(a, b),
    }[sort.value];
    return [...this.known.values()].filter(fits).sort(order);
  }

  render() {
    const standing = [...this.known.values()].filter((a) => a.state !== "cleared");
    const open = standing.filter((a) => a.state === "open");
    this.count.textContent = this.at !== null ? `· ${[...this.known.values()].filter((a) => this.stood(a)).length} stood then` : standing.length ? `· ${open.length} open${standing.length > open.length ? `, ${standing.length - open.length} acknowledged` : ""}` : "";
    const critical = open.filter((a) => a.severity === "critical").length;
    const now = this.at === null ? "" : "Now: ";
    this.badge.textContent = now + (open.length ? `${open.length} open ${open.length === 1 ? "alert" : "alerts"}${critical ? `, ${critical} critical` : ""}` : `${now ? "n" : "N"}o open alert`);
    this.badge.className = `pill ${critical ? "bad" : open.length ? "" : "ok"}`;
    document.title = open.length ? `(${open.length}) oapwatch` : "oapwatch";
    this.options();

    const list = this.shown();
    const ids = new Set(list.map((a) => a.id));
    for (const id of this.cards.keys()) if (!ids.has(id)) this.cards.delete(id);
    const nodes = this.grouped(list);
    if (!nodes.length) nodes.push(el("li", { className: "none" }, this.nothing()));
    // Moving a node that has the focus would lose it.
    if (nodes.length !== this.list.children.length || nodes.some((n, k) => n !== this.list.children[k])) {
      const focused = document.activeElement;
      this.list.replaceChildren(...nodes);
      if (this.list.contains(focused)) focused.focus();
    }
    const many = list.filter((a) => a.state === "open").length;
    this.together.box.hidden = many < 2 || this.at !== null;
    this.together.button.textContent = `Acknowledge all ${many} shown`;
    this.clear.hidden = !(this.tools.text.value || this.tools.kind.value || this.tools.severity.value);
    this.older.hidden = !(this.all && this.cursor) || this.at !== null;
    this.on.changed();
  }

  nothing() {
    if (this.tools.text.value || this.tools.kind.value || this.tools.severity.value) return "No alert fits the filter.";
    if (this.at !== null) return "No alert stood then.";
    return this.all ? "No alert has ever been raised." : "No alert stands.";
  }

  // Kinds that there are, so that the filter offers nothing else.
  options() {
    const kinds = [...new Set([...this.known.values()].map((a) => a.kind))].sort();
    const { kind } = this.tools;
    const wanted = ["", ...kinds].join();
    if ([...kind.options].map((o) => o.value).join() === wanted) return;
    const chosen = kind.value;
    kind.replaceChildren(new Option("All kinds", ""), ...kinds.map((k) => new Option(kindName(k), k)));
    kind.value = kinds.includes(chosen) ? chosen : "";
  }

  grouped(list) {
    const by = this.tools.group.value;
    if (!by) {
      this.heads = new Map();
      return list.map((alert) => this.card(alert).node);
    }
    const key = { kind: (a) => kindName(a.kind), severity: (a) => a.severity, user: (a) => a.user ?? "" }[by];
    const groups = Map.groupBy ? Map.groupBy(list, key) : list.reduce((m, a) => m.set(key(a), [...(m.get(key(a)) ?? []), a]), new Map());
    return [...groups].flatMap(([name, alerts]) => [this.head(name, alerts), ...alerts.map((alert) => this.card(alert).node)]);
  }

  head(name, alerts) {
    this.heads ??= new Map();
    const known = this.heads.get(name) ?? { node: el("li", { className: "group" }), said: "" };
    this.heads.set(name, known);
    const open = alerts.filter((a) => a.state === "open");
    const said = `${alerts.length}/${open.map((a) => a.id).join()}`;
    if (said === known.said) return known.node;
    known.said = said;
    const title = el("h3", {}, named(name || "No user"), ` · ${alerts.length}${open.length ? `, ${open.length} open` : ""}`);
    known.node.replaceChildren(title);
    if (open.length > 1) {
      const button = el("button", { type: "button" }, `Acknowledge ${open.length}`);
      button.addEventListener("click", () => this.acknowledgeAll(open));
      known.node.append(button);
    }
    return known.node;
  }

  card(alert) {
    const known = this.cards.get(alert.id);
    const said = JSON.stringify(alert);
    if (known && known.said === said) return known;
    // While an approval is being written the card stays as it is; clearing alone ends it.
    const approving = known?.node.querySelector(".approve[open]");
    if (approving && approving.contains(document.activeElement) && alert.state === known.alert.state) return known;
    const openParts = known ? [...known.node.querySelectorAll("details")].filter((d) => d.open).map((d) => d.className) : [];
    const mark = ICON[alert.kind] ? icon(ICON[alert.kind]) : alert.kind === "user_unseen" ? claimIcon(true) : icon("pending");
    const when = el("span", { title: fullStamp(Date.parse(alert.raised_at)) }, this.when(alert));
    const where = alert.user ? [el("strong", {}, named(alert.user))] : [];
    if (alert.station) where.unshift(...[el("bdi", {}, `${shown(alert.site)}.${shown(alert.station)}`), " "]);
    if (alert.x_m !== null) where.push(`${alert.user ? " " : ""}at ${metres(alert.x_m)}, ${metres(alert.y_m)} m`);
    if (alert.claimed?.x_m !== undefined) where.push(`${where.length > 1 ? "," : ""} claims ${metres(alert.claimed.x_m)}, ${metres(alert.claimed.y_m)} m`);
    const error = el("p", { className: "error", hidden: true });

    const picture = el("img", { alt: `The frame at which this alert was raised, with its place marked` });
    const thumbnail = el("div", { className: "thumbnail" }, picture);
    this.thumbnails.show(picture, alert.id, this.fresh.delete(alert.id));
    const told = sentences(alert).map((parts) => el("li", {}, ...parts));
    const more = told.splice(SENTENCES);

    const node = el("li", { className: `${alert.kind} ${alert.state} ${alert.severity}` },
      el("div", { className: "head" }, mark, el("strong", {}, kindName(alert.kind)), el("span", { className: `severity ${alert.severity}` }, alert.severity), alert.state === "open" ? "" : el("span", { className: "state" }, alert.state)),
      el("div", { className: "body" },
        el("div", { className: "words" },
          el("p", {}, ...where, where.length ? el("br") : "", when),
          ...this.acknowledgement(alert),
          el("ul", { className: "evidence" }, ...told)),
        thumbnail),
      this.acts(alert, error), error,
      evidence(this.link, alert, more, openParts.includes("numbers")));
    // What is being typed outlives a change of the alert.
    const [note, before] = [node, known?.node].map((n) => n?.querySelector(".note"));
    if (note && before) note.value = before.value;
    const wasTyping = before && document.activeElement === before;
    const hadFocus = known?.node.contains(document.activeElement);
    const card = { node, when, alert, said };
    if (known?.node.isConnected) known.node.replaceWith(node);
    if (wasTyping && note) note.focus();
    else if (hadFocus) node.querySelector("summary").focus();
    this.cards.set(alert.id, card);
    return card;
  }

  acknowledgement(alert) {
    const a = alert.acknowledgement;
    if (!a) return [];
    const by = (who) => (who ? [" by ", named(who)] : []);
    const parts = ["Acknowledged", ...by(a.by), ` at ${stamp(Date.parse(a.at), this.now)}`];
    if (a.note) parts.push(": ", el("q", {}, named(a.note)));
    if (a.withdrawn) parts.push("; withdrawn", ...by(a.withdrawn.by), ` at ${clock(Date.parse(a.withdrawn.at))}`);
    return [el("p", { className: "acknowledgement" }, ...parts)];
  }

  acts(alert, error) {
    const acts = el("div", { className: "acts" });
    const button = (words, act) => {
      const node = el("button", { type: "button" }, words);
      node.addEventListener("click", () => act(node));
      return node;
    };
    if (alert.state === "open") {
      const note = el("input", { className: "note", placeholder: "Note (optional)", maxLength: 1000, "aria-label": "Note for the acknowledgement" });
      const act = button("Acknowledge", (node) => this.acknowledge(alert.id, note.value, node, error));
      note.addEventListener("keydown", (e) => e.key === "Enter" && act.click());
      acts.append(act, note);
    } else if (alert.state === "acknowledged") {
      acts.append(button("Undo", (node) => this.undo(alert.id, node, error)));
    }
    const place = alert.x_m !== null ? [alert.x_m, alert.y_m] : alert.claimed?.x_m !== undefined ? [alert.claimed.x_m, alert.claimed.y_m] : null;
    const isEmitter = alert.kind === "known_light_changed" || (alert.kind === "unclaimed_emitter" && !alert.evidence?.shares_the_spot_of);
    if (isEmitter && alert.state !== "cleared") acts.append(this.approval(alert, error));
    if (place) acts.append(button("Show", () => this.on.pick(place, alert)));
    return acts;
  }

  // Approves the emitter as a known light, with a reason and an end.
  approval(alert, error) {
    const note = el("input", { placeholder: "What is it?", maxLength: 1000, "aria-label": "What the light is", required: true });
    const until = el("input", { type: "datetime-local", "aria-label": "End of the approval; none when left empty", title: "End of the approval; none when left empty" });
    const form = el("form", { className: "approval" }, note, until, el("button", { type: "submit" }, "Approve as known light"));
    form.addEventListener("submit", async (e) => {
      e.preventDefault();
      try {
        await this.on.approve(alert, note.value, until.value ? new Date(until.value).toISOString() : null);
      } catch (failure) {
        error.textContent = `Not approved: ${failure.message}`;
        error.hidden = false;
      }
    });
    return el("details", { className: "approve" }, el("summary", {}, "A known light?"), form);
  }

  async table(button) {
    const kind = this.tools.kind.value;
    try {
      await this.link.save(`/v1/alerts.csv${kind ? `?kind=${kind}` : ""}`, "alerts.csv");
    } catch (e) {
      button.textContent = `Not saved: ${e.message}`;
    }
  }

  async send(id, note) {
    const options = { method: "POST" };
    if (note.trim()) Object.assign(options, { body: JSON.stringify({ note }), headers: { "Content-Type": "application/json" } });
    this.take(await this.link.json(`/v1/alerts/${encodeURIComponent(id)}/acknowledge`, options));
  }

  async acknowledge(id, note, button, error) {
    button.disabled = true;
    try {
      await this.send(id, note);
      this.render();
    } catch (e) {
      button.disabled = false;
      error.textContent = `Not acknowledged: ${e.message}`;
      error.hidden = false;
    }
  }

  async undo(id, button, error) {
    button.disabled = true;
    try {
      this.take(await this.link.json(`/v1/alerts/${encodeURIComponent(id)}/acknowledge`, { method: "DELETE" }));
      this.render();
    } catch (e) {
      button.disabled = false;
      error.textContent = `Not undone: ${e.message}`;
      error.hidden = false;
    }
  }

  async acknowledgeAll(alerts) {
    const { button, note, error } = this.together;
    button.disabled = true;
    const waiting = [...alerts];
    const failed = [];
    const work = async () => {
      for (let alert = waiting.shift(); alert; alert = waiting.shift()) {
        // An alert that has cleared meanwhile needs no acknowledgement.
        await this.send(alert.id, note.value).catch((e) => e.status === 409 || failed.push(e.message));
      }
    };
    await Promise.all(Array.from({ length: AT_ONCE }, work));
    button.disabled = false;
    error.hidden = !failed.length;
    error.textContent = failed.length ? `${failed.length} not acknowledged: ${failed[0]}` : "";
    if (!failed.length) note.value = "";
    this.render();
  }
}
