//! The network's claims: the newest of every user with a short history. Bounded in users, history and claims ahead of their
//! time. Time comes with each call; nothing here reads a clock.

use jiff::Timestamp;
use serde::Serialize;

use super::ahead::{Ahead, MOST_IN_A_REPLAY, MOST_LIVE};
use super::candidates::Bearing;
use super::history::Standing;
use super::outcome::Outcome;
use super::pressure::{Dropped, Pressure, Squeeze};
use super::registry::{Registry, User};
use super::{Claim, Config, Roster};
use crate::time::seconds;

/// A user silent or ended for this long is forgotten first when room is needed, whoever they are. Longer keeps names that a flood left
/// behind, shorter forgets an honest user in a pause. Not tuned.
const FORGET_AFTER_S: f64 = 600.0;
/// A name that is not known yet makes room for another one after this silence: ten claim periods at 1 Hz. A flood of names claimed once
/// makes way for itself, and a newcomer who goes on claiming stays.
const NEW_SILENT_S: f64 = 10.0;
/// Claims whose time has come that are placed in one frame. More may hold up a frame, fewer put off claims of a log that is ahead of its
/// time. Not tuned.
const MOST_DUE: usize = 4096;
/// A newcomer claimed this near to a beam that answers nobody is let in before all other newcomers, m: what is tolerated by default, with the
/// errors of both.
const BESIDE_A_BEAM_M: f64 = 10.0;

/// The claims of all users.
#[derive(Debug)]
pub struct Store {
    users: Registry,
    chosen: Vec<u32>,
    left_out: usize,
    /// Beams that answered nobody when the claims were last asked for.
    lone_beams: Vec<[f64; 2]>,
    /// Claims ahead of their time: of names that are not known, and of those that are.
    ahead: [Ahead; 2],
    counts: Counts,
    pressure: Pressure,
    dropped: Dropped,
    newest: Option<Arrival>,
}

/// How many claims had each outcome.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Counts {
    pub accepted: u64,
    pub ahead: u64,
    pub late: u64,
    pub too_late: u64,
    pub duplicate: u64,
    pub conflicting: u64,
    pub full: u64,
}

/// A beam, as far as claims need to know.
#[derive(Clone, Copy, Debug)]
pub struct Beam {
    pub position: [f64; 2],
    /// It answers somebody's claim.
    pub is_answered: bool,
}

/// When the newest accepted claim of all was made and when it came.
#[derive(Clone, Copy, Debug)]
struct Arrival {
    made: Timestamp,
    came: Timestamp,
}

impl Store {
    pub fn new(config: &Config) -> Self {
        Self {
            users: Registry::new(config.max_users),
            chosen: Vec::new(),
            left_out: 0,
            lone_beams: Vec::new(),
            ahead: [Ahead::new(MOST_IN_A_REPLAY), Ahead::new(MOST_IN_A_REPLAY)],
            counts: Counts::default(),
            pressure: Pressure::default(),
            dropped: Dropped::default(),
            newest: None,
        }
    }

    /// Goes on with other settings; what is known stays.
    pub fn reconfigure(&mut self, config: &Config) {
        self.users.max_users = config.max_users;
    }

    /// The log is not read ahead of its frames: few claims are made for later.
    pub fn expect_live_claims(&mut self) {
        self.ahead.iter_mut().for_each(|ahead| ahead.set_most(MOST_LIVE));
    }

    /// Names that are protected, for other threads.
    pub fn roster(&self) -> Roster {
        self.users.roster()
    }

    /// Takes a claim that came in at `now` (the frames' clock). One made for a later time waits for [`Store::advance`].
    pub fn insert(&mut self, claim: Claim, now: Timestamp) -> Outcome {
        let outcome = if claim.time > now {
            self.hold_back(claim, now)
        } else {
            self.place(claim, now)
        };
        self.count(outcome);
        outcome
    }

    /// Lets every claim whose time has come by `now` stand, some thousands at a time.
    pub fn advance(&mut self, now: Timestamp) {
        for _ in 0..MOST_DUE {
            let due = |ahead: &Ahead| ahead.next_due().filter(|(time, _)| *time <= now);
            let [new, known] = [0, 1].map(|k| due(&self.ahead[k]));
            let first = match (new, known) {
                (None, None) => break,
                (Some(_), None) => 0,
                (None, Some(_)) => 1,
                (Some(a), Some(b)) => usize::from(b < a),
            };
            if let Some(claim) = self.ahead[first].pop() {
                let outcome = self.place(claim, now);
                self.count(outcome);
            }
        }
        self.users.update_roster();
    }

    /// The clock was set back to `now`: what was claimed for later times no longer stands.
    pub fn set_back(&mut self, now: Timestamp) {
        self.users.set_back(now);
        self.chosen.clear();
        self.newest = None;
        self.pressure.forget();
        self.dropped.forget();
    }

    pub fn counts(&self) -> Counts {
        self.counts
    }

    pub fn len(&self) -> usize {
        self.users.len()
    }

    pub fn is_empty(&self) -> bool {
        self.users.len() == 0
    }

    pub fn max_users(&self) -> usize {
        self.users.max_users
    }

