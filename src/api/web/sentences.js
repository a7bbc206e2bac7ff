// The evidence of an alert in sentences; the numbers behind them stand in a table of their own.

import { el, lasting, metres, named, roughly, shown, stamp } from "./words.js";

const seconds = (s) => lasting(s * 1000);
const isNumber = (v) => typeof v === "number" && Number.isFinite(v);

// A list of sentences, each a list of text and nodes.
export function sentences(alert) {
  const told = TELL[alert.kind]?.(alert.evidence ?? {}, alert) ?? [];
  return [...told, alert.evidence?.exposures && ["A beam dazzles the camera: short and long exposures are taken in turns."]].filter(Boolean);
}

const TELL = {
  unclaimed_emitter(e) {
    const near = e.nearest_user;
    const ratio = e.energy_against_users?.users_median_j > 0 ? e.energy_j / e.energy_against_users.users_median_j : NaN;
    return [
      isNumber(e.unclaimed_s) && [`The beam has been seen for ${seconds(e.unclaimed_s)} without a claim${e.seen_since ? `, since ${stamp(Date.parse(e.seen_since))}` : ""}.`],
      isNumber(e.shone_before_s) && [`It came on again: ${seconds(e.shone_before_s)} of that are of a beam near it that had gone.`],
      e.shares_the_spot_of && ["It comes from within the spot of ", named(e.shares_the_spot_of), ": two lights where one is claimed."],
      near && near.second_beam_for_claim && ["It is a second beam for the claim of ", named(near.user), `, ${roughly(near.distance_m)} from the claimed place.`],
      near && !near.second_beam_for_claim && ["The nearest claimed user, ", named(near.user), `, is ${roughly(near.distance_m)} away.`],
      isNumber(ratio) && [ratio > 1.5 ? `It is ${+ratio.toPrecision(2)} times as bright as the users usually are.` : ratio < 1 / 1.5 ? `It is ${+(1 / ratio).toPrecision(2)} times fainter than the users usually are.` : "It is about as bright as the users are."],
      ...ofLight(e),
      e.vanished_users?.length && ["Since about then no beam is seen of ", ...list(e.vanished_users.map((v) => v.user)), "."],
      strength(e.log_likelihood_ratio, e.threshold),
    ];
  },
  position_mismatch(e, alert) {
    const user = alert.user ? named(alert.user) : "The user";
    return [
      isNumber(e.distance_m) && ["The beam of ", user, ` is ${roughly(e.distance_m)} from the claimed place; ${isNumber(e.tolerated_distance_m) ? `${roughly(e.tolerated_distance_m)} are tolerated.` : ""}`],
      isNumber(e.mean_distance_m) && e.claims_in_window > 1 && [`Over the last ${e.claims_in_window} claims it was ${roughly(e.mean_distance_m)} on average.`],
      e.may_be_of?.length && ["It may also be the beam of ", ...list(e.may_be_of), ": the beams were too near to each other to be told apart, and both claim to be at one place."],
      e.answered_from_elsewhere && ["Another beam is at the claimed place or answers instead."],
      Math.abs(e.clock_offset_s) > 0.5 && [`The clock of the claims is ${+Math.abs(e.clock_offset_s).toPrecision(2)} s ${e.clock_offset_s > 0 ? "ahead" : "behind"}; that has been taken into account.`],
    ];
  },
  user_unseen(e, alert) {
    if (!alert.user && e.users_never_seen) {
      return [[`${e.users_never_seen} users claim to be here, and none of them was ever seen: `, ...list((e.users ?? []).slice(0, 5)), e.users_never_seen > 5 ? " and others." : "."]];
    }
    return [
      alert.user && isNumber(e.unseen_s) && [named(alert.user), ` claims to send, and no beam has answered for ${seconds(e.unseen_s)}.`],
      [e.last_seen ? `Last seen at ${stamp(Date.parse(e.last_seen))}.` : "Never seen in this run."],
    ];
  },
  sensor_lost(e) {
    const reason = {
      no_frame: "No frames arrive",
      unusable: "Frames arrive, but none can be used",
      saturated: "The array is saturated: somebody may be shining into it",
      frozen: "The same frame is repeated, pixel for pixel",
      all_beams_lost: "All beams went out at the same time",
    }[e.reason];
    return [
      reason && [`${reason}${isNumber(e.blind_s) ? `, for ${seconds(e.blind_s)} now` : ""}.`],
      typeof e.detail === "string" && [`The monitor says: ${e.detail}.`],
      e.last_usable && [`The last frame that could be used came at ${stamp(Date.parse(e.last_usable))}.`],
    ];
  },
  claims_stale(e, alert) {
    const age = e.newest_came_s_ago ?? e.newest_made_s_ago;
    return [
      isNumber(age) && [alert.user ? "The newest claim of " : "The newest claim", ...(alert.user ? [named(alert.user)] : []), ` is ${seconds(age)} old${isNumber(e.typical_period_s) ? `; usually one comes every ${seconds(e.typical_period_s)}` : ""}${isNumber(e.limit_s) ? `, and ${seconds(e.limit_s)} are waited` : ""}.`],
      !alert.user && ["Users cannot be held against their claims meanwhile; beams that are new are still alerted."],
    ];
  },
  known_light_changed(e) {
    const changes = { second_beam: "there is a second light in its spot", energy: `it has ${+(e.energy_over_the_learned?.ratio ?? 1).toPrecision(2)} times the light it had`, scintillation: "it scintillates otherwise than it did", place: `it is ${roughly(e.place?.away_m ?? 0)} from its place` };
    const found = (e.changed ?? []).map((c) => changes[c]).filter(Boolean);
    return [
      e.note && ["The known light ", el("q", {}, named(e.note)), e.approved_by ? ", approved by " : "", ...(e.approved_by ? [named(e.approved_by)] : []), "."],
      e.came_on_elsewhere && ["It went out, and a beam came on elsewhere."],
      found.length && [`What has changed: ${found.join("; ")}.`],
      strength(e.surprise, e.threshold),
    ];
  },
  user_out_of_zone(e, alert) {
    const zones = (e.zones ?? []).flatMap((zone, k) => [k ? ", " : "", named(zone)]);
    return [[alert.user ? named(alert.user) : "The user", e.is_restricted ? " is in the restricted zone " : " is outside of all zones they may be in: ", ...zones, "."]];
  },
  pose_inconsistent(e) {
    return [
      isNumber(e.largest_in_view_m) && [`${e.users_agreeing} of ${e.users} users are shifted alike, by up to ${roughly(e.largest_in_view_m)} within the view; ${roughly(e.limit_m)} are tolerated.`],
      e.changed_m > e.limit_m && [`The shift has changed by ${roughly(e.changed_m)} within ${seconds(e.changed_within_s)}: a position that is dragged away, or a pose source that fails.`],
      ["Our own position, attitude or calibration is off, and all positions with it."],
    ];
  },
  station_lost(e, alert) {
    return [[`Nothing has been heard of ${shown(`${alert.site}.${alert.station}`)}${e.last_seen_at ? ` since ${stamp(Date.parse(e.last_seen_at))}` : ""}: nobody is watched there, or the link to it is gone.`]];
  },
  user_in_two_places(e, alert) {
    const places = (e.places ?? []).slice(0, 2);
    const place = (p) => `${shown(`${p.site}.${p.station}`)} ${p.by === "claim" ? "has a claim" : "sees a beam"} at ${metres(p.x_m)}, ${metres(p.y_m)} m`;
    return [[named(alert.user ?? "The user"), ` is in two places, ${roughly(e.distance_m)} apart: ${places.map(place).join("; ")}.`]];
  },
};

