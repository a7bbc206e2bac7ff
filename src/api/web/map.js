// The ground in metres: x to the right, y up, what is watched in the middle.

import { metres, shown, svg } from "./words.js";
import { place } from "./labels.js";
import { shape } from "./marks.js";
import { listen } from "./pointing.js";

// 95 % of a two-dimensional normal distribution lies within this many standard deviations.
const NINETY_FIVE = Math.sqrt(5.991);
const STEPS = [0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500, 1000];

export class GroundMap {
  constructor(node, on) {
    this.node = node;
    this.on = on; // { pick(key or null) }
    this.pointed = null; // the beam or user that is pointed at elsewhere
    this.search = "";
    this.half = [125, 125];
    this.seen = null;
    this.home = [0, 0];
    this.zoom = 1;
    this.centre = [0, 0];
    this.isFollowing = true; // what is watched, until the reader looks elsewhere
    this.beams = new Map();
    this.scene = null;
    this.picked = null;
    this.background = null; // what lies below everything
    this.below = svg("g");
    this.back = svg("g");
    this.places = svg("g");
    this.handles = svg("g");
    this.zones = [];
    this.lights = [];
    this.corners = null; // of a zone that is being drawn
    this.trails = svg("g");
    this.claims = svg("g");
    this.marks = svg("g");
    this.names = svg("g");
    node.append(this.below, this.back, this.places, this.trails, this.claims, this.marks, this.names, this.handles);
    new ResizeObserver(() => this.redraw()).observe(node);
    listen(this);
  }

  // Zones as GeoJSON features, and known lights.
  showPlaces(zones, lights) {
    [this.zones, this.lights] = [zones, lights];
    this.redraw();
  }

  // Begins to draw a zone with these corners; null ends it.
  draft(corners) {
    this.corners = corners;
    this.node.classList.toggle("drawing", corners !== null);
    this.redraw();
  }

  undoCorner() {
    this.corners?.pop();
    this.redraw();
  }

  path(rings) {
    return rings.map((ring) => `M${ring.map((c) => this.px(c).map((v) => v.toFixed(1)).join(" ")).join("L")}Z`).join("");
  }

  drawPlaces() {
    const nodes = this.zones.flatMap(({ properties: p, geometry: g }) => {
      const polygons = g.type === "Polygon" ? [g.coordinates] : g.coordinates;
      const [x, y] = this.px(polygons[0][0].reduce((top, c) => (c[1] > top[1] ? c : top)));
      return [
        svg("path", { class: `zone ${p.kind}`, d: polygons.map((rings) => this.path(rings)).join(""), "fill-rule": "evenodd" }, svg("title", {}, `${shown(p.name)}: ${p.kind}`)),
        svg("text", { class: `zone-name ${p.kind}`, x: x + 4, y: y + 14 }, `${shown(p.name)} · ${p.kind}`),
      ];
    });
    for (const light of this.lights) {
      const [x, y] = this.px([light.x_m, light.y_m]);
      nodes.push(svg("circle", { class: "known-area", cx: x, cy: y, r: Math.max(3, light.radius_m * this.scale) }, svg("title", {}, `Known light${light.note ? `: ${shown(light.note)}` : ""}`)));
    }
    this.places.replaceChildren(...nodes);
    const corners = this.corners ?? [];
    const marks = corners.map((c) => svg("circle", { class: "handle", cx: this.px(c)[0], cy: this.px(c)[1], r: 6 }));
    if (corners.length > 1) marks.unshift(svg("path", { class: "zone draft", d: this.path([corners]) }));
    this.handles.replaceChildren(...marks);
    if (this.corners) this.on.corners?.(corners);
  }

  // The beam or user `key` is pointed at; null when none is any more.
  point(key) {
    this.pointed = key;
    this.redraw();
  }

  // Ground position under a pointer.
  place(e) {
    const box = this.node.getBoundingClientRect();
    const dx = e.clientX - box.left - box.width / 2;
    const dy = e.clientY - box.top - box.height / 2;
    return [this.centre[0] + dx / this.scale, this.centre[1] - dy / this.scale];
  }

