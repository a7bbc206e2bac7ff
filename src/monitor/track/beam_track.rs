//! One beam followed from frame to frame: when it is confirmed, how sure it is to be an emitter, and when it ends.

use std::collections::VecDeque;

use jiff::Timestamp;
use nalgebra::Vector2;

use super::detection::{Detection, Earlier};
use super::manoeuvring::ManoeuvringFilter;
use super::user_track::ESTABLISHED_S;
use crate::monitor::stats::gaussian::largest_eigenvalue;
use crate::time::seconds;

/// Squared Mahalanobis distance within which a detection can be a track's and a track a claim's: χ² of two degrees exceeds it 4 times in
/// 10⁶. Larger lets neighbours swap, smaller loses one to an error of its covariance.
pub const GATE: f64 = 25.0;
/// Added to the gate per axis, m: a beam may turn between two frames faster than the motion model allows. Not measured.
pub const GATE_FLOOR_M: f64 = 0.4;
/// A track is confirmed by M hits of its last N frames. More hits delay every alert by a frame each; fewer confirm clutter.
const CONFIRM: (u32, u32) = (3, 5);
/// Hits in a row, one bit each, by which a track takes the place of the one whose measurement it had merged into. Longer leaves a
/// stranger who stays when the user leaves without an alert, shorter lets a chance detection count. Not measured.
const SUCCEEDED: u32 = 0b111;
/// Time for which a confirmed track is kept without a hit while the sensor sees, s. Longer keeps a track that may be taken for
/// another beam, shorter gives a beam that fades a new identity. Not measured.
const KEEP_S: f64 = 1.5;
/// Time for which a missed beam keeps its claim against others, s: three frames at 10 frames/s. Longer delays the association
/// with a beam that the user really moved to. Not measured.
const JUST_MISSED_S: f64 = 0.35;
/// Share of the time that a merged track counts as missed: it lives 1.5 s/0.2 = 7.5 s, longer than two users take to walk past
/// each other, and not for ever.
const MERGED_MISS_SHARE: f64 = 0.2;
/// Signal-to-noise ratio below which a frame shows no emitter. Larger takes faint beams that merge for missed ones, smaller has beams merge into an
/// emitter that has gone dark.
const LEAST_SNR: f64 = 4.0;
/// How far back a track knows where it was, s, for claims that come late or seldom, and in what steps. Longer serves later claims and takes
/// memory (30 kB for a minute); finer steps follow turns more exactly. Not tuned.
const TRAIL_S: f64 = 60.0;
const TRAIL_STEP_S: f64 = 0.05;
/// Every how many steps of it are looked at for whether two beams have met: two cars are within a spot width of each other for longer.
const MET_EVERY: usize = 5;
/// Distances at which two beams merge within which they may have been taken for each other: a beam that comes apart from another is found
/// again only farther away. Larger lets a liar take the beam of a user beside, smaller has users whose beams were exchanged accused.
const TAKEN_FOR: f64 = 2.0;
/// Probability that an emitter in view is detected in a frame. Low, so that misses cost an eavesdropper's score little. Assumed.
const DETECTION_PROBABILITY: f64 = 0.9;

/// A beam over time.
#[derive(Clone, Debug)]
pub struct Track {
    pub id: u64,
    pub filter: ManoeuvringFilter,
    pub since: Timestamp,
    pub last_hit: Timestamp,
    pub detection: Detection,
    pub confirmed: bool,
    /// Detected in the newest frame.
    pub hit: bool,
    /// The track whose measurement this beam's has merged into in the newest frame.
    pub merged_into: Option<u64>,
    /// The track whose measurement it last merged into, until both have been detected beside each other or this one has taken
    /// the other's place: until then its hits are no evidence of a beam of its own.
    pub unresolved_from: Option<u64>,
    /// ln likelihood ratio of "an emitter" to "clutter".
    pub score: f64,
    /// Newest hits, one bit a frame.
    hits: u32,
    frames: u32,
    missed_s: f64,
    trail: VecDeque<Past>,
}

/// Where a beam was.
#[derive(Clone, Copy, Debug)]
struct Past {
    time: Timestamp,
    position: Vector2<f64>,
    /// Distance from another beam within which the two may have been taken for each other, m.
    taken_for_m: f64,
}

impl Track {
    pub fn start(id: u64, time: Timestamp, detection: &Detection) -> Self {
        let mut track = Self {
            id,
            filter: ManoeuvringFilter::start(detection.position, detection.cov),
            since: time,
            last_hit: time,
            confirmed: false,
            hit: true,
            merged_into: None,
            unresolved_from: None,
            score: (DETECTION_PROBABILITY / detection.clutter_probability).ln(),
            hits: 1,
            frames: 1,
            missed_s: 0.0,
            trail: VecDeque::new(),
            detection: detection.clone(),
        };
        track.remember(time);
        track
    }

    /// Where it is now goes into its trail.
    fn remember(&mut self, time: Timestamp) {
        self.trail.push_back(Past {
            time,
            position: self.filter.position(),
            taken_for_m: TAKEN_FOR * self.merges_within_m(self.detection.resolution_m),
        });
        while self
            .trail
            .front()
            .is_some_and(|past| seconds(past.time, time) > TRAIL_S)
        {
            self.trail.pop_front();
        }
    }

    /// Detected, alone or merged with another.
    pub fn is_seen(&self) -> bool {
        self.hit || self.merged_into.is_some()
    }

    /// Confirmed and missed only in the last frames: its place is not free yet.
    pub fn is_just_missed(&self) -> bool {
        self.confirmed && !self.is_seen() && self.missed_s <= JUST_MISSED_S
    }