    pub fn user(&self, user: &str) -> Option<Standing<'_>> {
        self.users.get(user).map(|user| user.history.standing())
    }

    /// When the user was heard for the first time.
    pub fn first_heard(&self, user: &str) -> Option<Timestamp> {
        self.users.get(user).map(|user| user.first_came)
    }

    /// Where `user`'s claims put them at `time`: on the line between the two claims around it, else the nearest one.
    pub fn position_at(&self, user: &str, time: Timestamp) -> Option<[f64; 2]> {
        self.users.get(user).map(|user| user.history.position_at(time))
    }

    /// A beam answered the user at `now`: floods do not displace them from now on.
    pub fn answered(&mut self, user: &str, now: Timestamp) {
        self.users.answered(user, now);
    }

    /// Chooses the claims that the coming frame is held against: of users that were ever answered, and of the others those that bear on the view
    /// (`bears`), the nearest to `beams` and those known longest where they are too many.
    pub fn choose(&mut self, beams: &[Beam], bears: impl Fn(&Standing<'_>) -> Option<Bearing>) {
        // Those of beams without a user come first: the claims beside them decide most.
        let of = |is_answered: bool| beams.iter().filter(move |b| b.is_answered == is_answered);
        let places: Vec<_> = of(false).chain(of(true)).map(|b| b.position).collect();
        (self.chosen, self.left_out) = self.users.choose(&places, bears);
        self.lone_beams = of(false).map(|b| b.position).collect();
    }

    /// The claims that were chosen, by name; to be asked before other claims are taken.
    pub fn chosen(&self) -> impl Iterator<Item = Standing<'_>> {
        let users = self.chosen.iter().filter_map(|slot| self.users.of(*slot));
        users.map(|user| user.history.standing())
    }

    /// Names that were claimed and not kept, in as long as a claim may answer for a beam that was not its user's before.
    pub fn dropped_lately(&self, now: Timestamp) -> u64 {
        self.dropped.lately(now)
    }

    /// Claims in view that were not among those chosen.
    pub fn left_out(&self) -> usize {
        self.left_out
    }

    /// What found no room in the last seconds.
    pub fn squeezed(&self, now: Timestamp) -> Squeeze {
        self.pressure.lately(now)
    }

    /// Claims that were shed before they came here.
    pub fn note_shed(&mut self, shed: Squeeze, now: Timestamp) {
        self.pressure.note(shed, now);
        if shed.shed_new > 0 {
            self.dropped.note(shed.shed_new, now);
        }
    }

    /// Time since the newest claim came and since it was made, in this order, s; `None` before the first.
    pub fn quiet_s(&self, now: Timestamp) -> Option<(f64, f64)> {
        self.newest.map(|n| (seconds(n.came, now), seconds(n.made, now)))
    }

    /// The time that the newest claim of all was made for.
    pub fn newest(&self) -> Option<Timestamp> {
        self.newest.map(|n| n.made)
    }

    fn count(&mut self, outcome: Outcome) {
        let c = &mut self.counts;
        *match outcome {
            Outcome::Accepted => &mut c.accepted,
            Outcome::Ahead => &mut c.ahead,
            Outcome::Late => &mut c.late,
            Outcome::TooLate => &mut c.too_late,
            Outcome::Duplicate => &mut c.duplicate,
            Outcome::Conflicting => &mut c.conflicting,
            Outcome::Full => &mut c.full,
        } += 1;
    }

    fn hold_back(&mut self, claim: Claim, now: Timestamp) -> Outcome {
        let is_known = self.users.get(&claim.user).is_some_and(User::is_known);
        let time = claim.time;
        match self.ahead[usize::from(is_known)].keep(claim) {
            Some(gone) if gone.time == time => {
                self.squeeze(|s| s.refused += 1, now);
                Outcome::Full
            }
            Some(_) => {
                self.squeeze(|s| s.refused += 1, now);
                Outcome::Ahead
            }
            None => Outcome::Ahead,
        }
    }

    fn place(&mut self, claim: Claim, now: Timestamp) -> Outcome {
        let made = claim.time;
        let outcome = match self.users.slot(&claim.user) {
            Some(slot) => self.users.place(slot, claim, now),
            None => self.admit(claim, now),
        };
        if outcome == Outcome::Accepted && self.newest.is_none_or(|n| made > n.made) {
            self.newest = Some(Arrival { made, came: now });
        }
        outcome
    }

    fn admit(&mut self, claim: Claim, now: Timestamp) -> Outcome {
        if self.users.len() >= self.users.max_users && !self.make_room(&claim, now) {
            self.squeeze(|s| s.refused += 1, now);
            self.dropped.note(1, now);
            return Outcome::Full;
        }
        self.users.add(claim, now);
        Outcome::Accepted
    }

    /// Forgets whoever is long silent, else the newcomer silent for longest, so that a flood of invented names displaces nobody but its own kind.
    fn make_room(&mut self, claim: &Claim, now: Timestamp) -> bool {
        if let Some((came, slot)) = self.users.silent_longest()
            && seconds(came, now) > FORGET_AFTER_S
        {
            self.users.forget(slot);
            return true;
        }
        let is_beside_a_beam = self
            .lone_beams
            .iter()
            .any(|[x, y]| (x - claim.x_m).hypot(y - claim.y_m) <= BESIDE_A_BEAM_M);
        let newcomer = self.users.newcomer_silent_longest();
        let Some((_, slot)) = newcomer.filter(|(came, _)| seconds(*came, now) > NEW_SILENT_S || is_beside_a_beam)
        else {
            return false;
        };
        if self.users.may_bear(slot) {
            self.dropped.note(1, now);
        }
        self.squeeze(|s| s.forgotten_early += 1, now);
        self.users.forget(slot);
        true
    }

    fn squeeze(&mut self, by: impl FnOnce(&mut Squeeze), now: Timestamp) {
        let mut squeeze = Squeeze::default();
        by(&mut squeeze);
        self.pressure.note(squeeze, now);
    }
}
