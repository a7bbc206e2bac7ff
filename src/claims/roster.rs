//! Which names the store protects, for the threads that read claims: under a flood they keep these and shed the others.

use std::collections::HashSet;
use std::sync::{Arc, PoisonError, RwLock};

/// Names that a beam has answered to, or that have long been claimed. The store writes it, readers of claims ask it.
#[derive(Clone, Debug, Default)]
pub struct Roster(Arc<RwLock<HashSet<Arc<str>>>>);

impl Roster {
    /// For each name whether it is protected.
    pub fn knows<'a>(&self, names: impl Iterator<Item = &'a str>) -> Vec<bool> {
        let known = self.0.read().unwrap_or_else(PoisonError::into_inner);
        names.map(|name| known.contains(name)).collect()
    }

    /// Adds (`true`) and removes names, unless a reader holds the roster right now: the store never waits and comes back with them.
    pub(super) fn update(&self, changes: &mut Vec<(Arc<str>, bool)>) {
        let mut known = match self.0.try_write() {
            Ok(known) => known,
            Err(std::sync::TryLockError::Poisoned(poisoned)) => poisoned.into_inner(),
            Err(std::sync::TryLockError::WouldBlock) => return,
        };
        for (name, is_known) in changes.drain(..) {
            match is_known {
                true => known.insert(name),
                false => known.remove(&name),
            };
        }
    }
}
