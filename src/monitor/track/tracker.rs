//! Tracks: beams followed from frame to frame. Their identity comes from positions alone.

use std::collections::VecDeque;

use jiff::Timestamp;
use nalgebra::{Matrix2, Vector2};

use super::detection::Detection;
use super::kalman::KalmanFilter;
use crate::assign::assign;
use crate::claims::seconds;
use crate::monitor::stats::gaussian::{largest_eigenvalue, mahalanobis2};

/// Squared Mahalanobis gate of the association: χ² of two degrees exceeds it 4 times in 10⁶. Larger lets neighbours swap, smaller
/// loses a track to an error of its covariance.
const GATE: f64 = 25.0;
/// Added to the gate per axis, m: a beam may turn between two frames faster than the motion model allows. Not measured.
const GATE_FLOOR_M: f64 = 0.4;
/// Handicap, in squared Mahalanobis distance, of a track whose measurement was merged into another's: a spot that two beams share
/// stays with the track that it was followed by. Not measured.
const MERGED_HANDICAP: f64 = 4.0;
/// A track is confirmed by M hits of its last N frames. More hits delay every alert by a frame each; fewer confirm clutter.
const CONFIRM: (u32, u32) = (3, 5);
/// Hits in a row, one bit each, by which a track takes the place of the one whose measurement it had merged into.
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
/// Blindness after which positions have nothing to do with those before, s.
const FORGET_AFTER_S: f64 = 30.0;
/// How far back a track knows where it was, s, for claims that come late, and in what steps.
const TRAIL_S: f64 = 6.0;
const TRAIL_STEP_S: f64 = 0.05;
/// Probability that an emitter in view is detected in a frame. Low, so that misses cost an eavesdropper's score little. Assumed.
const DETECTION_PROBABILITY: f64 = 0.9;

/// A beam over time.
#[derive(Clone, Debug)]
pub struct Track {
    pub id: u64,
    pub filter: KalmanFilter,
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
    trail: VecDeque<(Timestamp, Vector2<f64>)>,
}

/// All tracks.
#[derive(Debug)]
pub struct Tracker {
    pub tracks: Vec<Track>,
    next_id: u64,
    time: Option<Timestamp>,
    max_score: f64,
}

impl Track {
    fn start(id: u64, time: Timestamp, detection: &Detection) -> Self {
        Self {
            id,
            filter: KalmanFilter::start(detection.position, detection.cov),
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
            trail: VecDeque::from([(time, detection.position)]),
            detection: detection.clone(),
        }
    }

