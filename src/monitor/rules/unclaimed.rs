//! `unclaimed_emitter`: a beam that no claim is associated with, for long enough to have been claimed.

use std::collections::{BTreeMap, BTreeSet};

use jiff::Timestamp;
use nalgebra::Vector2;
use serde_json::{Value, json};

use crate::monitor::alert::{SAME_PLACE_M, Severity};
use crate::monitor::alert_lifecycle::AlertLifecycle;
use crate::monitor::evidence::stranger_likelihood_ratio;
use crate::monitor::finding::{Cause, Content, Finding, is_renamed};
use crate::monitor::frame_context::FrameContext;
use crate::monitor::rules::flashes::Flashes;
use crate::monitor::stats::error_budget::TestFamily;
use crate::monitor::stats::robust::median_high;
use crate::monitor::track::beam_track::Track;
use crate::monitor::track::detection::view_m2;
use crate::time::seconds;

/// Resolutions of a spot within which the beam that an alert was about and the one that now has no claim are the same two. Larger
/// moves an alert to a beam that has nothing to do with it, smaller raises a second one for the same two beams. Not measured.
const SWAP_RESOLUTIONS: f64 = 2.0;
/// How long a beam in a restricted zone waits for a claim, s: three frames at 10 frames/s. Longer delays an alert that must come within
/// 0.3 s, shorter alerts a listed user whose claim is missing for a frame.
const RESTRICTED_WAIT_S: f64 = 0.15;
/// Absences of an honest user, one an hour: what a user's absence at the same moment is by chance. Assumed; evidence only.
const ABSENCE_PERIOD_S: f64 = 3600.0;

/// Since when each track has had no claim.
#[derive(Debug, Default)]
pub struct Memory {
    since: BTreeMap<u64, Timestamp>,
    flashes: Flashes,
    /// Tracks with an alert from before an operator drew an ignored zone about them.
    dismissed: BTreeSet<u64>,
}

impl Memory {
    /// Takes a frame's association. A track whose measurement merged into another's starts to be without a claim when the two
    /// are resolved.
    pub fn update(&mut self, frame: &FrameContext) {
        self.since.retain(|id, _| frame.tracker.get(*id).is_some());
        let is_ignored = |id: u64| frame.tracker.get(id).is_some_and(|t| frame.ignore_zone(t).is_some());
        self.dismissed.retain(|id| is_ignored(*id));
        for track in &frame.tracker.tracks {
            if frame.association.contains(track.id) {
                self.remove(track.id);
            } else if track.hit && track.unresolved_from.is_none() {
                let start = || frame.now - self.flashes.before(track, &frame.tracker);
                let since = *self.since.entry(track.id).or_insert_with(start);
                if track.confirmed {
                    self.flashes.shines(track, since);
                }
            }
        }
        self.flashes.forget_old(frame.now);
    }

    /// Whether the track has had no claim in the newest frame.
    pub fn is_unclaimed(&self, track: u64) -> bool {
        self.since.contains_key(&track)
    }

    /// An operator has drawn zones: alerts of beams that are ignored now end. One who walks into such a zone keeps theirs.
    pub fn dismiss_ignored(&mut self, frame: &FrameContext) {
        let ignored = frame.tracker.tracks.iter().filter(|t| frame.ignore_zone(t).is_some());
        self.dismissed = ignored.map(|t| t.id).collect();
    }

    /// The track has been associated after all.
    pub fn remove(&mut self, track: u64) {
        self.since.remove(&track);
        self.flashes.is_claimed(track);
    }

    /// Tracks that would be alerted now, and since when they have had no claim.
    pub fn due(&self, frame: &FrameContext) -> Vec<(u64, Timestamp)> {
        let tracks = frame.tracker.tracks.iter();
        tracks
            .filter_map(|track| Some((track, *self.since.get(&track.id)?)))
            .filter(|(track, since)| is_due(frame, track, *since))
            .filter(|(track, _)| !frame.alerts.is_open(&Cause::Track(track.id)))
            .map(|(track, since)| (track.id, since))
            .collect()
    }

    /// Since when each track without a claim and without an alert has had none.
    pub fn undecided(&self, alerts: &AlertLifecycle) -> Vec<Timestamp> {
        let open = |id: u64| alerts.is_open(&Cause::Track(id));
        self.since
            .iter()
            .filter(|(id, _)| !open(**id))
            .map(|(_, t)| *t)
            .collect()
    }
}

