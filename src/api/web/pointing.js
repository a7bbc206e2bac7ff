// Pointers, the wheel and the arrow keys on the map: they move it, enlarge it, pick what is on it, and draw a zone's corners.

export function listen(map) {
  const node = map.node;
  const pointers = new Map();
  node.addEventListener("wheel", (e) => {
    e.preventDefault();
    map.zoomBy(Math.exp(-e.deltaY * 0.0015), map.place(e));
  }, { passive: false });
  let moved = 0;
  let held = null; // index of the corner that is being moved
  node.addEventListener("pointerdown", (e) => {
    moved = 0;
    node.setPointerCapture(e.pointerId);
    pointers.set(e.pointerId, [e.clientX, e.clientY]);
    held = cornerAt(map, e);
    node.classList.add("drag");
  });
  node.addEventListener("pointermove", (e) => {
    const before = pointers.get(e.pointerId);
    if (!before) return;
    const others = [...pointers].filter(([id]) => id !== e.pointerId).map(([, p]) => p);
    if (held !== null) {
      moved = 4;
      map.corners[held] = map.place(e).map((v) => +v.toFixed(2));
    } else if (others.length) {
      const gap = (p) => Math.hypot(p[0] - others[0][0], p[1] - others[0][1]);
      const now = [e.clientX, e.clientY];
      map.zoomBy(gap(now) / Math.max(1, gap(before)), map.place(e));
    } else {
      moved += Math.hypot(e.clientX - before[0], e.clientY - before[1]);
      map.isFollowing = false;
      map.centre[0] -= (e.clientX - before[0]) / map.scale;
      map.centre[1] += (e.clientY - before[1]) / map.scale;
    }
    pointers.set(e.pointerId, [e.clientX, e.clientY]);
    map.redraw();
  });
  const end = (e) => {
    pointers.delete(e.pointerId);
    held = null;
    if (!pointers.size) node.classList.remove("drag");
  };
  node.addEventListener("pointerup", (e) => {
    end(e);
    if (moved < 4) touch(map, e);
  });
  node.addEventListener("pointercancel", end);
  node.addEventListener("keydown", (e) => {
    const step = 40 / map.scale;
    const moves = { ArrowLeft: [-step, 0], ArrowRight: [step, 0], ArrowUp: [0, step], ArrowDown: [0, -step] };
    if (moves[e.key]) {
      e.preventDefault();
      map.isFollowing = false;
      map.centre[0] += moves[e.key][0];
      map.centre[1] += moves[e.key][1];
      map.redraw();
    }
  });
}

// A beam or an unseen user was clicked, or the ground beside them; while a zone is drawn, a corner of it.
function touch(map, e) {
  if (!map.scene) return;
  if (map.corners) {
    map.corners.push(map.place(e).map((v) => +v.toFixed(2)));
    map.redraw();
    return;
  }
  const box = map.node.getBoundingClientRect();
  const at = [e.clientX - box.left, e.clientY - box.top];
  const claims = new Map(map.scene.claims.map((c) => [c.user, c]));
  const unseen = map.scene.unseen.flatMap((user) => (claims.has(user) ? [{ key: `u${user}`, x_m: claims.get(user).x_m, y_m: claims.get(user).y_m }] : []));
  const marks = [...map.scene.emitters.map((b) => ({ key: `b${b.track}`, x_m: b.x_m, y_m: b.y_m })), ...unseen].map((m) => {
    const [x, y] = map.px([m.x_m, m.y_m]);
    return { ...m, far: Math.hypot(x - at[0], y - at[1]) };
  });
  const near = marks.filter((m) => m.far < 20).sort((a, b) => a.far - b.far)[0];
  map.pickedKey = near?.key ?? null;
  map.picked = null;
  map.on.pick(map.pickedKey);
  map.redraw();
}

// Index of the corner under a pointer.
function cornerAt(map, e) {
  if (!map.corners) return null;
  const box = map.node.getBoundingClientRect();
  const far = (c) => Math.hypot(map.px(c)[0] - (e.clientX - box.left), map.px(c)[1] - (e.clientY - box.top));
  const k = map.corners.findIndex((c) => far(c) < 14);
  return k < 0 ? null : k;
}
