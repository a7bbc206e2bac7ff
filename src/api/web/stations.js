// The access points of a hub, those in trouble first.

import { clock, el, lasting, shown } from "./words.js";

const ORDER = { lost: 0, refused: 1, blind: 2, good: 3 };
const TONE = { lost: "bad", refused: "bad", blind: "warn", good: "ok" };
const $ = (id) => document.getElementById(id);

// The heading of a station's platform, and the age of its pose where it matters.
export function poseWords(pose) {
  if (!pose) return "fixed";
  if (!pose.place) return pose.is_lost ? "lost" : "waiting";
  const { heading_deg: heading, age_s: age } = pose.place;
  const old = pose.is_lost ? "lost, " : "";
  return `${old}heading ${Math.round(heading)}°${pose.is_lost || age > 0.5 ? `, ${lasting(age * 1000)} old` : ""}`;
}

// Where the platform is, how it is turned, and the age of its pose where it matters.
export function viewWords({ nadir_m: nadir, z_m: z, heading_deg: heading, roll_deg: roll, pitch_deg: pitch, pose_age_s: age }) {
  const whole = (v) => `${Math.round(v) + 0}`.replace("-", "−");
  const tilt = Math.max(Math.abs(roll), Math.abs(pitch)) >= 0.5 ? `, roll ${whole(roll)}°, pitch ${whole(pitch)}°` : "";
  return `UAV at ${[...nadir, z].map(whole).join(", ")} m, heading ${whole(heading)}°${tilt}${age > 0.5 ? `, pose ${lasting(age * 1000)} old` : ""}`;
}

export function showStations(stations, isHub) {
  $("stations").hidden = !isHub;
  $("sensor").hidden = isHub;
  $("places").hidden = isHub;
  if (!isHub) return;
  const name = (s) => `${s.site}.${s.station}`;
  const sorted = [...stations].sort((a, b) => ORDER[a.state] - ORDER[b.state] || name(a).localeCompare(name(b), undefined, { numeric: true }));
  const lost = stations.filter((s) => s.state === "lost").length;
  $("station-count").textContent = `${stations.length} known${lost ? `, ${lost} lost` : ""}`;
  const behind = (s) => (s.lag_s === null ? "" : `${s.lag_s < 0 ? "−" : ""}${lasting(Math.abs(s.lag_s) * 1000)}`);
  // What of its messages cannot be used, and why.
  const refused = (s) => Object.entries(s.refused).map(([reason, n]) => `, ${n} ${reason.replaceAll("_", " ")}`).join("");
  $("station-rows").replaceChildren(...sorted.map((s) => {
    const texts = [["", shown(name(s))], [TONE[s.state], s.state + refused(s)], ["n", `${s.emitters}`], [s.is_compared ? "n" : "n bad", behind(s)], ["n", `${s.alerts_waiting}`], [s.pose?.is_lost ? "bad" : "", poseWords(s.pose)], ["", clock(Date.parse(s.last_seen_at))]];
    return el("tr", {}, ...texts.map(([className, text]) => el("td", { className }, text)));
  }));
}