    /// The same track with another newest detection.
    pub fn with_detection(&self, detection: Detection) -> Self {
        Self {
            detection,
            ..self.clone()
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
        let after = self.trail.partition_point(|(t, _)| *t <= time);
        match (after.checked_sub(1).map(|i| self.trail[i]), self.trail.get(after)) {
            (Some((ta, a)), Some(&(tb, b))) => Some(a + (b - a) * (seconds(ta, time) / seconds(ta, tb))),
            (Some((t, p)), None) if seconds(t, time) < 2.0 * TRAIL_STEP_S => Some(p),
            _ => None,
        }
    }

    /// Takes a detection. One that another beam `is_merged` into lies between the two: neither takes its place or its velocity
    /// from it. `is_resolved` where the beam that it had merged with is detected as well, or is no more.
    fn take(&mut self, time: Timestamp, detection: &Detection, is_merged: bool, is_resolved: bool, max_score: f64) {
        let cov = if is_merged {
            detection.merged_cov()
        } else {
            detection.cov
        };
        self.filter.update(detection.position, cov);
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
        let due = self.trail.back().is_none_or(|(t, _)| seconds(*t, time) >= TRAIL_STEP_S);
        if due {
            self.trail.push_back((time, self.filter.position()));
            while self.trail.front().is_some_and(|(t, _)| seconds(*t, time) > TRAIL_S) {
                self.trail.pop_front();
            }
        }
    }

    fn miss(&mut self, dt: f64) {
        self.hit = false;
        self.merged_into = None;
        self.missed_s += dt;
        let clutter = self.detection.clutter_probability;
        self.score += ((1.0 - DETECTION_PROBABILITY) / (1.0 - clutter)).ln();
        self.count(false);
    }

    /// Without a detection of its own: it is known to be in `spot`, to within the resolution.
    fn merge(&mut self, into: u64, spot: &Detection, dt_s: f64) {
        self.filter.update(spot.position, spot.merged_cov());
        self.merged_into = Some(into);
        self.unresolved_from = Some(into);
        self.hit = false;
        self.count(false);
        self.missed_s += MERGED_MISS_SHARE * dt_s;
    }

    /// The detection that a beam without one of its own may have merged into, and the track that follows it. Only a detection
    /// that a confirmed track is followed by can hold another beam.
    fn merges_into(&self, detections: &[Detection], followed: &[Option<u64>]) -> Option<(usize, u64)> {
        let was_there = self.confirmed && self.is_seen();
        let here = self.filter.position();
        let spread = largest_eigenvalue(&self.filter.position_cov()).sqrt().min(1.0);
        let is_near = |d: &Detection| (d.position - here).norm() < d.resolution_m + GATE_FLOOR_M + 3.0 * spread;
        let mut spots = followed
            .iter()
            .enumerate()
            .filter_map(|(j, whose)| Some((j, (*whose)?)));
        spots.find(|(j, _)| was_there && is_near(&detections[*j]))
    }

    fn count(&mut self, hit: bool) {
        let (m, n) = CONFIRM;
        self.hits = (self.hits << 1) | u32::from(hit);
        self.frames = self.frames.saturating_add(1);
        self.confirmed |= (self.hits & ((1 << n) - 1)).count_ones() >= m;
    }

    fn is_over(&self) -> bool {
        let (m, n) = CONFIRM;
        if self.confirmed {
            return self.missed_s > KEEP_S;
        }
        let misses = self.frames.min(n) - (self.hits & ((1 << n) - 1)).count_ones();
        misses > n - m
    }
}

impl Tracker {
    /// `max_score` bounds how far a long life outweighs later misses.
    pub fn new(max_score: f64) -> Self {
        Self {
            tracks: Vec::new(),
            next_id: 1,
            time: None,
            max_score,
        }
    }

    pub fn set_max_score(&mut self, max_score: f64) {
        self.max_score = max_score;
    }

    /// Links one frame's detections to the tracks; `dt_s` is the time since the last frame, s.
    pub fn step(&mut self, time: Timestamp, detections: &[Detection], dt_s: f64) {
        let elapsed = self.time.map_or(0.0, |t| seconds(t, time)).max(0.0);
        self.time = Some(time);
        if elapsed > FORGET_AFTER_S {
            self.tracks.clear();
        }
        for track in &mut self.tracks {
            track.filter.predict(elapsed);
        }
        let owner = self.link(detections);
        let mut hit = vec![None; self.tracks.len()];
        for (j, o) in owner.iter().enumerate() {
            if let Some(i) = *o {
                hit[i] = Some(j);
            }
        }
        let is_merged = self.miss_or_merge(detections, &owner, &hit, dt_s);
        let missing: Vec<u64> = self
            .tracks
            .iter()
            .zip(&hit)
            .filter(|(_, h)| h.is_none())
            .map(|(t, _)| t.id)
            .collect();
        for (track, found) in self.tracks.iter_mut().zip(&hit) {
            if let Some(j) = *found {
                let is_resolved = track.unresolved_from.is_none_or(|other| !missing.contains(&other));
                track.take(time, &detections[j], is_merged[j], is_resolved, self.max_score);
            }
        }
        self.tracks.retain(|t| !t.is_over());
        for (j, o) in owner.iter().enumerate() {
            if o.is_none() {
                self.tracks.push(Track::start(self.next_id, time, &detections[j]));
                self.next_id += 1;
            }
        }
    }