  zoomBy(factor, about = this.centre) {
    const before = this.zoom;
    this.isFollowing = false;
    this.zoom = Math.min(400, Math.max(0.5, this.zoom * factor));
    const kept = before / this.zoom;
    this.centre = this.centre.map((c, k) => about[k] + (c - about[k]) * kept);
    this.redraw();
  }

  all() {
    this.zoom = 1;
    this.isFollowing = true;
    this.centre = [...this.home];
    this.picked = null;
    this.pickedKey = null;
    this.redraw();
  }

  // Marks a place; with `key` the mark follows that beam.
  pick(place, key = null) {
    this.picked = place;
    this.pickedKey = key;
    const inside = place.every((p, k) => Math.abs(p - this.centre[k]) < (0.45 * [this.width, this.height][k]) / this.scale);
    if (!inside) {
      this.isFollowing = false;
      this.centre = [...place];
    }
    this.redraw();
  }

  show(scene) {
    this.scene = scene;
    this.frame(scene.bounds);
    this.redraw();
  }

  // Takes in all that a swaying platform has seen, so that the ground stays where it is on the page; one that travels is followed.
  frame([low, high]) {
    const all = this.seen ? [low.map((v, k) => Math.min(v, this.seen[0][k])), high.map((v, k) => Math.max(v, this.seen[1][k]))] : [low, high];
    const isFar = low.some((v, k) => all[1][k] - all[0][k] > 1.6 * (high[k] - v));
    this.seen = isFar ? [low, high] : all;
    this.home = this.seen[0].map((v, k) => (v + this.seen[1][k]) / 2);
    this.half = this.seen[0].map((v, k) => Math.max(1, (this.seen[1][k] - v) / 2));
    if (this.isFollowing) this.centre = [...this.home];
  }

  px([x, y]) {
    return [this.width / 2 + (x - this.centre[0]) * this.scale, this.height / 2 - (y - this.centre[1]) * this.scale];
  }

  redraw() {
    const { width, height } = this.node.getBoundingClientRect();
    if (!this.scene || width < 10) return;
    this.width = width;
    this.height = height;
    const room = Math.min(width / (2.16 * this.half[0]), height / (2.16 * this.half[1]));
    this.scale = room * this.zoom;
    this.below.replaceChildren(...(this.background?.draw(this) ?? []));
    this.drawBack();
    this.drawPlaces();
    this.drawTrails();
    this.labels = [];
    this.drawClaims();
    this.drawBeams();
    this.drawLabels();
  }

  isFound(text) {
    return this.search !== "" && String(text ?? "").toLowerCase().includes(this.search);
  }

