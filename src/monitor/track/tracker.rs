use std::collections::VecDeque;

use jiff::Timestamp;
use nalgebra::{Matrix2, Vector2};

use crate::assign::assign;
use crate::claims::seconds;
use crate::monitor::track::detection::Detection;
use crate::monitor::track::kalman::{KalmanFilter, largest_eigenvalue, mahalanobis2};

/// Squared Mahalanobis gate of the association: χ² of two degrees exceeds it 4 times in 10⁶.
const GATE: f64 = 25.0;
/// Handicap, in squared Mahalanobis distance, of a track that has melted into another's spot.
const SHARING: f64 = 4.0;
/// Added to the gate per axis, m: a beam may turn between two frames faster than the motion model likes.
const GATE_FLOOR_M: f64 = 0.4;
/// A track is confirmed by M hits of its last N frames.
const CONFIRM: (u32, u32) = (3, 5);
/// Hits in a row, one bit each, by which a track takes the place of the one whose spot it had melted into.
const SUCCEEDED: u32 = 0b111;
/// A confirmed track is kept this long without a hit, in time the sensor could see.
const KEEP_S: f64 = 1.5;
/// A beam missed for no longer than this still holds its claim against others, s.
const JUST_MISSED_S: f64 = 0.35;
/// With the sensor blind for longer, positions have nothing to do with what was.
const FORGET_AFTER_S: f64 = 30.0;
/// How far back a track knows where it was, for claims that come late.
const TRAIL_S: f64 = 6.0;
const TRAIL_STEP_S: f64 = 0.05;

/// A beam over time. Its identity comes from its positions alone.
#[derive(Clone, Debug)]
pub struct Track {
    pub id: u64,
    pub motion: KalmanFilter,
    pub since: Timestamp,
    pub last_hit: Timestamp,
    pub detection: Detection,
    pub confirmed: bool,
    /// Detected in the newest frame.
    pub hit: bool,
    /// The track whose spot the beam has melted into in the newest frame.
    pub merged_into: Option<u64>,
    /// The track whose spot it melted into, until the two have been seen beside each other again or it has taken the other's place.
    pub unresolved_from: Option<u64>,
    /// ln likelihood ratio of "an emitter" to "spurious detections".
    pub score: f64,
    /// Newest hits, one bit a frame.
    hits: u32,
    frames: u32,
    missed_s: f64,
    trail: VecDeque<(Timestamp, Vector2<f64>)>,
}

#[derive(Debug)]
pub struct Tracker {
    pub all: Vec<Track>,
    next_id: u64,
    time: Option<Timestamp>,
    score_ceiling: f64,
}

/// Chance that an emitter in view is detected in a frame; low, so that misses cost an eavesdropper's score little.
const DETECTED: f64 = 0.9;

impl Track {
    fn start(id: u64, time: Timestamp, detection: &Detection) -> Self {
        Self {
            id,
            motion: KalmanFilter::start(detection.position, detection.cov),
            since: time,
            last_hit: time,
            confirmed: false,
            hit: true,
            merged_into: None,
            unresolved_from: None,
            score: (DETECTED / detection.clutter_probability).ln(),
            hits: 1,
            frames: 1,
            missed_s: 0.0,
            trail: VecDeque::from([(time, detection.position)]),
            detection: detection.clone(),
        }
    }

    /// In a spot of its own or in another's.
    pub fn is_seen(&self) -> bool {
        self.hit || self.merged_into.is_some()
    }

    /// Followed well and missed only just now: its place is not free yet.
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

    /// A spot that another beam has `melted` into lies between the two: neither may take its place or its pace for its own. `beside`
    /// where the beam that it shadows is seen as well, or no more.
    fn take(&mut self, time: Timestamp, detection: &Detection, melted: bool, beside: bool, ceiling: f64) {
        let cov = if melted { detection.shared_cov() } else { detection.cov };
        self.motion.update(detection.position, cov);
        self.last_hit = time;
        self.hit = true;
        self.merged_into = None;
        self.score = (self.score + (DETECTED / detection.clutter_probability).ln()).min(ceiling);
        self.detection = detection.clone();
        self.note(true);
        if beside || self.hits & SUCCEEDED == SUCCEEDED {
            self.unresolved_from = None;
        }
        if self.unresolved_from.is_none() {
            self.missed_s = 0.0;
        }
        let due = self.trail.back().is_none_or(|(t, _)| seconds(*t, time) >= TRAIL_STEP_S);
        if due {
            self.trail.push_back((time, self.motion.position()));
            while self.trail.front().is_some_and(|(t, _)| seconds(*t, time) > TRAIL_S) {
                self.trail.pop_front();
            }
        }
    }

    fn miss(&mut self, dt: f64, clutter_probability: f64) {
        self.hit = false;
        self.merged_into = None;
        self.missed_s += dt;
        self.score += ((1.0 - DETECTED) / (1.0 - clutter_probability)).ln();
        self.note(false);
    }

