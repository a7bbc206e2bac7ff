//! Which unanswered claims a frame is held against: all of them while they are few; under a flood those nearest to a beam and those known longest,
//! so that a frame costs the same however many are claimed.

use std::collections::{BTreeMap, HashMap};

/// Unanswered users handed to the monitor at most. At 8 µs each (`siege_a_carpet_of_claims`) they add two thirds to a frame's median time; with half
/// as many, 20,000 names in view delay an eavesdropper's alert from 0.65 to 1.3 s. No honest scene has as many users that were never seen.
pub const MOST_UNANSWERED: usize = 128;
/// Users looked at again in each frame, because a claim's reach grows with its age: 20,000 take 80 frames, and as many as these none. More
/// find a user who comes into reach sooner, fewer cost a frame less. Not tuned.
const SWEEP: usize = 256;
/// Edge of a cell of the grid, m, and how many cells around a beam's are searched: 20,000 claims in view are five a cell, and a claim answers a
/// beam within 13.5 m (5 σ at 5 m tolerated, σ 1 m).
const CELL_M: f64 = 4.0;
const RINGS: i32 = 4;
/// Claims of a cell that are compared, newest users first, and claims kept for each beam. More find the nearest of a denser carpet, fewer
/// bound what an attacker can make a frame cost. Not tuned.
const MOST_IN_A_CELL: usize = 32;
const MOST_FOR_A_BEAM: usize = 4;
/// Beams that are served: as many spots as an estimator finds.
const MOST_BEAMS: usize = 32;

type Cell = (i32, i32);

/// How a claim bears on the view.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Bearing {
    /// As it stands: it is claimed in the view, or as near to it as a user may honestly be off.
    InView,
    /// Its user may have come into the view since.
    Beyond,
}

/// Order in which users are held against a frame: those in view first, and of these those known longest.
type Rank = (Bearing, u64);

/// Users that no beam answers, by slot of the store; those whose claim bears on the view also by place and by how long they are known.
#[derive(Debug, Default)]
pub(super) struct Index {
    entries: Vec<Entry>,
    all: Vec<u32>,
    cursor: usize,
    unlooked: Vec<u32>,
    near: BTreeMap<Rank, Near>,
    /// How many of them are in view.
    in_view: usize,
    /// The same by place, and of each cell by the order in which users were first heard.
    grid: HashMap<Cell, BTreeMap<u64, (Bearing, [f64; 2])>>,
}

#[derive(Clone, Debug, Default)]
struct Entry {
    /// Place in `all`.
    at: Option<usize>,
    /// Order in which the user was first heard.
    sequence: u64,
    near: Option<Bearing>,
    is_unlooked: bool,
}

#[derive(Clone, Copy, Debug)]
struct Near {
    slot: u32,
    position: [f64; 2],
}

fn cell([x, y]: [f64; 2]) -> Cell {
    ((x / CELL_M).floor() as i32, (y / CELL_M).floor() as i32)
}

/// The cells at that distance, in cells.
fn around(ring: i32) -> impl Iterator<Item = Cell> {
    let all = (-ring..=ring).flat_map(move |i| (-ring..=ring).map(move |j| (i, j)));
    all.filter(move |(i, j)| i.abs().max(j.abs()) == ring)
}

impl Index {
    /// Whether the user's claim bears on the view, or may: it has not been looked at yet.
    pub fn may_bear(&self, slot: u32) -> bool {
        let entry = self.entries.get(slot as usize);
        entry.is_some_and(|e| e.near.is_some() || e.is_unlooked)
    }

    /// Adds a user, or notes that they have a new claim.
    pub fn note(&mut self, slot: u32, sequence: u64) {
        let i = slot as usize;
        if self.entries.len() <= i {
            self.entries.resize(i + 1, Entry::default());
        }
        let entry = &mut self.entries[i];
        entry.sequence = sequence;
        if entry.at.is_none() {
            entry.at = Some(self.all.len());
            self.all.push(slot);
        }
        if !entry.is_unlooked {
            entry.is_unlooked = true;
            self.unlooked.push(slot);
        }
    }

