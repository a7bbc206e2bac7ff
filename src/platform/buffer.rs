//! The newest poses in order of time, and the pose at a time: interpolated between two, and beyond the last with a covariance
//! that grows with its age.

use std::collections::VecDeque;

use jiff::{SignedDuration, Timestamp};
use nalgebra::Vector6;

use crate::pose::Pose;
use crate::time::seconds;

/// Poses kept: 20 s of an autopilot's 200 Hz, so that the frames of a slow estimator still find theirs.
const CAPACITY: usize = 4096;
/// Poses nearer than this in time are one that came twice, s: no autopilot sends that fast, and a stamp is related to UTC anew
/// with each message, by two clocks that are read one after the other.
const SAME_S: f64 = 50e-6;
/// A pose this much older than the newest, or this much newer, s, is taken for a wrong stamp at first.
const JUMP_BACK_S: f64 = 2.0;
const JUMP_AHEAD_S: f64 = 30.0;
/// Wrong stamps in a row from which on they are right and the clock was set: the buffer starts anew. Fewer let single wild
/// stamps empty it, more make a set clock a longer gap (at 50 Hz, 0.2 s).
const JUMPS_IN_A_ROW: u32 = 10;

/// Angular acceleration (rad/s²) and acceleration (m/s²) by which motion between two poses departs from a uniform one. By
/// interpolating thinned real logs (42, 17 and 8 Hz leave 0.27, 1.0 and 3.1 mrad rms), 2 to 5 rad/s². Larger widens positions
/// between sparse poses, smaller alerts users in gusts.
const TURN_RAD_S2: f64 = 3.0;
const ACCELERATION_M_S2: f64 = 2.0;
/// Beyond the last pose, how long its rates are taken to go on, s: a telemetry's usual delay. Longer follows a sway past its
/// turning point, shorter lags behind it. The error of an older pose is not its delay's, and frames wait for a newer one.
pub(super) const UNIFORM_S: f64 = 0.1;
/// Rates at which attitude (rad/s) and position (m/s) wander from there on: a sway of 8° in 8 s has 0.08 rad/s rms.
const WANDER_RAD_S: f64 = 0.1;
const WANDER_M_S: f64 = 3.0;
/// A platform that flies keeps its tilt within this, rad rms (8°): older poses tell no less. Headings and places have no bound.
const MAX_TILT_RAD: f64 = 0.14;

/// The newest poses, bounded.
#[derive(Debug, Default)]
pub struct PoseBuffer {
    poses: VecDeque<Pose>,
    jumps: u32,
    counts: Counts,
}

/// What became of the poses that came in.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counts {
    pub accepted: u64,
    /// Accepted, but older than one before it.
    pub out_of_order: u64,
    /// Refused: the time of one that is there already, or next to it.
    pub duplicate: u64,
    /// Refused: older than all that are kept.
    pub too_old: u64,
    /// Refused: far from the newest in time, either way.
    pub jumped: u64,
    /// Times that the buffer started anew because the clock of the poses was set.
    pub restarts: u64,
}

/// What became of one pose.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Outcome {
    Accepted,
    OutOfOrder,
    Duplicate,
    TooOld,
    Jumped,
    /// Accepted as the first of a new buffer.
    Restarted,
}

/// The pose at a time, and how far that time is from what is known.
#[derive(Clone, Debug)]
pub struct PoseAt {
    pub pose: Pose,
    /// Seconds since the newest pose before this time; how long before the first where there is none before.
    pub age_s: f64,
    /// Body angular rate in the world (about north, east, down), rad/s, and velocity (east, north, up), m/s; zero where only one
    /// pose is known.
    pub rates: Vector6<f64>,
}