  drawBack() {
    const step = STEPS.find((s) => s * this.scale >= 70) ?? 1000;
    const nodes = this.scene.views.map((view) => svg("path", { class: "view", d: this.path([view.outline]) }, svg("title", {}, view.title)));
    const [x0, y0] = [this.centre[0] - this.width / 2 / this.scale, this.centre[1] - this.height / 2 / this.scale];
    const [x1, y1] = [this.centre[0] + this.width / 2 / this.scale, this.centre[1] + this.height / 2 / this.scale];
    const round = (v) => +v.toFixed(1);
    for (let x = Math.ceil(x0 / step) * step; x <= x1; x += step) {
      const [px] = this.px([x, 0]);
      nodes.push(svg("line", { class: round(x) === 0 ? "axis" : "grid", x1: px, x2: px, y1: 0, y2: this.height }));
      if (px > 30 && px < this.width - 60 - step * this.scale) nodes.push(svg("text", { class: "tick", x: px + 4, y: this.height - 6 }, `${round(x)}`));
    }
    for (let y = Math.ceil(y0 / step) * step; y <= y1; y += step) {
      const [, py] = this.px([0, y]);
      nodes.push(svg("line", { class: round(y) === 0 ? "axis" : "grid", y1: py, y2: py, x1: 0, x2: this.width }));
      if (py > 14 && py < this.height - 24) nodes.push(svg("text", { class: "tick", x: 6, y: py - 4 }, `${round(y)}`));
    }
    for (const { nadir, heading, title } of this.scene.views) {
      if (!nadir) continue;
      const [cx, cy] = this.px(nadir);
      nodes.push(svg("path", { class: "nadir", d: `M${cx - 9} ${cy}h18M${cx} ${cy + 9}v-22M${cx - 4} ${cy - 9}l4 -5l4 5`, transform: `rotate(${heading} ${cx} ${cy})` }, svg("title", {}, title)));
    }
    const long = step * this.scale;
    nodes.push(
      svg("path", { class: "scale-bar", d: `M${this.width - 14 - long} ${this.height - 16}v6h${long}v-6` }),
      svg("path", { class: "north", d: `M${this.width - 22} 44v-30m-5 9l5 -9l5 9` }, svg("title", {}, "north")),
      svg("text", { class: "scale", x: this.width - 22, y: 58, "text-anchor": "middle" }, "N"),
      svg("text", { class: "scale", x: this.width - 14 - long / 2, y: this.height - 18, "text-anchor": "middle" }, `${step} m`),
    );
    this.back.replaceChildren(...nodes);
  }

  drawTrails() {
    const nodes = [];
    for (const trail of this.scene.trails) {
      // Older pieces are fainter.
      const pieces = 4;
      const size = Math.ceil(trail.points.length / pieces);
      for (let k = 0; k < pieces; k++) {
        const part = trail.points.slice(k * size, (k + 1) * size + 1);
        if (part.length < 2) continue;
        const points = part.map((p) => this.px(p).map((v) => v.toFixed(1)).join(",")).join(" ");
        nodes.push(svg("polyline", { class: `trail ${trail.status}`, points, "stroke-opacity": 0.15 + 0.15 * k }));
      }
    }
    this.trails.replaceChildren(...nodes);
  }

  drawClaims() {
    const nodes = [];
    const seen = new Map(this.scene.emitters.filter((e) => e.user).map((e) => [e.user, e]));
    const unseen = new Set(this.scene.unseen);
    for (const claim of this.scene.claims) {
      const beam = seen.get(claim.user);
      if (!beam && !unseen.has(claim.user)) continue;
      const at = this.px([claim.x_m, claim.y_m]);
      if (beam) {
        const to = this.px([beam.x_m, beam.y_m]);
        const off = Math.hypot(to[0] - at[0], to[1] - at[1]);
        if (off > 12) nodes.push(svg("line", { class: `tie ${beam.status}`, x1: at[0], y1: at[1], x2: to[0], y2: to[1] }));
      }
      nodes.push(svg("circle", { class: beam ? "claim" : "claim unseen-user", cx: at[0], cy: at[1], r: 10.5 }));
      const found = this.isFound(claim.user);
      if (!beam) this.labels.push({ x: at[0], y: at[1], key: `u${claim.user}`, rank: 2, parts: [claim.user, " not seen"], className: "claim-name", found });
      else if (beam.status === "mismatch") this.labels.push({ x: at[0], y: at[1], key: null, rank: 1.5, parts: [claim.user, " says here"], className: "claim-name", found: false });
    }
    this.claims.replaceChildren(...nodes);
  }