    /// The user is answered, or forgotten.
    pub fn remove(&mut self, slot: u32) {
        self.set(slot, None);
        let Some(entry) = self.entries.get_mut(slot as usize) else {
            return;
        };
        entry.is_unlooked = false;
        if let Some(at) = entry.at.take() {
            self.all.swap_remove(at);
            if let Some(moved) = self.all.get(at) {
                self.entries[*moved as usize].at = Some(at);
            }
        }
    }

    pub fn clear(&mut self) {
        *self = Self::default();
    }

    /// Looks at every user with a new claim, and at some of the others in turn. `place` gives where a claim stands that bears on the view,
    /// and how.
    pub fn look(&mut self, place: impl Fn(u32) -> Option<(Bearing, [f64; 2])>) {
        for slot in std::mem::take(&mut self.unlooked) {
            // A slot may have been given to another user since, or to nobody.
            if std::mem::take(&mut self.entries[slot as usize].is_unlooked) {
                self.set(slot, place(slot));
            }
        }
        for _ in 0..SWEEP.min(self.all.len()) {
            self.cursor = (self.cursor + 1) % self.all.len();
            let slot = self.all[self.cursor];
            self.set(slot, place(slot));
        }
    }

    fn set(&mut self, slot: u32, place: Option<(Bearing, [f64; 2])>) {
        let Some(entry) = self.entries.get_mut(slot as usize) else {
            return;
        };
        let sequence = entry.sequence;
        let before = std::mem::replace(&mut entry.near, place.map(|(bearing, _)| bearing));
        if let Some(bearing) = before
            && let Some(near) = self.near.get(&(bearing, sequence))
        {
            if place == Some((bearing, near.position)) {
                return;
            }
            let old = cell(near.position);
            if let Some(there) = self.grid.get_mut(&old) {
                there.remove(&sequence);
                if there.is_empty() {
                    self.grid.remove(&old);
                }
            }
            self.near.remove(&(bearing, sequence));
            self.in_view -= usize::from(bearing == Bearing::InView);
        }
        if let Some((bearing, position)) = place {
            self.near.insert((bearing, sequence), Near { slot, position });
            self.in_view += usize::from(bearing == Bearing::InView);
            let there = self.grid.entry(cell(position)).or_default();
            there.insert(sequence, (bearing, position));
        }
    }

    /// Users to hold the frame against, and how many in view are left out.
    pub fn pick(
        &mut self,
        beams: &[[f64; 2]],
        place: impl Fn(u32) -> Option<(Bearing, [f64; 2])>,
    ) -> (Vec<u32>, usize) {
        if self.near.len() <= MOST_UNANSWERED {
            return (self.near.values().map(|near| near.slot).collect(), 0);
        }
        let mut chosen: Vec<Rank> = Vec::with_capacity(MOST_UNANSWERED + MOST_FOR_A_BEAM);
        for beam in beams.iter().take(MOST_BEAMS) {
            chosen.extend(self.nearest(*beam));
        }
        chosen.sort_unstable();
        chosen.dedup();
        chosen.truncate(MOST_UNANSWERED);
        let mut over = Vec::new();
        let mut first = Vec::new();
        for (rank, near) in self.near.iter().take(2 * MOST_UNANSWERED) {
            if chosen.len() + first.len() == MOST_UNANSWERED {
                break;
            }
            if chosen.binary_search(rank).is_ok() {
                continue;
            }
            match place(near.slot) {
                Some(_) => first.push(*rank),
                None => over.push(near.slot),
            }
        }
        chosen.extend(first);
        for slot in over {
            self.set(slot, None);
        }
        let slots = chosen
            .iter()
            .filter_map(|rank| self.near.get(rank))
            .map(|near| near.slot);
        let in_view = chosen.iter().filter(|(bearing, _)| *bearing == Bearing::InView).count();
        (slots.collect(), self.in_view - in_view)
    }

