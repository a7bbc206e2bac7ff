//! Who is known by their claims: users by name, and in the order in which they make way for others.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::sync::Arc;

use jiff::Timestamp;

use super::candidates::{Bearing, Index};
use super::history::{History, Standing};
use super::outcome::Outcome;
use super::{Claim, Roster};
use crate::time::seconds;

/// A name counts as known after this time and this many claims, seen or not: longer than a burst, shorter than an operator waits.
const KNOWN_AFTER_S: f64 = 30.0;
const KNOWN_CLAIMS: u32 = 8;
/// Share of the room, one in so many, that names known without ever having been seen leave to newcomers. A larger share lets fewer users be
/// known for long, a smaller one leaves newcomers less room during a flood. Not tuned.
const NEWCOMERS: usize = 10;
/// Users that have been answered and are handed to the monitor in every frame, wherever they are. The one seen longest ago makes way. More
/// cost every frame time, fewer forget users of a large network. Not tuned.
const MOST_ANSWERED: usize = 512;

/// When a user was last heard, the order of first hearing, and the slot.
type Key = (Timestamp, u64, u32);

/// Users in slots, whose numbers stay theirs until they are forgotten.
#[derive(Debug)]
pub(super) struct Registry {
    names: HashMap<Arc<str>, u32>,
    slots: Vec<Option<User>>,
    free: Vec<u32>,
    /// By when they were last heard: names not known yet, and those that are.
    newcomers: BTreeSet<Key>,
    known: BTreeSet<Key>,
    /// Users whom a beam has answered.
    answered: BTreeMap<Arc<str>, u32>,
    unanswered: Index,
    sequence: u64,
    pub max_users: usize,
    roster: Roster,
    changes: Vec<(Arc<str>, bool)>,
}

#[derive(Debug)]
pub(super) struct User {
    name: Arc<str>,
    pub history: History,
    /// Order of first hearing, and when.
    sequence: u64,
    pub first_came: Timestamp,
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
    /// Claimed for long, or answered by a beam.
    pub fn is_known(&self) -> bool {
        self.class != Class::New
    }

    fn key(&self, slot: u32) -> Key {
        (self.history.came, self.sequence, slot)
    }
}

impl Registry {
    pub fn new(max_users: usize) -> Self {
        Self {
            names: HashMap::new(),
            slots: Vec::new(),
            free: Vec::new(),
            newcomers: BTreeSet::new(),
            known: BTreeSet::new(),
            answered: BTreeMap::new(),
            unanswered: Index::default(),
            sequence: 0,
            max_users,
            roster: Roster::default(),
            changes: Vec::new(),
        }
    }

    /// Names that are protected, for other threads.
    pub fn roster(&self) -> Roster {
        self.roster.clone()
    }

    /// Tells the other threads which names are protected now.
    pub fn update_roster(&mut self) {
        self.roster.update(&mut self.changes);
    }

    pub fn len(&self) -> usize {
        self.names.len()
    }

    pub fn slot(&self, name: &str) -> Option<u32> {
        self.names.get(name).copied()
    }

    pub fn of(&self, slot: u32) -> Option<&User> {
        self.slots[slot as usize].as_ref()
    }

    pub fn get(&self, name: &str) -> Option<&User> {
        self.of(self.slot(name)?)
    }

    /// When the user who is silent for longest was heard, and the slot.
    pub fn silent_longest(&self) -> Option<(Timestamp, u32)> {
        let oldest = [self.newcomers.first(), self.known.first()].into_iter().flatten().min();
        oldest.map(|(came, _, slot)| (*came, *slot))
    }

    /// The same of those who are not known yet.
    pub fn newcomer_silent_longest(&self) -> Option<(Timestamp, u32)> {
        self.newcomers.first().map(|(came, _, slot)| (*came, *slot))
    }

    /// Whether the claim of a user who is not answered bears on the view, as far as it has been looked at.
    pub fn may_bear(&self, slot: u32) -> bool {
        self.unanswered.may_bear(slot)
    }

    /// Those to hold a frame against, by name: all that were ever answered, and of the others those that bear on the view (`bears`), the
    /// nearest to these places and those known longest where they are too many. And how many in view are left out.
    pub fn choose(
        &mut self,
        places: &[[f64; 2]],
        bears: impl Fn(&Standing<'_>) -> Option<Bearing>,
    ) -> (Vec<u32>, usize) {
        let slots = &self.slots;
        let place = |slot: u32| {
            let standing = slots[slot as usize].as_ref()?.history.standing();
            Some((bears(&standing)?, [standing.claim.x_m, standing.claim.y_m]))
        };
        self.unanswered.look(place);
        let (mut chosen, left_out) = self.unanswered.pick(places, place);
        chosen.extend(self.answered.values());
        chosen.sort_unstable_by_key(|slot| slots[*slot as usize].as_ref().map(|user| &user.name));
        (chosen, left_out)
    }

    /// A new user.
    pub fn add(&mut self, claim: Claim, now: Timestamp) {
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
    }

    /// Takes a claim of the user in this slot.
    pub fn place(&mut self, slot: u32, claim: Claim, now: Timestamp) -> Outcome {
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

    /// A beam answered the user at `now`. The one answered longest ago makes way where there are too many.
    pub fn answered(&mut self, name: &str, now: Timestamp) {
        let Some(slot) = self.slot(name) else { return };
        self.set_class(slot, Class::Answered(now));
        if self.answered.len() > MOST_ANSWERED {
            let seen = |slot: u32| match self.of(slot)?.class {
                Class::Answered(at) => Some(at),
                _ => None,
            };
            let longest_ago = self.answered.values().copied().min_by_key(|slot| seen(*slot));
            longest_ago
                .into_iter()
                .for_each(|slot| self.set_class(slot, Class::Known));
        }
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
    }

    fn order(&mut self, class: Class) -> &mut BTreeSet<Key> {
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

    pub fn forget(&mut self, slot: u32) {
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
