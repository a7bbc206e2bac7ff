//! The network's claims: the newest of every user with a short history. Bounded in users, history and claims ahead of their
//! time. Time comes with each call; nothing here reads a clock.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::sync::Arc;

use jiff::Timestamp;
use serde::Serialize;

use super::ahead::{Ahead, MOST_IN_A_REPLAY, MOST_LIVE};
use super::candidates::{Bearing, Index};
use super::history::{History, Standing};
use super::outcome::Outcome;
use super::pressure::{Dropped, Pressure, Squeeze};
use super::{Claim, Config, Roster, seconds};

/// A user silent or ended for this long is forgotten first when room is needed, whoever they are.
const FORGET_AFTER_S: f64 = 600.0;
/// A name that is not known yet makes room for another one after this silence: ten claim periods at 1 Hz. A flood of names claimed once
/// makes way for itself, and a newcomer who goes on claiming stays.
const NEW_SILENT_S: f64 = 10.0;
/// A name counts as known after this time and this many claims, seen or not: longer than a burst, shorter than an operator waits.
const KNOWN_AFTER_S: f64 = 30.0;
const KNOWN_CLAIMS: u32 = 8;
/// Share of the room, one in so many, that names known without ever having been seen leave to newcomers.
const NEWCOMERS: usize = 10;
/// Users that have been answered and are handed to the monitor in every frame, wherever they are. The one seen longest ago makes way.
const MOST_ANSWERED: usize = 512;
/// Claims whose time has come that are placed in one frame.
const MOST_DUE: usize = 4096;
/// A newcomer claimed this near to a beam that answers nobody is let in before all other newcomers, m: what is tolerated by default, with the
/// errors of both.
const BESIDE_A_BEAM_M: f64 = 10.0;

/// The claims of all users.
#[derive(Debug)]
pub struct Store {
    names: HashMap<Arc<str>, u32>,
    slots: Vec<Option<User>>,
    free: Vec<u32>,
    /// By when they were last heard: names not known yet, and those that are.
    newcomers: BTreeSet<(Timestamp, u64, u32)>,
    known: BTreeSet<(Timestamp, u64, u32)>,
    /// Users whom a beam has answered.
    answered: BTreeMap<Arc<str>, u32>,
    unanswered: Index,
    chosen: Vec<u32>,
    left_out: usize,
    /// Beams that answered nobody when the claims were last asked for.
    lone_beams: Vec<[f64; 2]>,
    /// Claims ahead of their time: of names that are not known, and of those that are.
    ahead: [Ahead; 2],
    sequence: u64,
    max_users: usize,
    counts: Counts,
    pressure: Pressure,
    dropped: Dropped,
    newest: Option<Arrival>,
    roster: Roster,
    changes: Vec<(Arc<str>, bool)>,
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

#[derive(Debug)]
struct User {
    name: Arc<str>,
    history: History,
    /// Order of first hearing, and when.
    sequence: u64,
    first_came: Timestamp,
    heard: u32,
    class: Class,
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Class {
    New,
    /// Claimed for long.
    Known,
    /// A beam answered, last at this time.
    Answered(Timestamp),
}

impl User {
    fn key(&self, slot: u32) -> (Timestamp, u64, u32) {
        (self.history.came, self.sequence, slot)
    }
}

impl Store {
    pub fn new(config: &Config) -> Self {
        Self {
            names: HashMap::new(),
            slots: Vec::new(),
            free: Vec::new(),
            newcomers: BTreeSet::new(),
            known: BTreeSet::new(),
            answered: BTreeMap::new(),
            unanswered: Index::default(),
            chosen: Vec::new(),
            left_out: 0,
            lone_beams: Vec::new(),
            ahead: [Ahead::new(MOST_IN_A_REPLAY), Ahead::new(MOST_IN_A_REPLAY)],
            sequence: 0,
            max_users: config.max_users,
            counts: Counts::default(),
            pressure: Pressure::default(),
            dropped: Dropped::default(),
            newest: None,
            roster: Roster::default(),
            changes: Vec::new(),
        }
    }

    /// The log is not read ahead of its frames: few claims are made for later.
    pub fn expect_live_claims(&mut self) {
        self.ahead.iter_mut().for_each(|ahead| ahead.set_most(MOST_LIVE));
    }

    /// Names that are protected, for other threads.
    pub fn roster(&self) -> Roster {
        self.roster.clone()
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
        self.roster.update(&mut self.changes);
    }