impl PoseBuffer {
    /// Takes a pose; in order or not.
    pub fn insert(&mut self, pose: Pose) -> Outcome {
        let outcome = self.place(pose);
        let counts = &mut self.counts;
        match outcome {
            Outcome::Accepted => {}
            Outcome::OutOfOrder => counts.out_of_order += 1,
            Outcome::Duplicate => counts.duplicate += 1,
            Outcome::TooOld => counts.too_old += 1,
            Outcome::Jumped => counts.jumped += 1,
            Outcome::Restarted => counts.restarts += 1,
        }
        if matches!(outcome, Outcome::Accepted | Outcome::OutOfOrder | Outcome::Restarted) {
            counts.accepted += 1;
        }
        outcome
    }

    fn place(&mut self, pose: Pose) -> Outcome {
        let Some(newest) = self.poses.back() else {
            self.poses.push_back(pose);
            return Outcome::Accepted;
        };
        let ahead_s = seconds(newest.time, pose.time);
        if !(-JUMP_BACK_S..=JUMP_AHEAD_S).contains(&ahead_s) {
            self.jumps += 1;
            if self.jumps < JUMPS_IN_A_ROW {
                return Outcome::Jumped;
            }
            self.jumps = 0;
            self.poses.clear();
            self.poses.push_back(pose);
            return Outcome::Restarted;
        }
        self.jumps = 0;
        let place = match ahead_s > 0.0 {
            true => self.poses.len(),
            false => self.poses.partition_point(|p| p.time < pose.time),
        };
        let mut nearest = self
            .poses
            .range(place.saturating_sub(1)..self.poses.len().min(place + 1));
        if nearest.any(|p| seconds(p.time, pose.time).abs() < SAME_S) {
            return Outcome::Duplicate;
        }
        let is_full = self.poses.len() >= CAPACITY;
        if is_full && place == 0 {
            return Outcome::TooOld;
        }
        let is_newest = place == self.poses.len();
        self.poses.insert(place, pose);
        if is_full {
            self.poses.pop_front();
        }
        match is_newest {
            true => Outcome::Accepted,
            false => Outcome::OutOfOrder,
        }
    }

    pub fn counts(&self) -> Counts {
        self.counts
    }

    pub fn newest(&self) -> Option<&Pose> {
        self.poses.back()
    }

    /// Rates about `time`, from the poses `half_s` before and after; `None` until there are poses on either side. Errors of the poses
    /// themselves go into them and into the pose at `time` independently, which those of two neighbours do not.
    pub fn rates_about(&self, time: Timestamp, half_s: f64) -> Option<Vector6<f64>> {
        let half = SignedDuration::from_secs_f64(half_s);
        let (before, after) = (time.saturating_sub(half).ok()?, time.saturating_add(half).ok()?);
        let is_inside = self.poses.front()?.time <= before && self.poses.back()?.time >= after;
        is_inside.then_some(())?;
        Some(rates(&self.at(before)?.pose, &self.at(after)?.pose, 2.0 * half_s))
    }

    /// Rates about `time` from the poses up to `half_s` before and after, as far as they reach; `None` where they span less than `half_s`.
    pub fn mean_rates(&self, time: Timestamp, half_s: f64) -> Option<Vector6<f64>> {
        let half = SignedDuration::from_secs_f64(half_s);
        let from = time.saturating_sub(half).ok()?.max(self.poses.front()?.time);
        let to = time.saturating_add(half).ok()?.min(self.poses.back()?.time);
        let span_s = seconds(from, to);
        (span_s >= half_s).then_some(())?;
        Some(rates(&self.at(from)?.pose, &self.at(to)?.pose, span_s))
    }