// What the light says of its source; it decides nothing.
function ofLight(e) {
  const light = e.lamp_or_beam;
  const times = (ratio) => (Math.max(ratio, 1 / ratio) > 1e4 ? "more than ten thousand times" : `${+Math.max(ratio, 1 / ratio).toPrecision(2)} times`);
  const decided = (ratio) => isNumber(ratio) && ratio > 0 && Math.max(ratio, 1 / ratio) > 3;
  return [
    decided(light?.likelihood_ratio) && [`Its light is ${times(light.likelihood_ratio)} likelier ${light.likelihood_ratio > 1 ? "a beam's than a lamp's" : "a lamp's than a beam's"}, by how it scintillates, whether it is a point, and how it flickers.`],
    light?.mains_flicker?.length && [`It flickers with the mains (${light.mains_flicker[0].mains_hz} Hz), as a lamp does.`],
    decided(e.rests_in?.likelihood_ratio) && [e.rests_in.likelihood_ratio > 1 ? "It rests on the ground while the camera moves." : "It moves with the camera, as a glint or a faulty pixel does."],
    e.ghost_of && ["It fades with ", e.ghost_of.user ? named(e.ghost_of.user) : `track ${e.ghost_of.track}`, `, ${roughly(e.ghost_of.offset_m)} away: perhaps a reflection of that beam.`],
  ];
}

function list(users) {
  return users.flatMap((user, k) => (k ? [", ", named(user)] : [named(user)]));
}

function strength(found, needed) {
  if (!isNumber(found) || !isNumber(needed) || needed <= 0) return null;
  return [found >= needed ? `The evidence is ${+(found / needed).toPrecision(2)} times what an alert needs.` : "The evidence has grown weaker than an alert needs to begin."];
}