    /// The index of each detection's track. Confirmed tracks choose first: a new track's wide gate must not take an old
    /// one's detection.
    fn link(&self, detections: &[Detection]) -> Vec<Option<usize>> {
        let mut owner: Vec<Option<usize>> = vec![None; detections.len()];
        for confirmed in [true, false] {
            let rows: Vec<usize> = (0..self.tracks.len())
                .filter(|&i| self.tracks[i].confirmed == confirmed)
                .collect();
            let columns: Vec<usize> = (0..detections.len()).filter(|&j| owner[j].is_none()).collect();
            let floor = Matrix2::identity() * GATE_FLOOR_M.powi(2);
            let matching = assign(rows.len(), columns.len(), GATE, |i, j| {
                let (track, d) = (&self.tracks[rows[i]], &detections[columns[j]]);
                let spread = track.filter.position_cov() + d.cov + floor;
                let handicap = if track.merged_into.is_some() {
                    MERGED_HANDICAP
                } else {
                    0.0
                };
                mahalanobis2(d.position - track.filter.position(), spread) + handicap
            });
            for (i, j) in matching.pairs {
                owner[columns[j]] = Some(rows[i]);
            }
        }
        owner
    }

    /// Misses or merges every track without a detection; gives which detections another beam has merged into.
    fn miss_or_merge(
        &mut self,
        detections: &[Detection],
        owner: &[Option<usize>],
        hit: &[Option<usize>],
        dt_s: f64,
    ) -> Vec<bool> {
        let followed: Vec<Option<u64>> = owner
            .iter()
            .map(|o| Some(&self.tracks[(*o)?]).filter(|t| t.confirmed).map(|t| t.id))
            .collect();
        let mut is_merged = vec![false; detections.len()];
        for (track, _) in self.tracks.iter_mut().zip(hit).filter(|(_, found)| found.is_none()) {
            match track.merges_into(detections, &followed) {
                Some((j, into)) => {
                    track.merge(into, &detections[j], dt_s);
                    is_merged[j] = true;
                }
                None => track.miss(dt_s),
            }
        }
        is_merged
    }

    /// Forgets all tracks and the time; ids go on.
    pub fn forget(&mut self) {
        self.tracks.clear();
        self.time = None;
    }

    /// An id that no track will have.
    pub fn reserve(&mut self) -> u64 {
        self.next_id += 1;
        self.next_id - 1
    }

    pub fn get(&self, id: u64) -> Option<&Track> {
        self.tracks.iter().find(|t| t.id == id)
    }
}

#[cfg(test)]
mod tests {
    use super::super::detection::fixture::detection;
    use super::*;

    struct Scene {
        tracker: Tracker,
        frame: i64,
    }

    impl Scene {
        fn new() -> Self {
            Self {
                tracker: Tracker::new(50.0),
                frame: 0,
            }
        }

        /// A frame, 0.1 s after the one before, with beams at these x.
        fn show(&mut self, places: &[f64]) {
            self.frame += 1;
            let detections: Vec<_> = places.iter().map(|&x| detection(x, 0.0)).collect();
            self.tracker.step(at(self.frame), &detections, 0.1);
        }

        fn ids(&self) -> Vec<u64> {
            self.tracker.tracks.iter().map(|t| t.id).collect()
        }
    }

    fn at(frame: i64) -> Timestamp {
        Timestamp::from_millisecond(100 * frame).unwrap()
    }

    #[test]
    fn three_hits_of_five_confirm_and_three_misses_of_five_end() {
        let mut scene = Scene::new();
        for (places, confirmed) in [(&[0.0][..], false), (&[], false), (&[0.0], false), (&[0.0], true)] {
            scene.show(places);
            assert_eq!(scene.tracker.tracks[0].confirmed, confirmed);
        }
        let mut scene = Scene::new();
        for places in [&[0.0][..], &[], &[]] {
            scene.show(places);
            assert_eq!(scene.ids(), [1]);
        }
        scene.show(&[]);
        assert!(scene.ids().is_empty());
    }