    /// The pose at `time`: between two by slerp; beyond the ends at the nearest rates for a tenth of a second, then held. Its
    /// covariance says how far the platform may have moved from there. `None` while no pose is known.
    pub fn at(&self, time: Timestamp) -> Option<PoseAt> {
        // Frames come with the newest poses: a search among all would fetch old ones.
        let later = self.poses.iter().rev().take_while(|p| p.time > time).count();
        let after = self.poses.len() - later;
        let (Some(first), Some(last)) = (self.poses.front(), self.poses.back()) else {
            return None;
        };
        if self.poses.len() == 1 {
            let age_s = seconds(last.time, time).abs();
            return Some(held(last.clone(), time, age_s, Vector6::zeros()));
        }
        // The two poses at or around the time, or the two nearest to it.
        let next = after.clamp(1, self.poses.len() - 1);
        let (a, b) = (&self.poses[next - 1], &self.poses[next]);
        let gap_s = seconds(a.time, b.time);
        let rates = rates(a, b, gap_s);
        let past_s = seconds(last.time, time).max(seconds(time, first.time));
        if past_s > 0.0 {
            let is_after = time > last.time;
            let uniform_s = past_s.min(UNIFORM_S);
            let share = if is_after {
                1.0 + uniform_s / gap_s
            } else {
                -uniform_s / gap_s
            };
            return Some(held(a.towards(b, share, time), time, past_s, rates));
        }
        let since_s = seconds(a.time, time);
        let mut pose = a.towards(b, since_s / gap_s, time);
        // A parabola through both poses departs from the chord by half its acceleration times the distances to the ends; across
        // a long gap no more than the wandering from the nearer end.
        let parabola = 0.5 * since_s * (gap_s - since_s);
        widen(&mut pose, parabola, since_s.min(gap_s - since_s));
        Some(PoseAt {
            pose,
            age_s: since_s,
            rates,
        })
    }
}

/// A pose that is `age_s` old at `time`.
fn held(mut pose: Pose, time: Timestamp, age_s: f64, rates: Vector6<f64>) -> PoseAt {
    pose.time = time;
    widen(&mut pose, 0.5 * age_s * age_s, age_s);
    PoseAt { pose, age_s, rates }
}

fn rates(a: &Pose, b: &Pose, gap_s: f64) -> Vector6<f64> {
    let turn = crate::pose::rotation_between(&a.attitude, &b.attitude) / gap_s;
    let velocity = [0, 1, 2].map(|k| (b.position_m[k] - a.position_m[k]) / gap_s);
    Vector6::new(turn.x, turn.y, turn.z, velocity[0], velocity[1], velocity[2])
}