  drawBeams() {
    const claims = new Map(this.scene.claims.map((c) => [c.user, c]));
    const gone = new Set(this.beams.keys());
    for (const e of this.scene.emitters) {
      gone.delete(e.track);
      let g = this.beams.get(e.track);
      if (!g || g.status !== e.status) {
        g?.node.remove();
        g = this.makeBeam(e);
        this.beams.set(e.track, g);
      }
      const [x, y] = this.px([e.x_m, e.y_m]);
      g.node.setAttribute("transform", `translate(${x.toFixed(1)} ${y.toFixed(1)})`);
      if (e.cov_m2) {
        const { major, minor, turn } = axes(e.cov_m2);
        const size = (v) => Math.min(2000, v * NINETY_FIVE * this.scale).toFixed(1);
        g.ellipse.setAttribute("rx", size(major));
        g.ellipse.setAttribute("ry", size(minor));
        g.ellipse.setAttribute("transform", `rotate(${-turn})`);
      }
      const claim = claims.get(e.user);
      const off = claim ? Math.hypot(claim.x_m - e.x_m, claim.y_m - e.y_m) : null;
      const parts = {
        unclaimed: [null, `nobody claims beam ${e.track}`],
        mismatch: [e.user, off === null ? "" : ` · ${metres(off)} m off`],
        pending: [e.user, e.user ? "" : `beam ${e.track}`],
        verified: [e.user, ""],
        known: [null, "known light"],
        ignored: [null, `beam ${e.track}, ignored`],
      }[e.status];
      const short = { unclaimed: [null, `beam ${e.track}`], mismatch: [e.user, ""] }[e.status];
      const found = this.isFound(`${e.user ?? ""} ${e.track}`);
      this.labels.push({ short, x, y, key: `b${e.track}`, rank: { unclaimed: 0, mismatch: 1, pending: 3, verified: 4, known: 5, ignored: 5 }[e.status], parts, className: `beam-name ${e.status}`, found, left: Boolean(claim) && claim.x_m > e.x_m });
      g.node.classList.toggle("found", found);
    }
    for (const track of gone) {
      this.beams.get(track).node.remove();
      this.beams.delete(track);
    }
    this.pickMark?.remove();
    const follow = this.labels.find((l) => l.key && (l.key === this.pointed || l.key === this.pickedKey));
    const at = follow ? [follow.x, follow.y] : this.picked ? this.px(this.picked) : null;
    if (at) {
      this.pickMark = svg("circle", { class: "pick", cx: at[0], cy: at[1], r: 20 });
      this.marks.append(this.pickMark);
    }
  }

  // Names beside the marks: those that matter, are sought or are pointed at always, the others where there is room.
  drawLabels() {
    const wanted = this.labels.map((label) => {
      const texts = [label.parts, label.short].filter(Boolean);
      // Wide enough for the bold names too.
      const widths = texts.map((parts) => 8 * parts.map((p) => (p === null ? "" : shown(p))).join("").length + 4);
      const isChosen = label.key !== null && (label.key === this.pointed || label.key === this.pickedKey);
      const must = isChosen || label.found || label.rank <= 1;
      return { ...label, rank: isChosen || label.found ? -1 : label.rank, must, texts, widths };
    });
    const places = place(wanted, { width: this.width, height: this.height });
    const nodes = wanted.flatMap((label, k) => {
      if (!places[k]) return [];
      const { dx, dy, anchor, text } = places[k];
      const [name, rest] = label.texts[text];
      const node = svg("text", { class: label.className, x: label.x + dx, y: label.y + dy, "text-anchor": anchor });
      if (name !== null) node.append(svg("tspan", { class: "name" }, shown(name)));
      if (rest) node.append(rest);
      return [node];
    });
    this.names.replaceChildren(...nodes);
  }

  makeBeam(e) {
    const ellipse = svg("ellipse", { class: "ellipse fill edge" });
    const node = svg("g", { class: `beam ${e.status}` }, ellipse);
    if (e.status === "unclaimed") node.append(svg("circle", { class: "ping", r: 18 }));
    node.append(...shape(e.status));
    this.marks.append(node);
    return { node, ellipse, status: e.status };
  }
}

// Standard deviations along the principal axes, m, and the major axis' angle from +x, degrees.
function axes([[a, b], [, c]]) {
  const mean = (a + c) / 2;
  const spread = Math.hypot((a - c) / 2, b);
  const turn = (Math.atan2(2 * b, a - c) / 2) * (180 / Math.PI);
  return { major: Math.sqrt(Math.max(0, mean + spread)), minor: Math.sqrt(Math.max(0, mean - spread)), turn };
}
