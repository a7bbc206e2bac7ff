// How values are said.

export const STATUS = { verified: "verified", mismatch: "mismatch", unclaimed: "unclaimed", pending: "pending", known: "known light", ignored: "ignored" };

export const KIND = {
  unclaimed_emitter: "A beam nobody claims",
  position_mismatch: "A user is not where claimed",
  user_unseen: "A claimed user is not seen",
  sensor_lost: "The sensor is lost",
  claims_stale: "The claims log is quiet",
  claims_flooded: "The claims log is flooded",
  pose_inconsistent: "Our own pose is off",
  known_light_changed: "A known light has changed",
  user_out_of_zone: "A user is where they may not be",
  station_lost: "An access point is silent",
  user_in_two_places: "A user is in two places",
};

export const SEVERITIES = ["critical", "warning", "info"];

export const kindName = (kind) => KIND[kind] ?? kind.replaceAll("_", " ");

export const metres = (v) => (v === null || v === undefined ? "" : v.toFixed(Math.abs(v) < 100 ? 2 : 1));

// Metres in a sentence: no more digits than a reader wants.
export const roughly = (v) => `${+v.toPrecision(v < 1 ? 1 : 2)} m`;

export const clock = (ms) => new Date(ms).toLocaleTimeString([], { hour: "2-digit", minute: "2-digit", second: "2-digit", hourCycle: "h23" });

const day = (ms) => new Date(ms).toLocaleDateString([], { year: "numeric", month: "short", day: "numeric" });

// Time of day, with the date where it is not the day of `now`.
export const stamp = (ms, now = Date.now()) => (day(ms) === day(now) ? clock(ms) : `${day(ms)}, ${clock(ms)}`);

// Always with the date.
export const fullStamp = (ms) => `${day(ms)}, ${clock(ms)}`;

// The reader's time zone with its offset at that time.
export function zone(ms = Date.now()) {
  const name = Intl.DateTimeFormat().resolvedOptions().timeZone;
  const minutes = -new Date(ms).getTimezoneOffset();
  const two = (n) => String(n).padStart(2, "0");
  const offset = `UTC${minutes < 0 ? "−" : "+"}${two(Math.floor(Math.abs(minutes) / 60))}:${two(Math.abs(minutes) % 60)}`;
  return !name || name === "UTC" ? offset.replace("+00:00", "") : `${name}, ${offset}`;
}

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

// A name that comes from outside: characters that are not seen, or that turn a line round, are spelled out.
export function shown(name) {
  return String(name).replace(/[\p{Cc}\p{Cf}\p{Zl}\p{Zp}\p{Co}]/gu, (c) => `\\u{${c.codePointAt(0).toString(16)}}`);
}

// The same, isolated, so that its direction does not reach the text around it.
export const named = (name) => el("bdi", {}, shown(name));

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
  return Number.isNaN(time) ? shown(value) : stamp(time);
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