pub fn evaluate(frame: &FrameContext, memory: &mut Memory) -> Vec<Finding> {
    let mut findings = Vec::new();
    // Alerts as they will stand after these findings.
    let mut alerted: BTreeSet<u64> = frame
        .alerts
        .open()
        .filter_map(|(cause, _)| match cause {
            Cause::Track(id) => Some(*id),
            _ => None,
        })
        .collect();
    let before = alerted.clone();
    for track in &frame.tracker.tracks {
        let Some(since) = memory.since.get(&track.id).copied() else {
            continue;
        };
        if !alerted.contains(&track.id) {
            if !is_due(frame, track, since) {
                continue;
            }
            if let Some(from) = lost_alert_near(frame, memory, track, &findings) {
                if let Cause::Track(id) = from {
                    alerted.remove(&id);
                }
                let to = Cause::Track(track.id);
                findings.push(Finding::Renamed { from, to });
            }
            alerted.insert(track.id);
        }
        if track.hit && !memory.dismissed.contains(&track.id) {
            findings.push(Finding::present(Cause::Track(track.id), content(frame, track, since)));
        }
    }
    for id in before {
        let from = Cause::Track(id);
        let is_unclaimed = memory.since.contains_key(&id) && !memory.dismissed.contains(&id);
        let is_there = is_unclaimed && frame.tracker.get(id).is_some_and(Track::is_seen);
        if is_there || is_renamed(&findings, &from) {
            continue;
        }
        let Some(other) = swapped_with(frame, id, &alerted) else {
            findings.push(Finding::Absent(from));
            continue;
        };
        memory.since.insert(other, frame.now);
        alerted.remove(&id);
        alerted.insert(other);
        let to = Cause::Track(other);
        findings.push(Finding::Renamed { from, to });
    }
    findings
}

/// Threshold on a track's score.
fn threshold(frame: &FrameContext) -> f64 {
    frame.budget.threshold(TestFamily::Unclaimed, 1.0)
}

/// Whether a beam that has had no claim since then is an emitter, and claims have had time to come.
fn is_due(frame: &FrameContext, track: &Track, since: Timestamp) -> bool {
    let is_emitter = track.hit && track.unresolved_from.is_none() && track.confirmed && track.score >= threshold(frame);
    if !is_emitter {
        return false;
    }
    let waited_s = seconds(since, frame.now);
    if let Some(zone) = frame.restricted_zone(track) {
        // Where no user is listed, no claim can make a beam one who may be there.
        let is_known = zone.users.is_empty() || frame.is_settled();
        return is_known && waited_s >= RESTRICTED_WAIT_S;
    }
    frame.is_settled() && waited_s >= frame.claim_wait_s() && frame.ignore_zone(track).is_none()
}

/// The beam without a claim in the spot of track `id`, when `id` itself is associated with one: where two beams merge, which is
/// whose is a guess, and that one of them is nobody's is not.
fn swapped_with(frame: &FrameContext, id: u64, alerted: &BTreeSet<u64>) -> Option<u64> {
    let track = frame.tracker.get(id).filter(|_| frame.association.contains(id))?;
    let here = track.filter.position();
    let reach = SWAP_RESOLUTIONS * track.detection.resolution_m;
    let mut others = frame.tracker.tracks.iter().filter(|t| {
        t.id != id && t.is_seen() && t.confirmed && !frame.association.contains(t.id) && !alerted.contains(&t.id)
    });
    others
        .find(|t| (t.filter.position() - here).norm() < reach)
        .map(|t| t.id)
}

/// An open alert near here, not renamed by `findings` yet, whose own track was lost or is associated with a claim by now: the same cause.
fn lost_alert_near(frame: &FrameContext, memory: &Memory, track: &Track, findings: &[Finding]) -> Option<Cause> {
    let here = track.filter.position();
    let mut open = frame.alerts.open().filter(|(cause, _)| !is_renamed(findings, cause));
    open.find_map(|(cause, alert)| {
        let is_lost = match cause {
            Cause::Track(id) => !memory.since.contains_key(id) || frame.tracker.get(*id).is_none_or(|t| !t.hit),
            Cause::CoLocated(_) => true,
            _ => return None,
        };
        let place = Vector2::new(alert.x_m?, alert.y_m?);
        (is_lost && (here - place).norm() < SAME_PLACE_M).then(|| cause.clone())
    })
}

