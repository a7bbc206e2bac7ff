//! A user's beam from frame to frame: which track it was, and since when it is missing.

use jiff::Timestamp;

use crate::time::seconds;

/// Time for which a beam must have been associated with a user's claims before the two are taken to belong together, s: longer than a
/// chance meeting of two who walk lasts. Longer keeps honest newcomers unknown during a flood of claims. Not measured.
pub const ESTABLISHED_S: f64 = 3.0;

/// Time over which absences are a habit, s. Longer doubts those of who was hidden once, shorter takes beams in bursts for ones that vanish.
const HABIT_S: f64 = 10.0;
/// Times the longest of them from which another is none of that habit.
const LONGER: f64 = 2.0;

#[derive(Clone, Copy, Debug, Default)]
pub struct UserTrack {
    /// The track that was associated last.
    pub track: Option<u64>,
    pub first_seen: Option<Timestamp>,
    pub last_seen: Option<Timestamp>,
    /// First frame since which no track is associated although one is expected.
    pub unseen_since: Option<Timestamp>,
    /// ln likelihood ratio of "absent" to "missed by chance".
    pub absence: f64,
    /// The track was found while no beam of theirs had to be in view, as it has not had to since.
    pub is_provisional: bool,
    /// The end of an absence, the longest of late.
    pub returned: Option<Return>,
}

/// The end of an absence.
#[derive(Clone, Copy, Debug)]
pub struct Return {
    time: Timestamp,
    away_s: f64,
}

impl UserTrack {
    /// The track, unless the user has been missing since.
    pub fn current(&self) -> Option<u64> {
        self.track.filter(|_| self.unseen_since.is_none())
    }

    pub fn was_seen(&self) -> bool {
        self.last_seen.is_some()
    }

    /// A beam has been associated with the claims for long enough that the two are taken to belong together.
    pub fn is_established(&self) -> bool {
        let seen = self.first_seen.zip(self.last_seen);
        seen.is_some_and(|(first, last)| seconds(first, last) >= ESTABLISHED_S)
    }

    /// Whether the beam is away for no longer than it has been of late, as one in bursts is: that it went tells nothing.
    pub fn is_often_away(&self, now: Timestamp) -> bool {
        let (Some(since), Some(last)) = (self.unseen_since, self.returned) else {
            return false;
        };
        seconds(last.time, since) < HABIT_S && seconds(since, now) < LONGER * last.away_s
    }

    /// The beam is `track` again, or still.
    pub fn seen(&mut self, track: u64, now: Timestamp) {
        if let Some(since) = self.unseen_since {
            let away_s = seconds(since, now);
            let is_latest = |last: &Return| seconds(last.time, now) >= HABIT_S || away_s >= last.away_s;
            if self.returned.as_ref().is_none_or(is_latest) {
                self.returned = Some(Return { time: now, away_s });
            }
        }
        self.found(track);
        self.first_seen.get_or_insert(now);
        self.last_seen = Some(now);
    }

    /// The beam is `track`.
    pub fn found(&mut self, track: u64) {
        self.track = Some(track);
        self.unseen_since = None;
        self.absence = 0.0;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn who_goes_and_comes_is_often_away_until_they_stay_away() {
        let at = |tenths: i64| Timestamp::from_millisecond(100 * tenths).unwrap();
        let mut user = UserTrack::default();
        user.seen(1, at(0));
        user.unseen_since = Some(at(10));
        assert!(!user.is_often_away(at(14)));
        user.seen(1, at(14));
        user.unseen_since = Some(at(20));
        // It has been away for 0.4 s.
        assert!(user.is_often_away(at(24)) && user.is_often_away(at(27)) && !user.is_often_away(at(28)));
        // That was long ago.
        user.unseen_since = Some(at(114));
        assert!(!user.is_often_away(at(118)));
    }

    #[test]
    fn three_seconds_establish_a_user() {
        let at = |s: i64| Timestamp::from_second(s).ok();
        let mut user = UserTrack {
            first_seen: at(10),
            last_seen: at(12),
            ..UserTrack::default()
        };
        assert!(user.was_seen() && !user.is_established());
        user.last_seen = at(13);
        assert!(user.is_established());
        user.found(7);
        assert_eq!(user.current(), Some(7));
        user.unseen_since = at(14);
        assert_eq!(user.current(), None);
    }
}