    /// The clock was set back to `now`: what was claimed for later times no longer stands.
    pub fn set_back(&mut self, now: Timestamp) {
        let users: Vec<(u32, User)> = (0u32..)
            .zip(&mut self.slots)
            .filter_map(|(k, u)| Some((k, u.take()?)))
            .collect();
        self.newcomers.clear();
        self.known.clear();
        self.unanswered.clear();
        self.chosen.clear();
        for (slot, mut user) in users {
            let Some(history) = user.history.set_back(now) else {
                self.release(slot, &user.name, user.class);
                continue;
            };
            user.history = history;
            user.first_came = user.first_came.min(now);
            if let Class::Answered(at) = &mut user.class {
                *at = (*at).min(now);
            } else {
                self.unanswered.note(slot, user.sequence);
            }
            self.order(user.class).insert(user.key(slot));
            self.slots[slot as usize] = Some(user);
        }
        self.newest = None;
        self.pressure.forget();
        self.dropped.forget();
    }

    pub fn counts(&self) -> Counts {
        self.counts
    }

    pub fn len(&self) -> usize {
        self.names.len()
    }

    pub fn is_empty(&self) -> bool {
        self.names.is_empty()
    }

    pub fn max_users(&self) -> usize {
        self.max_users
    }

    pub fn user(&self, user: &str) -> Option<Standing<'_>> {
        self.known_as(user).map(|user| user.history.standing())
    }

    /// When the user was heard for the first time.
    pub fn first_heard(&self, user: &str) -> Option<Timestamp> {
        self.known_as(user).map(|user| user.first_came)
    }

    /// Where `user`'s claims put them at `time`: on the line between the two claims around it, else the nearest one.
    pub fn position_at(&self, user: &str, time: Timestamp) -> Option<[f64; 2]> {
        self.known_as(user).map(|user| user.history.position_at(time))
    }

    fn known_as(&self, user: &str) -> Option<&User> {
        self.slots[*self.names.get(user)? as usize].as_ref()
    }

    /// A beam answered the user at `now`: floods do not displace them from now on.
    pub fn answered(&mut self, user: &str, now: Timestamp) {
        let Some(&slot) = self.names.get(user) else { return };
        self.set_class(slot, Class::Answered(now));
        if self.answered.len() > MOST_ANSWERED {
            let seen = |slot: u32| match self.slots[slot as usize].as_ref()?.class {
                Class::Answered(at) => Some(at),
                _ => None,
            };
            let longest_ago = self.answered.values().copied().min_by_key(|slot| seen(*slot));
            longest_ago
                .into_iter()
                .for_each(|slot| self.set_class(slot, Class::Known));
        }
    }

    /// Chooses the claims that the coming frame is held against: of users that were ever answered, and of the others those that bear on the view
    /// (`bears`), the nearest to `beams` and those known longest where they are too many.
    pub fn choose(&mut self, beams: &[Beam], bears: impl Fn(&Standing<'_>) -> Option<Bearing>) {
        let slots = &self.slots;
        let place = |slot: u32| {
            let standing = slots[slot as usize].as_ref()?.history.standing();
            Some((bears(&standing)?, [standing.claim.x_m, standing.claim.y_m]))
        };
        self.unanswered.look(place);
        // Those of beams without a user come first: the claims beside them decide most.
        let of = |is_answered: bool| beams.iter().filter(move |b| b.is_answered == is_answered);
        let places: Vec<_> = of(false).chain(of(true)).map(|b| b.position).collect();
        let (mut chosen, left_out) = self.unanswered.pick(&places, place);
        self.left_out = left_out;
        self.lone_beams = of(false).map(|b| b.position).collect();
        chosen.extend(self.answered.values());
        chosen.sort_unstable_by_key(|slot| slots[*slot as usize].as_ref().map(|user| &user.name));
        self.chosen = chosen;
    }

    /// The claims that were chosen, by name; to be asked before other claims are taken.
    pub fn chosen(&self) -> impl Iterator<Item = Standing<'_>> {
        let users = self
            .chosen
            .iter()
            .filter_map(|slot| self.slots[*slot as usize].as_ref());
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
        let is_known = self.known_as(&claim.user).is_some_and(|user| user.class != Class::New);
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
        let outcome = match self.names.get(claim.user.as_str()) {
            Some(&slot) => self.place_of(slot, claim, now),
            None => self.admit(claim, now),
        };
        if outcome == Outcome::Accepted && self.newest.is_none_or(|n| made > n.made) {
            self.newest = Some(Arrival { made, came: now });
        }
        outcome
    }

