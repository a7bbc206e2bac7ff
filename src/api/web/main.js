// Puts the page together: messages of the stream go to the map, the tables and the list of alerts.

import { Alerts } from "./alerts.js";
import { Background } from "./background.js";
import { Beams } from "./beams.js";
import { Bell } from "./bell.js";
import { Link } from "./link.js";
import { GroundMap } from "./map.js";
import { claimIcon, icon } from "./marks.js";
import { Places } from "./places.js";
import { poseWords, showStations, viewWords } from "./stations.js";
import { Timeline } from "./timeline.js";
import { el, fullStamp, lasting, micros, shown, stamp, zone } from "./words.js";

const $ = (id) => document.getElementById(id);
const FRAME_EVERY_MS = 500;

let latest = null; // the newest snapshot or positions message
let arrived = 0; // when it came, by our clock
let linkState = "connecting";
let wanted = false; // whether a redraw is due

const bell = new Bell();
const map = new GroundMap($("map"), { pick: (key) => beams.pick(key) });
const beams = new Beams({
  point: (key) => map.point(key),
  pick(key, place) {
    beams.pick(key);
    map.pick(place, key);
  },
});
const timeline = new Timeline({ changed: redraw });
const link = new Link({ state: onState, message: onMessage, ask });
const alerts = new Alerts(link, {
  changed: redraw,
  raised: (alert) => bell.raised(alert),
  approve: (alert, note, until) => places.approve(alert, note, until),
  pick(place, alert) {
    const raised = Date.parse(alert.raised_at);
    if (alert.cleared_at && timeline.moments.length && raised >= Date.parse(timeline.moments[0].time)) timeline.go(raised + 1000);
    map.pick(place);
    $("map").scrollIntoView({ block: "nearest", behavior: "smooth" });
  },
});

const places = new Places(link, map);
const background = new Background(link, map);

legend();
for (const [id, act] of [["zoom-in", () => map.zoomBy(1.5)], ["zoom-out", () => map.zoomBy(1 / 1.5)], ["zoom-all", () => map.all()]]) {
  $(id).addEventListener("click", act);
}
addEventListener("keydown", (e) => {
  if (e.ctrlKey || e.metaKey || e.altKey || e.target.matches("input:not([type=range]), select, textarea")) return;
  const acts = { "+": () => map.zoomBy(1.5), "=": () => map.zoomBy(1.5), "-": () => map.zoomBy(1 / 1.5), 0: () => map.all(), l: () => timeline.present(), a: () => $("alerts").focus() };
  acts[e.key]?.();
});
setInterval(() => {
  banner();
  facts();
  if (latest) alerts.tick(Date.parse(latest.time) + (stalled() ? Date.now() - arrived : 0));
}, 500);
setInterval(frame, FRAME_EVERY_MS);
$("present").addEventListener("click", () => timeline.present());
$("find-beam").addEventListener("input", () => {
  map.search = beams.words();
  map.redraw();
});
history();

async function history() {
  try {
    timeline.load((await link.json("/v1/history")).moments);
    redraw();
  } catch {
    // Nothing to show of the past yet.
  }
}

function onState(state) {
  const before = linkState;
  // While a connection is tried again it is still lost.
  if (state === "connecting" && before === "lost") return;
  linkState = state;
  if (state === "live" && before !== "live") {
    history();
    background.load();
  }
  banner();
}

// The state of the connection in a word: green only while something comes.
function pill() {
  let [words, tone] = { connecting: ["connecting", ""], live: ["live", "ok"], lost: ["disconnected", "bad"], refused: ["token needed", "bad"] }[linkState];
  if (linkState === "live" && arrived && stalled()) [words, tone] = [`silent for ${lasting(Date.now() - arrived)}`, "bad"];
  else if (linkState === "live" && timeline.at !== null) [words, tone] = ["looking back", ""];
  if ($("link").textContent !== words) $("link").textContent = words;
  $("link").className = `pill ${tone}`;
}

function onMessage(message) {
  if (message.type === "alert") {
    alerts.event(message.event, message.alert);
    return;
  }
  if (message.type === "snapshot") alerts.reset(message.alerts);
  if (message.emitters) {
    latest = message;
    arrived = Date.now();
    timeline.record(message);
  }
  redraw();
}

const stalled = () => linkState !== "live" || Date.now() - arrived > 3000;

// What must not be overlooked: that what is shown is old, or that the sensor sees nothing.
function banner() {
  pill();
  const text = trouble();
  document.body.classList.toggle("stale", Boolean(text));
  $("banner").hidden = !text;
  if ($("banner").textContent !== text) $("banner").textContent = text;
}

