//! Links each frame's detections to tracks. Their identity comes from positions alone.

use jiff::Timestamp;
use nalgebra::Matrix2;

use super::beam_track::{GATE, GATE_FLOOR_M, Track};
use super::detection::Detection;
use crate::assign::assign;
use crate::monitor::stats::gaussian::mahalanobis2;
use crate::time::seconds;

/// Handicap, in squared Mahalanobis distance, of a track whose measurement was merged into another's: a spot that two beams share
/// stays with the track that it was followed by. Not measured.
const MERGED_HANDICAP: f64 = 9.0;
/// Blindness after which positions have nothing to do with those before, s. Longer gives a stranger the identity of one who has
/// left, shorter gives users new ones. Not measured.
const FORGET_AFTER_S: f64 = 30.0;

/// All tracks.
#[derive(Debug)]
pub struct Tracker {
    pub tracks: Vec<Track>,
    next_id: u64,
    time: Option<Timestamp>,
    max_score: f64,
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

    /// Predicts the tracks, and links one frame's detections to them.
    #[cfg(test)]
    pub fn step(&mut self, time: Timestamp, detections: &[Detection], dt_s: f64) {
        self.predict(time);
        self.take(time, detections, dt_s);
    }

    /// Predicts every track to `time`; returns how far, s.
    pub fn predict(&mut self, time: Timestamp) -> f64 {
        let elapsed = self.time.map_or(0.0, |t| seconds(t, time)).max(0.0);
        self.time = Some(time);
        if elapsed > FORGET_AFTER_S {
            self.tracks.clear();
        }
        for track in &mut self.tracks {
            track.filter.predict(elapsed);
        }
        elapsed
    }

    /// Links one frame's detections to the tracks, which are predicted to its time; `dt_s` is the time since the last frame, usable or
    /// not, s.
    pub fn take(&mut self, time: Timestamp, detections: &[Detection], dt_s: f64) {
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
    use nalgebra::Vector2;

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
    fn a_beam_that_is_missed_merges_into_light_and_not_into_what_is_dark() {
        for (snr, is_merged) in [(100.0, true), (2.0, false)] {
            let mut scene = Scene::new();
            let apart = 0.5 * detection(0.0, 0.0).resolution_m;
            (0..5).for_each(|_| scene.show(&[0.0, apart]));
            let mut left = detection(0.0, 0.0);
            left.snr = snr;
            scene.tracker.step(at(6), &[left], 0.1);
            let missed = &scene.tracker.tracks[1];
            assert!(!missed.hit && missed.merged_into.is_some() == is_merged, "{snr}");
        }
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
        let then = at(20) + jiff::SignedDuration::from_millis(50);
        let track = &scene.tracker.tracks[0];
        assert!((track.at(then).unwrap() - Vector2::new(2.0, 0.0)).norm() < 1e-9);
        assert_eq!(track.at(at(0)), None);
        assert_eq!(track.at(at(33)), None);
        // Some claim every half a minute only.
        (0..300).for_each(|_| scene.show(&[2.0]));
        assert!(scene.tracker.tracks[0].at(then).is_some());
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