/// Adds what an acceleration over `half_s2` (half a time squared) or a wandering over `away_s`, whichever is less, makes of it.
fn widen(pose: &mut Pose, half_s2: f64, away_s: f64) {
    let turn = (TURN_RAD_S2 * half_s2).min(WANDER_RAD_S * away_s);
    let shift = (ACCELERATION_M_S2 * half_s2).min(WANDER_M_S * away_s);
    let tilt = turn.min(MAX_TILT_RAD);
    let heading = turn.min(std::f64::consts::PI);
    for (k, sigma) in [tilt, tilt, heading, shift, shift, shift].into_iter().enumerate() {
        pose.cov[(k, k)] += sigma * sigma;
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::UnitQuaternion;

    use super::*;

    fn at(s: f64) -> Timestamp {
        Timestamp::UNIX_EPOCH + SignedDuration::from_nanos((s * 1e9).round() as i64)
    }

    /// A pose that turns about north by 0.1 rad/s and goes east by 2 m/s.
    fn pose(s: f64) -> Pose {
        Pose {
            attitude: UnitQuaternion::from_euler_angles(0.1 * s, 0.0, 0.0),
            ..Pose::level(at(s), [2.0 * s, 0.0, 300.0])
        }
    }

    fn filled(times: &[f64]) -> PoseBuffer {
        let mut buffer = PoseBuffer::default();
        for t in times {
            buffer.insert(pose(*t));
        }
        buffer
    }

    #[test]
    fn order_does_not_matter_and_each_time_counts_once() {
        let mut buffer = filled(&[10.0, 10.2, 10.1]);
        for again in [10.1, 10.1 - 1e-7, 10.1 + 1e-7, 10.2 + 1e-7] {
            assert_eq!(buffer.insert(pose(again)), Outcome::Duplicate);
        }
        let counts = buffer.counts();
        assert_eq!((counts.accepted, counts.out_of_order, counts.duplicate), (3, 1, 4));
        let found = buffer.at(at(10.15)).expect("known").pose;
        assert!((found.position_m[0] - 20.3).abs() < 1e-9);
        assert!((found.euler_rad()[0] - 1.015).abs() < 1e-9);
        assert!(PoseBuffer::default().at(at(0.0)).is_none());
    }

    #[test]
    fn a_wild_stamp_is_refused_and_a_clock_that_was_set_is_followed() {
        let mut buffer = filled(&[10.0, 10.1]);
        assert_eq!(buffer.insert(pose(500.0)), Outcome::Jumped);
        assert_eq!(buffer.insert(pose(10.2)), Outcome::Accepted);
        let outcomes: Vec<_> = (0..11).map(|k| buffer.insert(pose(2.0 + 0.1 * f64::from(k)))).collect();
        assert!(outcomes[..9].iter().all(|o| *o == Outcome::Jumped));
        assert_eq!(outcomes[9..], [Outcome::Restarted, Outcome::Accepted]);
        assert!((buffer.at(at(2.95)).expect("known").pose.position_m[0] - 5.9).abs() < 1e-9);
    }

    #[test]
    fn the_buffer_is_bounded() {
        let mut buffer = PoseBuffer::default();
        for k in 0..CAPACITY + 10 {
            buffer.insert(pose(k as f64 * 1e-4));
        }
        assert_eq!(buffer.poses.len(), CAPACITY);
        assert_eq!(buffer.insert(pose(0.0)), Outcome::TooOld);
    }

    #[test]
    fn beyond_the_last_pose_the_mean_stands_still_and_the_covariance_grows() {
        let buffer = filled(&[0.0, 0.1]);
        let tilt_std = |s: f64| buffer.at(at(s)).expect("known").pose.cov[(0, 0)].sqrt();
        let east = |s: f64| buffer.at(at(s)).expect("known").pose.position_m[0];
        assert!((east(0.15) - 0.3).abs() < 1e-9);
        assert!((east(0.2) - 0.4).abs() < 1e-9 && (east(5.0) - 0.4).abs() < 1e-9);
        assert!(tilt_std(0.1) < 1e-12);
        // Half of 3 rad/s² × (10 ms)², then 0.1 rad/s, then the most that a flying platform tilts.
        assert!((tilt_std(0.11) - 1.5e-4).abs() < 1e-9);
        assert!((tilt_std(1.1) - 0.1).abs() < 1e-9);
        assert!((tilt_std(60.0) - MAX_TILT_RAD).abs() < 1e-9);
        let found = buffer.at(at(60.0)).expect("known");
        assert!((found.age_s - 59.9).abs() < 1e-9);
        assert!((found.pose.cov[(3, 3)].sqrt() - 3.0 * 59.9).abs() < 1e-6);
    }

    #[test]
    fn mean_rates_use_what_poses_there_are() {
        let buffer = filled(&[0.0, 0.1, 0.2]);
        for s in [0.1, 0.15, 0.2] {
            let rates = buffer.mean_rates(at(s), 0.1).expect("poses on one side");
            assert!(
                (rates[0] - 0.1).abs() < 1e-9 && (rates[3] - 2.0).abs() < 1e-9,
                "{s}: {rates}"
            );
        }
        assert!(buffer.mean_rates(at(0.25), 0.1).is_none());
    }

    #[test]
    fn across_a_gap_the_covariance_is_largest_in_the_middle() {
        let buffer = filled(&[0.0, 0.1, 4.1, 4.2]);
        let std = |s: f64| buffer.at(at(s)).expect("known").pose.cov[(2, 2)].sqrt();
        assert!(std(0.05) < 0.004 && std(0.1) < 1e-12);
        assert!((std(2.1) - 0.2).abs() < 1e-9 && std(1.0) < std(2.1));
    }
}