function trouble() {
  const age = arrived ? `; what is shown is ${lasting(Date.now() - arrived)} old` : "";
  if (linkState === "refused") return "This monitor asks for a token.";
  if (linkState === "lost" || (linkState === "connecting" && arrived)) return `Disconnected from the monitor${age}. Trying again.`;
  if (!latest) return linkState === "live" ? "The monitor runs but has not looked at a frame yet." : "";
  const { source } = latest.status;
  const fault = source.fault ? ` (${shown(source.fault)})` : "";
  switch (source.state) {
    case "blind":
      return `The sensor is blind: frames arrive but none can be used${fault}. Nothing on this page can be trusted to be there, or not to be.`;
    case "lost":
      return `The sensor is lost: no frames arrive${fault}. Nobody is being watched.`;
    case "ended":
      return "The recording has ended.";
    case "starting":
      return "The monitor is waiting for its first frame.";
    default:
      return stalled() ? `Connected, but the monitor has said nothing for ${lasting(Date.now() - arrived)}.` : "";
  }
}

function redraw() {
  if (wanted) return;
  wanted = true;
  requestAnimationFrame(() => {
    wanted = false;
    draw();
  });
}

function draw() {
  if (!latest) return;
  const live = timeline.at === null;
  const moment = live ? latest : timeline.moment();
  const scene = {
    emitters: moment.emitters,
    claims: live ? latest.claims : [],
    unseen: live ? latest.unseen : [],
    trails: timeline.trails(moment.emitters),
    ...ground(latest.status, live),
  };
  map.show(scene);
  const time = Date.parse(moment.time);
  $("clock").textContent = `${fullStamp(time)}${live ? "" : " · the past"}`;
  $("clock").title = zone(time);
  const { view } = latest.status;
  $("platform").textContent = live && view ? viewWords(view) : "";
  $("platform").className = view?.pose_age_s > 0.5 ? "warn" : "quiet";
  places.tick(Date.parse(latest.time), latest.status.field_of_view_m);
  timeline.render(alerts.known.values());
  beams.show(scene);
  past(live ? null : time);
}

// What one access point of a hub sees; where it is and heads, by its pose.
function viewOf({ site, station, footprint_m: outline, pose }) {
  const title = `seen by ${shown(site)}.${shown(station)}`;
  if (!pose?.place) return { outline, title };
  const { x_m: x, y_m: y, heading_deg: heading } = pose.place;
  return { outline, nadir: [x, y], heading, title: `${title}, which is above ${Math.round(x)}, ${Math.round(y)} m, ${poseWords(pose)}` };
}

// What is watched: the outlines on the ground, and the smallest and largest place of them all.
function ground({ view, stations = [], field_of_view_m: [w, h] }, live) {
  const outlines = [view?.footprint_m, ...stations.map((s) => s.footprint_m)].filter((points) => points?.length > 2);
  const points = outlines.length ? outlines.flat() : [[-w, -h], [w, h]];
  const bounds = [Math.min, Math.max].map((pick) => [0, 1].map((k) => points.reduce((v, p) => pick(v, p[k]), points[0][k])));
  if (!live) return { bounds, views: [] };
  const views = stations.filter((s) => s.footprint_m?.length > 2).map(viewOf);
  if (view?.footprint_m.length > 2) {
    views.push({ outline: view.footprint_m, nadir: view.nadir_m, heading: view.heading_deg, title: viewWords(view) });
  }
  if (!views.length) views.push({ outline: [[-w, -h], [w, -h], [w, h], [-w, h]], title: "the field of view" });
  return { bounds, views };
}

// Looking back, everything on the page is of that time, or says that it is not.
function past(time) {
  alerts.moment(time);
  pill();
  document.body.classList.toggle("past", time !== null);
  $("past-banner").hidden = time === null;
  if (time === null) return;
  const words = `You are looking at ${fullStamp(time)}. Map, beams and alerts are of that time, without the claims of then; the figures above and the sensor's picture are stopped. What you acknowledge counts now.`;
  if ($("past-words").textContent !== words) $("past-words").textContent = words;
}

// What a reader must know of this monitor before trusting it.
function notices() {
  const { source, journal } = latest.status;
  const texts = [];
  if (source.kind === "simulator") texts.push("Simulation: these frames are computed, no camera is watched.");
  if (source.kind === "fleet" && !latest.status.stations?.length) texts.push("No access point has said anything yet.");
  if (source.kind === "replay") texts.push("Replay: these frames come from a recording.");
  if (latest.status.fit?.hint) texts.push(`${latest.status.fit.hint}. Until then positions may be less precise, and faint beams beside bright ones unseen.`.replace(/^./, (c) => c.toUpperCase()));
  const work = places.maintenance(Date.parse(latest.time));
  if (work) texts.push(`Maintenance until ${stamp(Date.parse(work.until), Date.parse(latest.time))} by ${shown(work.by)}: alerts are recorded and not sent.`);
  if (journal.place === "memory") texts.push("Journal in memory: a restart of the monitor forgets alerts, and what was drawn or approved. [journal] path in its config keeps them.");
  const list = $("notices");
  list.hidden = !texts.length;
  if (list.textContent !== texts.join("")) list.replaceChildren(...texts.map((text) => el("li", {}, text)));
}