    fn place_of(&mut self, slot: u32, claim: Claim, now: Timestamp) -> Outcome {
        let Some(user) = self.slots[slot as usize].as_mut() else {
            return Outcome::Full;
        };
        let before = user.key(slot);
        let outcome = user.history.place(claim, now);
        if outcome != Outcome::Accepted {
            return outcome;
        }
        user.heard = user.heard.saturating_add(1);
        let (class, after, sequence) = (user.class, user.key(slot), user.sequence);
        let is_known = seconds(user.first_came, now) >= KNOWN_AFTER_S && user.heard >= KNOWN_CLAIMS;
        let order = self.order(class);
        order.remove(&before);
        order.insert(after);
        if !matches!(class, Class::Answered(_)) {
            self.unanswered.note(slot, sequence);
        }
        if class == Class::New && is_known && self.known.len() < self.max_users - self.max_users / NEWCOMERS {
            self.set_class(slot, Class::Known);
        }
        outcome
    }

    fn admit(&mut self, claim: Claim, now: Timestamp) -> Outcome {
        if self.names.len() >= self.max_users && !self.make_room(&claim, now) {
            self.squeeze(|s| s.refused += 1, now);
            self.dropped.note(1, now);
            return Outcome::Full;
        }
        self.sequence += 1;
        let name: Arc<str> = claim.user.as_str().into();
        let user = User {
            name: name.clone(),
            history: History::new(claim, now),
            sequence: self.sequence,
            first_came: now,
            heard: 1,
            class: Class::New,
        };
        let slot = self.free.pop().unwrap_or_else(|| {
            self.slots.push(None);
            (self.slots.len() - 1) as u32
        });
        self.newcomers.insert(user.key(slot));
        self.unanswered.note(slot, user.sequence);
        self.slots[slot as usize] = Some(user);
        self.names.insert(name, slot);
        Outcome::Accepted
    }

    /// Forgets whoever is long silent, else the newcomer silent for longest, so that a flood of invented names displaces nobody but its own kind.
    fn make_room(&mut self, claim: &Claim, now: Timestamp) -> bool {
        let oldest_new = self.newcomers.first().copied();
        let oldest = [oldest_new, self.known.first().copied()].into_iter().flatten().min();
        if let Some((came, _, slot)) = oldest
            && seconds(came, now) > FORGET_AFTER_S
        {
            self.forget(slot);
            return true;
        }
        let is_beside_a_beam = self
            .lone_beams
            .iter()
            .any(|[x, y]| (x - claim.x_m).hypot(y - claim.y_m) <= BESIDE_A_BEAM_M);
        let Some((_, _, slot)) = oldest_new.filter(|(came, ..)| seconds(*came, now) > NEW_SILENT_S || is_beside_a_beam)
        else {
            return false;
        };
        if self.unanswered.may_bear(slot) {
            self.dropped.note(1, now);
        }
        self.squeeze(|s| s.forgotten_early += 1, now);
        self.forget(slot);
        true
    }

    fn squeeze(&mut self, by: impl FnOnce(&mut Squeeze), now: Timestamp) {
        let mut squeeze = Squeeze::default();
        by(&mut squeeze);
        self.pressure.note(squeeze, now);
    }

    fn order(&mut self, class: Class) -> &mut BTreeSet<(Timestamp, u64, u32)> {
        match class {
            Class::New => &mut self.newcomers,
            Class::Known | Class::Answered(_) => &mut self.known,
        }
    }

    fn set_class(&mut self, slot: u32, class: Class) {
        let Some(user) = self.slots[slot as usize].as_mut() else {
            return;
        };
        let before = std::mem::replace(&mut user.class, class);
        let (key, sequence, name) = (user.key(slot), user.sequence, user.name.clone());
        let was_answered = matches!(before, Class::Answered(_));
        let is_answered = matches!(class, Class::Answered(_));
        if before == Class::New && class != Class::New {
            self.newcomers.remove(&key);
            self.known.insert(key);
            self.changes.push((name.clone(), true));
        }
        if is_answered && !was_answered {
            self.unanswered.remove(slot);
            self.answered.insert(name, slot);
        } else if was_answered && !is_answered {
            self.answered.remove(&name);
            self.unanswered.note(slot, sequence);
        }
    }

    fn forget(&mut self, slot: u32) {
        if let Some(user) = self.slots[slot as usize].take() {
            self.order(user.class).remove(&user.key(slot));
            self.unanswered.remove(slot);
            self.release(slot, &user.name, user.class);
        }
    }

    /// Lets go of a user's name and slot.
    fn release(&mut self, slot: u32, name: &Arc<str>, class: Class) {
        self.names.remove(name);
        self.answered.remove(name);
        self.free.push(slot);
        if class != Class::New {
            self.changes.push((name.clone(), false));
        }
    }
}
