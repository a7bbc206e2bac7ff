// How values are said.

export const STATUS = { verified: "verified", mismatch: "mismatch", unclaimed: "unclaimed", pending: "pending" };

export const KIND = {
  unclaimed_emitter: "A beam nobody claims",
  position_mismatch: "A user is not where claimed",
  user_unseen: "A claimed user is not seen",
  sensor_lost: "The sensor is lost",
  claims_stale: "The claims log is quiet",
  claims_flooded: "More is claimed than there is room for",
  pose_inconsistent: "Our own pose is off",
};

export const metres = (v) => (v === null || v === undefined ? "" : v.toFixed(Math.abs(v) < 100 ? 2 : 1));

export const clock = (ms) => new Date(ms).toLocaleTimeString([], { hour: "2-digit", minute: "2-digit", second: "2-digit", hourCycle: "h23" });

export function lasting(ms) {
  const s = Math.max(0, Math.round(ms / 1000));
  if (s < 60) return `${s} s`;
  if (s < 3600) return `${Math.floor(s / 60)} min ${s % 60} s`;
  if (s < 172800) return `${Math.floor(s / 3600)} h ${Math.floor((s % 3600) / 60)} min`;
  return `${Math.floor(s / 86400)} days`;
}

export function micros(us) {
  return us < 1000 ? `${us} µs` : `${(us / 1000).toFixed(us < 10000 ? 2 : 1)} ms`;
}

const UNITS = { m: "m", m2: "m²", s: "s", j: "J", us: "µs", hz: "Hz" };

// "mean_distance_m" and 3.14159 become "mean distance" and "3.14 m".
export function fact(key, value) {
  const parts = key.split("_");
  const unit = parts.length > 1 ? UNITS[parts.at(-1)] : undefined;
  if (unit) parts.pop();
  if (unit === "J" && typeof value === "number") return [parts.join(" "), joules(value)];
  return [parts.join(" "), said(value) + (unit && typeof value === "number" ? ` ${unit}` : "")];
}

function joules(value) {
  const prefixes = [[1, ""], [1e-3, "m"], [1e-6, "µ"], [1e-9, "n"], [1e-12, "p"]];
  const [size, prefix] = prefixes.find(([p]) => Math.abs(value) >= p) ?? prefixes.at(-1);
  return `${+(value / size).toPrecision(3)} ${prefix}J`;
}

function said(value) {
  if (value === null || value === undefined) return "–";
  if (typeof value === "number") {
    if (Number.isInteger(value) && Math.abs(value) < 1e6) return String(value);
    const size = Math.abs(value);
    return size >= 1e5 || size < 1e-3 ? value.toExponential(2) : String(+value.toPrecision(4));
  }
  if (typeof value === "boolean") return value ? "yes" : "no";
  if (Array.isArray(value)) return value.length ? value.map(said).join(", ") : "none";
  if (typeof value === "object") return Object.entries(value).map(([k, v]) => fact(k, v).join(" ")).join(", ");
  const time = /^\d{4}-\d\d-\d\dT/.test(value) ? Date.parse(value) : NaN;
  return Number.isNaN(time) ? String(value).replaceAll("_", " ") : clock(time);
}

// Element with properties and children; text is never read as markup.
export function el(name, props = {}, ...children) {
  const node = document.createElement(name);
  for (const [key, value] of Object.entries(props)) {
    if (key in node) node[key] = value;
    else node.setAttribute(key, value);
  }
  node.append(...children);
  return node;
}

export function svg(name, attributes = {}, ...children) {
  const node = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
  node.append(...children);
  return node;
}
