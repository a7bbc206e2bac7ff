// The last hour: a moment a second, kept by the daemon so that it outlives a reload, and gone on with here.

import { clock, stamp, svg, zone } from "./words.js";

const KEPT = 3600;
const STEP_MS = 1000;
// Trails reach this far back.
const TRAIL_MS = 90_000;

export class Timeline {
  constructor(on) {
    this.on = on; // { changed() }
    this.moments = [];
    this.at = null; // null is the present
    const $ = (id) => document.getElementById(id);
    [this.range, this.spans, this.from, this.to, this.live, this.zone] = ["moment", "spans", "from", "to", "live", "zone"].map($);
    this.range.addEventListener("input", () => {
      const last = this.moments.length - 1;
      this.at = +this.range.value >= last ? null : Date.parse(this.moments[+this.range.value].time);
      this.on.changed();
    });
    this.live.addEventListener("click", () => this.present());
  }

  present() {
    this.at = null;
    this.on.changed();
  }

  go(time) {
    this.at = time;
    this.on.changed();
  }

  load(moments) {
    this.moments = moments;
  }

  record(message) {
    const time = Date.parse(message.time);
    const last = this.moments.at(-1);
    if (last) {
      const passed = time - Date.parse(last.time);
      if (passed < 0) this.moments = [];
      else if (passed < STEP_MS) return;
    }
    const { emitters, frame } = message;
    this.moments.push({ time: message.time, frame, emitters });
    if (this.moments.length > KEPT) this.moments.shift();
  }

  index() {
    if (this.at === null) return this.moments.length - 1;
    const later = this.moments.findIndex((m) => Date.parse(m.time) > this.at);
    return Math.max(0, (later < 0 ? this.moments.length : later) - 1);
  }

  moment() {
    return this.moments[this.index()];
  }

  // Where each beam of `emitters` has been up to the time shown.
  trails(emitters) {
    const end = this.index();
    if (end < 0) return [];
    const until = Date.parse(this.moments[end].time);
    const trails = new Map(emitters.map((e) => [e.track, { status: e.status, points: [] }]));
    for (let k = end; k >= 0 && until - Date.parse(this.moments[k].time) <= TRAIL_MS; k--) {
      for (const e of this.moments[k].emitters) trails.get(e.track)?.points.unshift([e.x_m, e.y_m]);
    }
    for (const e of emitters) trails.get(e.track).points.push([e.x_m, e.y_m]);
    return [...trails.values()];
  }

  render(alerts) {
    this.live.setAttribute("aria-pressed", String(this.at === null));
    const n = this.moments.length;
    if (n < 2) return;
    this.range.max = n - 1;
    this.range.value = this.index();
    const [start, end] = [Date.parse(this.moments[0].time), Date.parse(this.moments[n - 1].time)];
    this.range.setAttribute("aria-valuetext", clock(Date.parse(this.moment().time)));
    this.from.textContent = stamp(start, end);
    this.zone.textContent = `times in ${zone(end)}`;
    this.to.textContent = this.at === null ? "now" : clock(end);
    const width = this.spans.getBoundingClientRect().width;
    const x = (t) => (Math.min(Math.max(t, start), end) - start) / (end - start) * width;
    const bars = [];
    for (const a of alerts) {
      const raised = Date.parse(a.raised_at);
      const cleared = a.cleared_at ? Date.parse(a.cleared_at) : end;
      if (cleared < start || raised > end) continue;
      const kind = ["unclaimed_emitter", "position_mismatch"].includes(a.kind) ? a.kind : "other";
      const row = { unclaimed_emitter: 1, position_mismatch: 7, other: 13 }[kind];
      bars.push(svg("rect", { class: kind, x: x(raised), y: row, width: Math.max(3, x(cleared) - x(raised)), height: 4, rx: 2 }));
    }
    this.spans.replaceChildren(...bars);
  }
}