    /// The users claimed nearest to a beam.
    fn nearest(&self, beam: [f64; 2]) -> Vec<Rank> {
        let (column, row) = cell(beam);
        let mut found: Vec<(f64, Rank)> = Vec::new();
        for ring in 0..=RINGS {
            // What the ring before has found may be farther off than what this one finds.
            let is_enough = found.len() >= MOST_FOR_A_BEAM;
            for (i, j) in around(ring) {
                let Some(there) = self.grid.get(&(column.saturating_add(i), row.saturating_add(j))) else {
                    continue;
                };
                let newest = there.iter().rev().take(MOST_IN_A_CELL);
                found.extend(newest.map(|(sequence, (bearing, [x, y]))| {
                    let away = (x - beam[0]).hypot(y - beam[1]);
                    (away, (*bearing, *sequence))
                }));
            }
            if is_enough {
                break;
            }
        }
        found.sort_by(|a, b| a.0.total_cmp(&b.0).then(b.1.1.cmp(&a.1.1)));
        found.truncate(MOST_FOR_A_BEAM);
        found.into_iter().map(|(_, rank)| rank).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::Bearing::{Beyond, InView};
    use super::*;

    /// Users on a grid 1 m apart, all in view.
    fn index(users: u32) -> (Index, impl Fn(u32) -> Option<(Bearing, [f64; 2])> + Copy) {
        let place = |slot: u32| Some((InView, [f64::from(slot % 100), f64::from(slot / 100)]));
        let mut index = Index::default();
        for slot in 0..users {
            index.note(slot, u64::from(slot));
        }
        index.look(place);
        (index, place)
    }

    #[test]
    fn a_few_are_all_picked_and_of_many_the_nearest_and_the_first() {
        let (mut few, place) = index(MOST_UNANSWERED as u32);
        assert_eq!(few.pick(&[], place).0.len(), MOST_UNANSWERED);
        let (mut many, place) = index(10_000);
        let (picked, left_out) = many.pick(&[[50.2, 70.1]], place);
        assert_eq!((picked.len(), left_out), (MOST_UNANSWERED, 10_000 - MOST_UNANSWERED));
        assert!(picked.contains(&7050), "the nearest");
        assert!((0..120).all(|slot| picked.contains(&slot)), "those known longest");
    }

    #[test]
    fn who_leaves_is_picked_no_more() {
        let (mut index, place) = index(10);
        index.remove(3);
        index.look(|slot| place(slot).filter(|_| slot != 5));
        let picked = index.pick(&[], place).0;
        assert_eq!(picked, [0, 1, 2, 4, 6, 7, 8, 9]);
        index.note(3, 10);
        index.look(place);
        assert_eq!(index.pick(&[], place).0.len(), 10);
        assert!((0..10).all(|slot| index.may_bear(slot)));
    }

    #[test]
    fn a_claim_that_moves_is_found_where_it_is() {
        let (mut index, place) = index(5000);
        index.note(17, 17);
        index.look(|slot| {
            if slot == 17 {
                Some((InView, [500.0, 500.0]))
            } else {
                place(slot)
            }
        });
        assert_eq!(index.nearest([500.0, 501.0]), [(InView, 17)]);
        assert_eq!(index.nearest([510.0, 510.0]), [(InView, 17)], "a ring or two away");
        assert!(!index.nearest([17.0, 0.0]).contains(&(InView, 17)));
    }

    #[test]
    fn users_beyond_the_view_are_picked_last_and_never_left_out() {
        let mut index = Index::default();
        let place = |slot: u32| Some((if slot < 1000 { Beyond } else { InView }, [f64::from(slot), 0.0]));
        (0..1100).for_each(|slot| index.note(slot, u64::from(slot)));
        index.look(place);
        // Nobody in view is left out by a thousand beyond it who were heard before.
        let (picked, left_out) = index.pick(&[[20.0, 0.0]], place);
        assert_eq!((picked.len(), left_out), (MOST_UNANSWERED, 0));
        assert!((1000..1100).all(|slot| picked.contains(&slot)) && picked.contains(&20));
        // They come into the view.
        let place = |slot: u32| Some((InView, [f64::from(slot), 0.0]));
        (0..1100).for_each(|slot| index.note(slot, u64::from(slot)));
        index.look(place);
        assert_eq!(index.pick(&[], place).1, 1100 - MOST_UNANSWERED);
    }
}