    fn note(&mut self, hit: bool) {
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
    /// `score_ceiling` bounds how far a long life can outweigh later misses.
    pub fn new(score_ceiling: f64) -> Self {
        Self {
            all: Vec::new(),
            next_id: 1,
            time: None,
            score_ceiling,
        }
    }

    /// Links one frame's detections to the tracks; `dt_s` is the time the sensor could see since the last frame.
    pub fn step(&mut self, time: Timestamp, detections: &[Detection], dt_s: f64) {
        let elapsed = self.time.map_or(0.0, |t| seconds(t, time)).max(0.0);
        self.time = Some(time);
        if elapsed > FORGET_AFTER_S {
            self.all.clear();
        }
        for track in &mut self.all {
            track.motion.predict(elapsed);
        }
        let mut owner: Vec<Option<usize>> = vec![None; detections.len()];
        // Confirmed tracks choose first: a newcomer's wide gate must not take an old track's detection.
        for confirmed in [true, false] {
            let rows: Vec<usize> = (0..self.all.len())
                .filter(|&i| self.all[i].confirmed == confirmed)
                .collect();
            let columns: Vec<usize> = (0..detections.len()).filter(|&j| owner[j].is_none()).collect();
            let floor = Matrix2::identity() * GATE_FLOOR_M.powi(2);
            let matching = assign(rows.len(), columns.len(), GATE, |i, j| {
                let (track, d) = (&self.all[rows[i]], &detections[columns[j]]);
                let spread = track.motion.position_cov() + d.cov + floor;
                // A spot that two beams share stays with the one it was followed by.
                let shares = if track.merged_into.is_some() { SHARING } else { 0.0 };
                mahalanobis2(d.position - track.motion.position(), spread) + shares
            });
            for (i, j) in matching.pairs {
                owner[columns[j]] = Some(rows[i]);
            }
        }
        let mut hit = vec![None; self.all.len()];
        for (j, o) in owner.iter().enumerate() {
            if let Some(i) = *o {
                hit[i] = Some(j);
            }
        }
        // Spots that a known beam is followed by: only into such a one can another beam melt.
        let followed: Vec<Option<u64>> = owner
            .iter()
            .map(|o| Some(&self.all[(*o)?]).filter(|t| t.confirmed).map(|t| t.id))
            .collect();
        let mut melted = vec![false; detections.len()];
        for (track, _) in self.all.iter_mut().zip(&hit).filter(|(_, found)| found.is_none()) {
            match track.neighbour(detections, &followed) {
                Some((j, into)) => {
                    track.merge(into, &detections[j], dt_s);
                    melted[j] = true;
                }
                None => track.miss(dt_s, track.detection.clutter_probability),
            }
        }
        let unseen: Vec<u64> = self
            .all
            .iter()
            .zip(&hit)
            .filter(|(_, h)| h.is_none())
            .map(|(t, _)| t.id)
            .collect();
        for (track, found) in self.all.iter_mut().zip(&hit) {
            if let Some(j) = *found {
                let beside = track.unresolved_from.is_none_or(|other| !unseen.contains(&other));
                track.take(time, &detections[j], melted[j], beside, self.score_ceiling);
            }
        }
        self.all.retain(|t| !t.is_over());
        for (j, o) in owner.iter().enumerate() {
            if o.is_none() {
                self.all.push(Track::start(self.next_id, time, &detections[j]));
                self.next_id += 1;
            }
        }
    }

    /// Lets go of all tracks and of the time; numbers go on.
    pub fn forget(&mut self) {
        self.all.clear();
        self.time = None;
    }

    /// A number that no track will have.
    pub fn reserve(&mut self) -> u64 {
        self.next_id += 1;
        self.next_id - 1
    }

    pub fn get(&self, id: u64) -> Option<&Track> {
        self.all.iter().find(|t| t.id == id)
    }
}

impl Track {
    /// Without a detection of its own the beam may have melted into a neighbour's spot: which, and whose.
    fn neighbour(&self, detections: &[Detection], followed: &[Option<u64>]) -> Option<(usize, u64)> {
        let was_there = self.confirmed && self.is_seen();
        let here = self.motion.position();
        let spread = largest_eigenvalue(&self.motion.position_cov()).sqrt().min(1.0);
        let is_near = |d: &Detection| (d.position - here).norm() < d.resolution_m + GATE_FLOOR_M + 3.0 * spread;
        let mut spots = followed
            .iter()
            .enumerate()
            .filter_map(|(j, whose)| Some((j, (*whose)?)));
        spots.find(|(j, _)| was_there && is_near(&detections[*j]))
    }

    /// It is known to be there, as well as the two can be told apart.
    fn merge(&mut self, into: u64, spot: &Detection, dt_s: f64) {
        self.motion.update(spot.position, spot.shared_cov());
        self.merged_into = Some(into);
        self.unresolved_from = Some(into);
        self.hit = false;
        self.note(false);
        // Bounds a track that shadows another one: it lives a few times longer than one lost in the open.
        self.missed_s += 0.2 * dt_s;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn seen(x: f64) -> Detection {
        Detection {
            position: Vector2::new(x, 0.0),
            cov: Matrix2::identity() * 0.01,
            energy_j: 1.0,
            flags: crate::estimate::Flags::empty(),
            moments: Default::default(),
            snr: 100.0,
            resolution_m: 2.0,
            clutter_probability: 1e-4,
        }
    }

    #[test]
    fn one_spot_is_no_evidence_of_a_second_beam() {
        let mut tracks = Tracker::new(50.0);
        let mut frame = 0;
        let mut show = |tracks: &mut Tracker, places: &[f64]| {
            frame += 1;
            let time = Timestamp::from_millisecond(100 * frame).unwrap();
            let detections: Vec<_> = places.iter().map(|&x| seen(x)).collect();
            tracks.step(time, &detections, 0.1);
        };
        for _ in 0..20 {
            show(&mut tracks, &[0.0, 2.4]);
        }
        let [a, b] = [0, 1].map(|k| tracks.all[k].id);
        show(&mut tracks, &[0.0]);
        assert_eq!(tracks.get(b).unwrap().unresolved_from, Some(a));
        // A jump to where the other one was: its own track takes the detection.
        show(&mut tracks, &[2.4]);
        let track = tracks.get(b).unwrap();
        assert!(track.hit && track.unresolved_from == Some(a), "{track:?}");
        show(&mut tracks, &[0.0, 2.4]);
        assert_eq!(tracks.get(b).unwrap().unresolved_from, None);
    }
}
