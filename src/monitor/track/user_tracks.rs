//! The beams of all users from frame to frame: who is seen, who is absent, and whose beam one that came as they went may be.

use jiff::Timestamp;

use super::association::Association;
use super::user_track::UserTrack;
use crate::monitor::by_user::ByUser;
use crate::monitor::input::claim_state::ActiveClaim;
use crate::time::seconds;

/// Probability that a beam in view is missed in a frame, at the worst. Assumed; the stories' beams are missed in 0.2 to 3 %.
const MISS_PROBABILITY: f64 = 0.1;
/// ln likelihood ratio from which a user counts as vanished: three frames in a row. More frames delay the answer, fewer take a
/// missed beam for one that vanished.
const VANISHED: f64 = 6.9;
/// A beam and an absence that began within this of each other have one cause, s. Longer takes a stranger for a user who happens to
/// go, shorter makes two alerts of one user who answers from elsewhere. Not measured.
pub const COINCIDENCE_S: f64 = 1.5;

/// The beam of every user with an active claim or an open alert.
pub type UserTracks = ByUser<UserTrack>;

impl UserTracks {
    /// The last track of every user.
    pub fn tracks(&self) -> impl Iterator<Item = u64> {
        self.values().filter_map(|u| u.track)
    }

    /// Takes a frame's association: who is seen, and who is absent although they are expected.
    pub fn update(&mut self, claims: &[ActiveClaim], association: &Association, now: Timestamp) {
        for (i, claim) in claims.iter().enumerate() {
            let user = self.entry(&claim.claim.user);
            if let Some(track) = association.track_id(i) {
                let is_new = user.track != Some(track);
                user.seen(track, now);
                user.is_provisional = !claim.expected && (is_new || user.is_provisional);
            } else if claim.is_unresolvable || !(claim.expected || claim.may_have_left) {
                user.unseen_since = None;
                user.absence = 0.0;
            } else if claim.expected {
                user.unseen_since.get_or_insert(now);
                user.absence += (1.0f64 / MISS_PROBABILITY).ln();
            }
        }
    }

    /// The claim of the user whom a beam that has had no claim since `since` may belong to: one who vanished as it appeared, or
    /// the only one who has not been seen yet. Where several have not been seen, which of them it is would be a guess, and the
    /// beam is nobody's. Users whose absence `is_alerted` are not looked for, nor those who are as often away.
    pub fn displaced(
        &self,
        [since, now]: [Timestamp; 2],
        claims: &[ActiveClaim],
        association: &Association,
        is_alerted: impl Fn(&str) -> bool,
    ) -> Option<usize> {
        let candidates = (0..claims.len())
            .filter(|&i| association.track_id(i).is_none() && claims[i].expected)
            .filter_map(|i| {
                let user = self.get(&claims[i].claim.user)?;
                let gap = seconds(user.unseen_since?, since).abs();
                let has_vanished = user.absence >= VANISHED && !user.is_often_away(now);
                (has_vanished && gap <= COINCIDENCE_S).then_some((i, gap))
            })
            .filter(|(i, _)| !is_alerted(&claims[*i].claim.user));
        let (known, new): (Vec<_>, Vec<_>) =
            candidates.partition(|(i, _)| self.get(&claims[*i].claim.user).is_some_and(UserTrack::was_seen));
        let candidates = if known.is_empty() && new.len() == 1 { new } else { known };
        let nearest = candidates.into_iter().min_by(|a, b| a.1.total_cmp(&b.1));
        nearest.map(|(i, _)| i)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::monitor::input::claim_state::fixture::active_claim;

    fn at(frame: i64) -> Timestamp {
        Timestamp::from_millisecond(100 * frame).unwrap()
    }

    #[test]
    fn absence_adds_up_while_a_beam_is_expected() {
        let mut users = UserTracks::default();
        let mut claims = [active_claim("a", 0.0, 0.0)];
        let none = Association::none(1);
        for k in 1..4 {
            users.update(&claims, &none, at(k));
        }
        let user = users.get("a").unwrap();
        assert_eq!(user.unseen_since, Some(at(1)));
        assert!((user.absence - 1000f64.ln()).abs() < 1e-9);
        (claims[0].expected, claims[0].may_have_left) = (false, true);
        users.update(&claims, &none, at(4));
        let user = users.get("a").unwrap();
        assert_eq!(user.unseen_since, Some(at(1)));
        assert!((user.absence - 1000f64.ln()).abs() < 1e-9);
        claims[0].is_unresolvable = true;
        users.update(&claims, &none, at(4));
        assert_eq!(users.get("a").unwrap().unseen_since, None);
        let mut seen = Association::none(1);
        seen.assign(0, 7);
        users.update(&claims, &seen, at(5));
        let user = users.get("a").unwrap();
        assert_eq!((user.track, user.last_seen, user.absence), (Some(7), Some(at(5)), 0.0));
        users.retain(|name| name != "a");
        assert!(users.get("a").is_none());
    }

    #[test]
    fn a_new_beam_is_that_of_the_user_who_vanished_as_it_came() {
        let claims = [active_claim("a", 0.0, 0.0), active_claim("b", 50.0, 0.0)];
        let mut users = UserTracks::default();
        let mut both = Association::none(2);
        both.assign(0, 1);
        both.assign(1, 2);
        users.update(&claims, &both, at(0));
        let mut one = Association::none(2);
        one.assign(0, 1);
        for k in 1..4 {
            assert_eq!(users.displaced([at(k); 2], &claims, &one, |_| false), None);
            users.update(&claims, &one, at(k));
        }
        assert_eq!(users.displaced([at(10); 2], &claims, &one, |_| false), Some(1));
        assert_eq!(users.displaced([at(10); 2], &claims, &one, |user| user == "b"), None);
        // It came two seconds after the user went.
        assert_eq!(users.displaced([at(21); 2], &claims, &one, |_| false), None);
    }

    #[test]
    fn of_several_who_were_never_seen_a_beam_is_nobodys() {
        let all = [active_claim("a", 0.0, 0.0), active_claim("b", 50.0, 0.0)];
        for (claims, displaced) in [(&all[..1], Some(0)), (&all[..], None)] {
            let mut users = UserTracks::default();
            let none = Association::none(claims.len());
            (0..3).for_each(|k| users.update(claims, &none, at(k)));
            assert_eq!(users.displaced([at(0); 2], claims, &none, |_| false), displaced);
        }
    }
}