    #[test]
    fn a_confirmed_track_outlives_a_second_and_a_half() {
        let mut scene = Scene::new();
        (0..5).for_each(|_| scene.show(&[0.0]));
        (0..3).for_each(|_| scene.show(&[]));
        assert!(scene.tracker.tracks[0].is_just_missed());
        (0..11).for_each(|_| scene.show(&[]));
        assert_eq!(scene.ids(), [1]);
        assert!(!scene.tracker.tracks[0].is_just_missed());
        (0..2).for_each(|_| scene.show(&[]));
        assert!(scene.ids().is_empty());
    }

    #[test]
    fn the_score_is_a_sum_of_log_likelihood_ratios() {
        let mut scene = Scene::new();
        scene.show(&[0.0]);
        scene.show(&[0.0]);
        scene.show(&[]);
        let expected = 2.0 * (0.9f64 / 1e-4).ln() + (0.1f64 / (1.0 - 1e-4)).ln();
        assert!((scene.tracker.tracks[0].score - expected).abs() < 1e-9);
        (0..20).for_each(|_| scene.show(&[0.0]));
        assert_eq!(scene.tracker.tracks[0].score, 50.0);
    }

    #[test]
    fn a_confirmed_track_keeps_its_detection_against_a_newcomer() {
        let mut scene = Scene::new();
        (0..5).for_each(|_| scene.show(&[0.0]));
        scene.show(&[0.0, 6.0]);
        scene.show(&[0.3]);
        assert!(scene.tracker.get(1).unwrap().hit);
        assert!(!scene.tracker.get(2).unwrap().hit);
    }

    #[test]
    fn the_trail_interpolates_between_frames() {
        let mut scene = Scene::new();
        (0..30).for_each(|_| scene.show(&[2.0]));
        let track = &scene.tracker.tracks[0];
        let then = track.at(at(20) + jiff::SignedDuration::from_millis(50)).unwrap();
        assert!((then - Vector2::new(2.0, 0.0)).norm() < 1e-9);
        assert_eq!(track.at(at(0)), None);
        assert_eq!(track.at(at(33)), None);
    }

    #[test]
    fn after_half_a_minute_in_the_dark_nothing_is_the_same() {
        let mut scene = Scene::new();
        (0..5).for_each(|_| scene.show(&[0.0]));
        scene.frame += 301;
        scene.show(&[0.0]);
        assert_eq!(scene.ids(), [2]);
    }

    #[test]
    fn one_spot_is_no_evidence_of_a_second_beam() {
        let mut scene = Scene::new();
        for _ in 0..20 {
            scene.show(&[0.0, 2.4]);
        }
        let [a, b] = [0, 1].map(|k| scene.tracker.tracks[k].id);
        scene.show(&[0.0]);
        assert_eq!(scene.tracker.get(b).unwrap().unresolved_from, Some(a));
        // A jump to where the other one was: its own track takes the detection.
        scene.show(&[2.4]);
        let track = scene.tracker.get(b).unwrap();
        assert!(track.hit && track.unresolved_from == Some(a), "{track:?}");
        scene.show(&[0.0, 2.4]);
        assert_eq!(scene.tracker.get(b).unwrap().unresolved_from, None);
    }

    #[test]
    fn a_merged_track_lives_for_seven_and_a_half_seconds() {
        let mut scene = Scene::new();
        (0..10).for_each(|_| scene.show(&[0.0, 1.5]));
        (0..74).for_each(|_| scene.show(&[0.0]));
        assert_eq!(scene.ids().len(), 2);
        (0..3).for_each(|_| scene.show(&[0.0]));
        assert_eq!(scene.ids().len(), 1);
    }
}