/// What else is evidence of an eavesdropper, each with its likelihood ratio against an honest stray beam.
fn content(frame: &FrameContext, track: &Track, since: Timestamp) -> Content {
    let lasted_s = seconds(since, frame.now);
    let mut evidence = json!({
        "track": track.id,
        "seen_since": track.since,
        "unclaimed_s": lasted_s,
        "log_likelihood_ratio": track.score,
        "threshold": threshold(frame),
        "energy_j": track.detection.energy_j,
        "energy_against_users": energy_against_users(frame, track),
        "nearest_user": nearest_user(frame, track),
        "vanished_users": vanished_users(frame, since),
        "flags": track.detection.flags,
    });
    // A flash before it, which counts as if the two were one.
    let before_s = seconds(since, track.since);
    if before_s > 0.0 {
        evidence["shone_before_s"] = json!(before_s);
    }
    let of_light = [
        ("lamp_or_beam", frame.light.lamp_or_beam(track, frame.budget.rate_hz())),
        ("rests_in", frame.light.rests_in(track)),
        ("ghost_of", ghost_of(frame, track)),
    ];
    for (key, value) in of_light {
        if let Some(value) = value {
            evidence[key] = value;
        }
    }
    let severity = match frame.restricted_zone(track) {
        Some(_) => Severity::Critical,
        None => Severity::of_duration(lasted_s),
    };
    Content::new(severity, evidence).at(frame.place(track), frame.position_cov(track))
}

/// The beam that this one is a reflection of, if it fades with one and stays beside it.
fn ghost_of(frame: &FrameContext, track: &Track) -> Option<Value> {
    let ghost = frame.light.ghost_of(track, &frame.tracker)?;
    let user = |i: usize| frame.claims[i].claim.user.as_str();
    let of = (0..frame.claims.len()).find(|i| frame.association.track_id(*i) == Some(ghost.of));
    Some(json!({
        "track": ghost.of,
        "user": of.map(user),
        "offset_m": ghost.offset_m,
        "correlation": ghost.correlation,
        "surprise": ghost.neg_log_p,
    }))
}

/// One who wants a user's light stands within its spot; one who does not is anywhere in view.
fn nearest_user(frame: &FrameContext, track: &Track) -> Option<Value> {
    let here = track.filter.position();
    let (claim, distance) = frame
        .claims
        .iter()
        .filter(|a| !a.ended)
        .map(|a| (a, (a.position - here).norm()))
        .min_by(|a, b| a.1.total_cmp(&b.1))?;
    let spot = frame.overlap_m();
    let by_chance = std::f64::consts::PI * spot * spot * frame.claims.len() as f64 / view_m2(&frame.view);
    let by_chance = by_chance.min(1.0);
    Some(json!({
        "user": claim.claim.user,
        "distance_m": distance,
        "likelihood_ratio": if distance <= spot { 1.0 / by_chance } else { 0.5 },
        "second_beam_for_claim": distance <= frame.config.tolerated_distance_m + claim.slack_m,
    }))
}

fn vanished_users(frame: &FrameContext, since: Timestamp) -> Vec<Value> {
    frame
        .claims
        .iter()
        .filter(|a| !frame.crowding.is_crowded() || a.before.was_seen())
        .filter_map(|a| {
            let gone = frame.users.get(&a.claim.user)?.unseen_since?;
            let gap = seconds(gone, since).abs();
            let by_chance = (2.0 * gap.max(0.1) / ABSENCE_PERIOD_S).min(1.0);
            Some(json!({ "user": a.claim.user, "apart_s": gap, "likelihood_ratio": 0.5 / by_chance }))
        })
        .collect()
}

fn energy_against_users(frame: &FrameContext, track: &Track) -> Option<Value> {
    let energies = frame
        .users
        .tracks()
        .filter_map(|id| Some(frame.tracker.get(id)?.detection.energy_j));
    let usual = median_high(energies)?;
    let off = (track.detection.energy_j.max(1e-30) / usual.max(1e-30)).ln();
    Some(json!({ "users_median_j": usual, "likelihood_ratio": stranger_likelihood_ratio(off) }))
}

#[cfg(test)]
#[path = "unclaimed_test.rs"]
mod tests;
