//! A user's beam from frame to frame: which track it was, and since when it is missing.

use jiff::Timestamp;

use crate::time::seconds;

/// Time for which a beam must have been associated with a user's claims before the two are taken to belong together, s: longer than a
/// chance meeting of two who walk lasts. Longer keeps honest newcomers unknown during a flood of claims. Not measured.
pub const ESTABLISHED_S: f64 = 3.0;

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
