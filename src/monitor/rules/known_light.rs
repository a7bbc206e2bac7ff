//! `known_light_changed`: a known light is no longer what was approved: a second beam in its spot, another energy or scintillation, or
//! another place.

use jiff::Timestamp;
use nalgebra::{Matrix2, Vector2};
use serde_json::json;

use crate::monitor::alert::{KNOWN_LIGHT, Severity};
use crate::monitor::finding::{Cause, Content, Finding};
use crate::monitor::frame_context::FrameContext;
use crate::monitor::known_lights::{Change, LightState};
use crate::monitor::rules::co_located;
use crate::monitor::rules::watched_spot::{Owner, WatchedSpot, watched_spots};
use crate::monitor::stats::co_location::CoLocationEvidence;
use crate::monitor::stats::error_budget::TestFamily;
use crate::monitor::stats::gaussian::neg_log_p_outside;
use crate::monitor::track::beam_track::Track;
use crate::time::seconds;

/// Tests of each light: its spot, energy, scintillation and place.
const TESTS: f64 = 4.0;

/// What is learned from a frame; the monitor adds it to the lights after the rules have read them.
#[derive(Debug, Default)]
pub struct Memory {
    observed: Vec<Observed>,
}

#[derive(Debug)]
struct Observed {
    id: String,
    ln_energy: Option<f64>,
    place: Vector2<f64>,
    suspected_since: Option<Timestamp>,
}

/// Evidence against one light.
struct Evidence {
    spot: CoLocationEvidence,
    change: Change,
    /// −ln p of its place.
    place: f64,
    away_m: f64,
}

impl Evidence {
    fn neg_log_p(&self) -> f64 {
        let all = [self.change.energy, self.change.scintillation, self.place];
        all.into_iter().fold(self.spot.neg_log_p(), f64::max)
    }

    /// What has changed.
    fn changed(&self, threshold: f64) -> Vec<&'static str> {
        let all = [
            ("second_beam", self.spot.neg_log_p()),
            ("energy", self.change.energy),
            ("scintillation", self.change.scintillation),
            ("place", self.place),
        ];
        all.into_iter()
            .filter(|(_, s)| *s > threshold)
            .map(|(name, _)| name)
            .collect()
    }
}

/// Tests every known light that is seen. One that is out has no alert; what comes on elsewhere in its stead is tested for its place.
pub fn evaluate(frame: &FrameContext, spots: &mut co_located::Memory, memory: &mut Memory) -> Vec<Finding> {
    let mut findings = Vec::new();
    memory.observed.clear();
    if !frame.lights.is_empty() {
        let tests = frame.claims.len() as f64 + TESTS * frame.lights.len() as f64;
        let threshold = frame.budget.threshold(TestFamily::CoLocated, tests);
        let watched = watched_spots(frame);
        for state in frame.lights.iter() {
            findings.extend(evaluate_light(frame, state, &watched, threshold, spots, memory));
        }
    }
    for (cause, _) in frame.alerts.open() {
        if let Cause::KnownLight(id) = cause
            && !frame.lights.get(id).is_some_and(|s| s.is_seen)
        {
            findings.push(Finding::Absent(cause.clone()));
        }
    }
    findings
}