    /// Where the beam was at `time`, if the track reaches back that far.
    pub fn at(&self, time: Timestamp) -> Option<Vector2<f64>> {
        let after = self.trail.partition_point(|past| past.time <= time);
        match (after.checked_sub(1).map(|i| self.trail[i]), self.trail.get(after)) {
            (Some(a), Some(b)) => {
                let share = seconds(a.time, time) / seconds(a.time, b.time);
                Some(a.position + (b.position - a.position) * share)
            }
            (Some(last), None) if seconds(last.time, time) < 2.0 * TRAIL_STEP_S => Some(last.position),
            _ => None,
        }
    }

    /// Known for as long as it takes to be a user's.
    pub fn is_old(&self) -> bool {
        seconds(self.since, self.last_hit) >= ESTABLISHED_S
    }

    /// Whether two beams may have been taken for each other, as far back as both are known.
    pub fn has_met(&self, other: &Self) -> bool {
        let has_been_near = |a: &Self, b: &Self| {
            let is_near = |past: &Past| {
                let there = b.at(past.time);
                there.is_some_and(|there| (there - past.position).norm() < past.taken_for_m)
            };
            a.trail.iter().rev().step_by(MET_EVERY).any(is_near)
        };
        has_been_near(self, other) || has_been_near(other, self)
    }

    /// Whether the beam has moved by more than `least_m` since a time, and is nearer to `place` than half of that.
    pub fn has_gone_with(&self, place: Vector2<f64>, since: Timestamp, least_m: f64) -> bool {
        let here = self.filter.position();
        let moved_m = self.at(since).map_or(0.0, |then| (here - then).norm());
        moved_m > least_m && (here - place).norm() < 0.5 * moved_m
    }

    /// Distance from a spot of a resolution within which the beam merges into it, m.
    fn merges_within_m(&self, resolution_m: f64) -> f64 {
        let spread = largest_eigenvalue(&self.filter.position_cov()).sqrt().min(1.0);
        resolution_m + GATE_FLOOR_M + 3.0 * spread
    }

    /// Takes a detection. One that another beam `is_merged` into lies between the two: neither takes its place or its velocity
    /// from it. `is_resolved` where the beam that it had merged with is detected as well, or is no more.
    pub fn take(&mut self, time: Timestamp, detection: &Detection, is_merged: bool, is_resolved: bool, max_score: f64) {
        let cov = if is_merged {
            detection.merged_cov()
        } else {
            detection.cov
        };
        // Filtering a posterior again would count the same light twice.
        match detection.earlier {
            Earlier::Nothing => self.filter.update(detection.position, cov),
            Earlier::All { velocity } => self.filter.adopt(detection.position, cov, velocity),
            Earlier::Own { cov: own } => self.filter.update_beside(detection.position, cov, own),
        }
        self.last_hit = time;
        self.hit = true;
        self.merged_into = None;
        self.score = (self.score + (DETECTION_PROBABILITY / detection.clutter_probability).ln()).min(max_score);
        self.detection = detection.clone();
        self.count(true);
        if is_resolved || self.hits & SUCCEEDED == SUCCEEDED {
            self.unresolved_from = None;
        }
        if self.unresolved_from.is_none() {
            self.missed_s = 0.0;
        }
        let is_due = |last: &Past| seconds(last.time, time) >= TRAIL_STEP_S;
        if self.trail.back().is_none_or(is_due) {
            self.remember(time);
        }
    }

    pub fn miss(&mut self, dt: f64) {
        self.hit = false;
        self.merged_into = None;
        self.missed_s += dt;
        let clutter = self.detection.clutter_probability;
        self.score += ((1.0 - DETECTION_PROBABILITY) / (1.0 - clutter)).ln();
        self.count(false);
    }

    /// Without a detection of its own: it is known to be in `spot`, to within the resolution.
    pub fn merge(&mut self, into: u64, spot: &Detection, dt_s: f64) {
        self.filter.update(spot.position, spot.merged_cov());
        self.merged_into = Some(into);
        self.unresolved_from = Some(into);
        self.hit = false;
        self.count(false);
        self.missed_s += MERGED_MISS_SHARE * dt_s;
    }

    /// The detection that a beam without one of its own may have merged into, and the track that follows it. Only a detection
    /// that a confirmed track is followed by can hold another beam.
    pub fn merges_into(&self, detections: &[Detection], followed: &[Option<u64>]) -> Option<(usize, u64)> {
        let was_there = self.confirmed && self.is_seen();
        let here = self.filter.position();
        let is_near = |d: &Detection| (d.position - here).norm() < self.merges_within_m(d.resolution_m);
        // Without it an emitter is known from earlier frames alone, and hides nobody.
        let has_light = |d: &Detection| d.snr > LEAST_SNR;
        let mut spots = followed
            .iter()
            .enumerate()
            .filter_map(|(j, whose)| Some((j, (*whose)?)));
        spots.find(|(j, _)| was_there && is_near(&detections[*j]) && has_light(&detections[*j]))
    }

    fn count(&mut self, hit: bool) {
        let (m, n) = CONFIRM;
        self.hits = (self.hits << 1) | u32::from(hit);
        self.frames = self.frames.saturating_add(1);
        self.confirmed |= (self.hits & ((1 << n) - 1)).count_ones() >= m;
    }

    pub fn is_over(&self) -> bool {
        let (m, n) = CONFIRM;
        if self.confirmed {
            return self.missed_s > KEEP_S;
        }
        let misses = self.frames.min(n) - (self.hits & ((1 << n) - 1)).count_ones();
        misses > n - m
    }
}
