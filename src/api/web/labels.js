// Places names beside marks so that they do not cover each other: the important first, each at the first of four places
// that is free. A name that finds none is left out; the table and the pointer still tell it.

const HEIGHT = 16;
const GAP = 16;

// `wanted`: { x, y, widths, rank, must, left } in pixels, smaller ranks first, `widths` of the whole text and of shorter ones, `left` where the left side is
// the better one. Gives for each { dx, dy, anchor, text }, `text` the index of the width that fits, or null.
export function place(wanted, { width, height }) {
  const taken = wanted.map(({ x, y }) => [x - 9, y - 9, x + 9, y + 9]);
  const found = new Array(wanted.length).fill(null);
  const order = wanted.map((_, k) => k).sort((a, b) => wanted[a].rank - wanted[b].rank);
  for (const k of order) {
    const { x, y, widths, must, left } = wanted[k];
    const sides = [{ dx: GAP, dy: 4.5, anchor: "start" }, { dx: -GAP, dy: 4.5, anchor: "end" }];
    const around = [
      ...(left ? sides.reverse() : sides),
      { dx: 0, dy: -GAP + 2, anchor: "middle" },
      { dx: 0, dy: GAP + 9, anchor: "middle" },
      { dx: GAP - 4, dy: -GAP + 4, anchor: "start" },
      { dx: -GAP + 4, dy: -GAP + 4, anchor: "end" },
      { dx: GAP - 4, dy: GAP + 5, anchor: "start" },
      { dx: -GAP + 4, dy: GAP + 5, anchor: "end" },
    ];
    const places = widths.flatMap((_, text) => around.map((p) => ({ ...p, text })));
    const box = ({ dx, dy, anchor, text }) => {
      const w = widths[text];
      const left = x + dx - (anchor === "end" ? w : anchor === "middle" ? w / 2 : 0);
      return [left, y + dy - HEIGHT + 4, left + w, y + dy + 4];
    };
    const inside = ([l, t, r, b]) => l >= 0 && t >= 0 && r <= width && b <= height;
    const free = (b, own) => taken.every((o, j) => j === own || b[2] < o[0] || b[0] > o[2] || b[3] < o[1] || b[1] > o[3]);
    let at = places.find((p) => inside(box(p)) && free(box(p), k));
    if (!at && must) {
      const shared = (b) => taken.reduce((sum, o) => sum + Math.max(0, Math.min(b[2], o[2]) - Math.max(b[0], o[0])) * Math.max(0, Math.min(b[3], o[3]) - Math.max(b[1], o[1])), inside(b) ? 0 : 1e4);
      at = places.slice(-around.length).map((p) => [shared(box(p)), p]).sort((a, b) => a[0] - b[0])[0][1];
    }
    if (!at) continue;
    found[k] = at;
    taken.push(box(at));
  }
  return found;
}