function facts() {
  if (!latest) return;
  notices();
  if (timeline.at !== null) return;
  const s = latest.status;
  const claimAge = s.claims.last_at ? Math.max(0, Date.parse(latest.time) - Date.parse(s.claims.last_at)) : null;
  const queued = s.webhooks.reduce((n, w) => n + w.queued, 0);
  const failing = s.webhooks.filter((w) => w.state !== "working").length;
  const rows = [
    ["Source", `${s.source.kind}, ${stalled() ? "silent" : s.source.state}`, s.source.state !== "running" || stalled() ? "bad" : ["v4l2", "fleet"].includes(s.source.kind) ? "" : "warn"],
    ["Frames", `${s.source.rate_hz.toFixed(1)} /s`],
    ["Latency", `${micros(s.latency.median_us)}`, "", `99 % within ${micros(s.latency.p99_us)}`],
    ["Fit", s.fit?.reduced_chi2 == null ? "none" : `χ² ${s.fit.reduced_chi2.toFixed(2)}`, s.fit?.hint ? "warn" : "", s.fit?.spot_error ? `spots differ from the model by ${(100 * s.fit.spot_error).toFixed(1)} % of their light` : "squared residual a degree of freedom: near 1 where the model explains the frame"],
    ["Dropped", `${s.frames.dropped}`, "", `${s.frames.captured} captured, ${s.frames.unusable} unusable`],
    ["Claims", s.claims.users || claimAge !== null ? `${s.claims.users} users${claimAge === null ? "" : `, ${lasting(claimAge)} ago`}` : "none", "", `${s.claims.accepted} accepted, ${s.claims.malformed} malformed${s.claims.log ? `, from ${s.claims.log}` : ""}`],
    ["Journal", s.journal.healthy ? (s.journal.place === "memory" ? "memory" : "on disk") : "failing", s.journal.healthy ? (s.journal.place === "memory" ? "warn" : "") : "bad", s.journal.fault ?? s.journal.place],
    ["Webhooks", s.webhooks.length ? (failing ? `${failing} failing, ${queued} queued` : `${queued} queued`) : "none", failing ? "warn" : ""],
  ];
  $("facts").replaceChildren(...rows.map(([name, value, tone = "", title = ""]) => el("div", { title }, el("dt", {}, name), el("dd", { className: tone }, value))));
  showStations(s.stations ?? [], s.source.kind === "fleet");
  $("webhooks").hidden = !s.webhooks.length;
  $("endpoints").replaceChildren(...s.webhooks.map((w) => {
    const tone = w.state === "working" ? "quiet" : "warn";
    const error = w.last_error && w.state !== "working" ? ` — ${w.last_error}` : "";
    return el("li", {}, el("strong", {}, w.name), " ", el("bdi", {}, w.url), " ", el("span", { className: tone }, `${w.state}: ${w.sent} sent, ${w.queued} queued, ${w.withheld ? `${w.withheld} withheld, ` : ""}${w.failed} given up${error}`));
  }));
}

let fetching = false;
let shownFrame = null;
let url = null;
// The residual takes a fit of its own: seldom anew.
const RESIDUAL_MS = 2000;
let shownAt = 0;
let withFit = false;
$("residual").addEventListener("click", () => {
  withFit = !withFit;
  shownFrame = null;
  shownAt = 0;
  $("residual").setAttribute("aria-pressed", withFit);
  $("fit-words").hidden = !withFit;
  $("sensor").classList.toggle("with-fit", withFit);
  frame();
});
async function frame() {
  const seen = latest && latest.frame !== shownFrame && linkState === "live" && !(withFit && performance.now() - shownAt < RESIDUAL_MS);
  if (!seen || fetching || document.hidden || timeline.at !== null) return;
  fetching = true;
  try {
    const number = latest.frame;
    const picture = await (await link.request(withFit ? "/v1/frame.png?fit=true" : "/v1/frame.png")).blob();
    shownAt = performance.now();
    const before = url;
    url = URL.createObjectURL(picture);
    $("frame").src = url;
    if (before) URL.revokeObjectURL(before);
    shownFrame = number;
    $("frame-number").textContent = `frame ${number}`;
    $("no-frame").hidden = true;
  } catch (e) {
    if (e.status === 503) {
      shownFrame = latest?.frame ?? null;
      $("frame").removeAttribute("src");
      $("no-frame").hidden = false;
    }
  } finally {
    fetching = false;
  }
}

function ask(why) {
  if (why) $("ask-why").textContent = why;
  if (!$("ask").open) $("ask").showModal();
}
$("ask").addEventListener("close", () => {
  const token = $("token").value.trim();
  $("token").value = "";
  if (token) link.useToken(token);
});

function legend() {
  const entries = [
    [icon("verified"), "where they say"],
    [icon("mismatch"), "not where they say"],
    [icon("unclaimed"), "nobody claims it"],
    [icon("pending"), "not decided yet"],
    [icon("known"), "known light, or ignored"],
    [claimIcon(false), "claimed position"],
    [claimIcon(true), "claimed, not seen"],
  ];
  $("legend").replaceChildren(...entries.map(([mark, words]) => el("li", {}, mark, words)));
}
