// What lies below the map: a picture with its corners, or map tiles. Both are fetched with the page's token.

import { svg } from "./words.js";

const KEPT = 300; // tiles in memory
const MOST = 60; // tiles drawn at a time
const TILE_PX = 256; // on the page, at least

export class Background {
  constructor(link, map) {
    this.link = link;
    this.map = map;
    this.shown = null;
    this.images = new Map(); // path → <image>; null while it is fetched, and where there is none
  }

  // Asks once what there is.
  async load() {
    if (this.shown) return;
    try {
      this.shown = await this.link.json("/v1/background");
    } catch {
      return;
    }
    const isThere = Boolean(this.shown.picture || this.shown.tiles);
    this.map.node.classList.toggle("has-background", isThere);
    this.map.background = isThere ? this : null;
    this.map.redraw();
  }

  draw(map) {
    const { picture, tiles, attribution } = this.shown;
    const nodes = picture ? this.image("/v1/background/picture", map, picture.corners_m) : this.tiles(map, tiles);
    if (attribution) nodes.push(svg("text", { class: "attribution", x: map.width - 8, y: map.height - 40, "text-anchor": "end" }, attribution));
    return nodes;
  }

  // The tiles in view, of the zoom whose tiles are nearest to their own size on the page.
  tiles(map, { min_zoom: least, max_zoom: most, to_local_m: [[a, b, c], [d, e, f]] }) {
    const det = a * e - b * d;
    const toMap = ([x, y]) => [(e * (x - c) - b * (y - f)) / det, (a * (y - f) - d * (x - c)) / det];
    const toLocal = (u, v) => [a * u + b * v + c, d * u + e * v + f];
    const half = [map.width / 2 / map.scale, map.height / 2 / map.scale];
    const corners = [[-1, -1], [1, -1], [1, 1], [-1, 1]].map((s) => toMap(map.centre.map((m, k) => m + s[k] * half[k])));
    const range = (k, side) => [Math.min, Math.max].map((pick) => Math.floor(pick(...corners.map((p) => p[k])) * side));
    let zoom = Math.min(most, Math.max(least, Math.floor(Math.log2((Math.hypot(a, d) * map.scale) / TILE_PX))));
    const spans = () => [0, 1].map((k) => range(k, 2 ** zoom).map((n) => Math.min(2 ** zoom - 1, Math.max(0, n))));
    const count = ([[x0, x1], [y0, y1]]) => (x1 - x0 + 1) * (y1 - y0 + 1);
    while (zoom > least && count(spans()) > MOST) zoom--;
    const [[x0, x1], [y0, y1]] = spans();
    if (count(spans()) > MOST) return [];
    const side = 2 ** zoom;
    const nodes = [];
    for (let x = x0; x <= x1; x++) {
      for (let y = y0; y <= y1; y++) {
        const places = [[x, y], [x + 1, y], [x, y + 1]].map(([u, v]) => toLocal(u / side, v / side));
        nodes.push(...this.image(`/v1/background/tiles/${zoom}/${x}/${y}`, map, places));
      }
    }
    return nodes;
  }

  // A picture whose upper left, upper right and lower left corner are at these places, once it is here.
  image(path, map, places) {
    const image = this.images.get(path);
    if (image === undefined) this.fetch(path);
    if (!image) return [];
    const [[x, y], right, down] = places.map((place) => map.px(place));
    const matrix = [right[0] - x, right[1] - y, down[0] - x, down[1] - y, x, y];
    image.setAttribute("transform", `matrix(${matrix.join(" ")})`);
    return [image];
  }

  async fetch(path) {
    this.images.set(path, null);
    try {
      const href = URL.createObjectURL(await (await this.link.request(path)).blob());
      // Just over a unit wide, so that no gap shows between tiles.
      this.images.set(path, svg("image", { href, width: 1.002, height: 1.002, preserveAspectRatio: "none" }));
      this.map.redraw();
    } catch (e) {
      // What does not exist is asked for once, anything else again.
      if (e.status !== 404) this.images.delete(path);
    }
    if (this.images.size <= KEPT) return;
    const [oldest, image] = this.images.entries().next().value;
    this.images.delete(oldest);
    if (image) URL.revokeObjectURL(image.getAttribute("href"));
  }
}