fn evaluate_light(
    frame: &FrameContext,
    state: &LightState,
    watched: &[WatchedSpot],
    threshold: f64,
    spots: &mut co_located::Memory,
    memory: &mut Memory,
) -> Option<Finding> {
    let track = state
        .track
        .filter(|_| state.is_seen)
        .and_then(|id| frame.tracker.get(id))?;
    if !track.hit || !track.confirmed {
        return None;
    }
    let id = &state.light.id;
    let cause = Cause::KnownLight(id.clone());
    let is_open = frame.alerts.is_open(&cause);
    let spot = watched.iter().find(|w| w.owner == Owner::Light(id));
    let evidence = Evidence {
        spot: spot.map_or_else(CoLocationEvidence::default, |w| {
            spots.of_light(frame, w, watched, threshold)
        }),
        change: state
            .range
            .change(frame.config.tolerated_brightening, frame.lights.common_offset(id)),
        place: place_neg_log_p(frame, state, track),
        away_m: (track.filter.position() - state.expected).norm(),
    };
    let surprise = evidence.neg_log_p();
    let is_suspect = surprise > co_located::SUSPECT_SHARE * threshold;
    let suspected_since = is_suspect.then(|| state.suspected_since.unwrap_or(frame.now));
    memory.observed.push(Observed {
        id: id.clone(),
        ln_energy: spot.and_then(|spot| Some(spot.light(frame)?.ln_energy)),
        place: frame.world(track).into(),
        suspected_since,
    });
    // What cannot be tested in this frame says nothing.
    if spot.is_none() && evidence.place <= threshold {
        return None;
    }
    let has_lasted = suspected_since.is_some_and(|t| seconds(t, frame.now) >= frame.claim_wait_s());
    let is_due = surprise > threshold && (has_lasted || state.is_displaced);
    let stays = is_open && is_suspect;
    if !is_due && !stays {
        return is_open.then_some(Finding::Absent(cause));
    }
    let lasted_s = seconds(frame.alerts.raised_at(&cause).unwrap_or(frame.now), frame.now);
    let severity = match state.is_displaced {
        true => Severity::Critical,
        false => Severity::of_duration(lasted_s),
    };
    Some(Finding::present(
        cause,
        content(frame, state, track, &evidence, threshold, severity),
    ))
}

/// −ln p of where the light is, against its radius and against its learned place.
fn place_neg_log_p(frame: &FrameContext, state: &LightState, track: &Track) -> f64 {
    let here = track.filter.position();
    let cov: Matrix2<f64> = track.filter.position_cov() + frame.systematic_cov(here);
    let of_radius = neg_log_p_outside(here - state.expected, &cov, state.light.radius_m);
    let of_learned = state.range.place().map_or(0.0, |(place, reach_m)| {
        let expected = place + frame.displacement_at(place);
        neg_log_p_outside(here - expected, &cov, reach_m)
    });
    of_radius.max(of_learned)
}

fn content(
    frame: &FrameContext,
    state: &LightState,
    track: &Track,
    evidence: &Evidence,
    threshold: f64,
    severity: Severity,
) -> Content {
    let changed = match evidence.changed(threshold) {
        none if none.is_empty() => vec!["less than the threshold since"],
        some => some,
    };
    let (spot, change) = (&evidence.spot, &evidence.change);
    let evidence = json!({
        KNOWN_LIGHT: state.light.id,
        "note": state.light.note,
        "approved_by": state.light.by,
        "track": track.id,
        "changed": changed,
        "energy_j": track.detection.energy_j,
        "energy_over_the_learned": { "ratio": change.energy_ratio, "surprise": change.energy },
        "scintillation_over_the_learned": { "ratio": change.scintillation_ratio, "surprise": change.scintillation },
        "place": { "away_m": evidence.away_m, "radius_m": state.light.radius_m, "surprise": evidence.place },
        "came_on_elsewhere": state.is_displaced,
        "second_beam": {
            "surprise": spot.neg_log_p(),
            "energy_ratio": spot.energy.ratio,
            "step_aside_m": spot.step.length_m,
            "width_in_sigma2": spot.width.trace,
        },
        "learned": state.light.learned,
        "surprise": evidence.neg_log_p(),
        "threshold": threshold,
        "flags": track.detection.flags,
    });
    Content::new(severity, evidence).at(frame.place(track), frame.position_cov(track))
}

/// Adds the frame to what is known of the lights.
pub fn learn(frame: &mut FrameContext, memory: &Memory) {
    let mut grown = Vec::new();
    for seen in &memory.observed {
        let Some(state) = frame.lights.iter_mut().find(|s| s.light.id == seen.id) else {
            continue;
        };
        state.suspected_since = seen.suspected_since;
        let learns = seen.suspected_since.is_none();
        if state.range.push(frame.now, seen.ln_energy, seen.place, learns) {
            grown.push((seen.id.clone(), state.range.is_complete()));
        }
    }
    for (id, is_complete) in grown {
        let is_first = frame.lights.get(&id).is_some_and(|s| s.light.learned.is_none());
        frame.lights.take_learned(&id, is_first || is_complete);
    }
}
