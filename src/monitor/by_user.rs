//! A map by user name.

use std::collections::BTreeMap;

/// What is remembered of each user, by name.
#[derive(Debug)]
pub(super) struct ByUser<T>(BTreeMap<String, T>);

impl<T> Default for ByUser<T> {
    fn default() -> Self {
        Self(BTreeMap::new())
    }
}

impl<T: Default> ByUser<T> {
    pub fn get(&self, user: &str) -> Option<&T> {
        self.0.get(user)
    }

    pub fn get_mut(&mut self, user: &str) -> Option<&mut T> {
        self.0.get_mut(user)
    }

    /// The entry of `user`, new if there was none.
    pub fn entry(&mut self, user: &str) -> &mut T {
        // A name is copied only for a new user, not in every frame.
        if !self.0.contains_key(user) {
            self.0.insert(user.to_owned(), T::default());
        }
        self.0.get_mut(user).expect("inserted if it was absent")
    }

    pub fn values(&self) -> impl Iterator<Item = &T> {
        self.0.values()
    }

    pub fn iter_mut(&mut self) -> impl Iterator<Item = (&str, &mut T)> {
        self.0.iter_mut().map(|(user, entry)| (user.as_str(), entry))
    }

    pub fn retain(&mut self, is_kept: impl Fn(&str) -> bool) {
        self.0.retain(|user, _| is_kept(user));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_new_user_starts_from_nothing_and_who_is_not_kept_is_forgotten() {
        let mut counts = ByUser::<u32>::default();
        *counts.entry("a") += 1;
        *counts.entry("a") += 1;
        *counts.entry("b") += 1;
        assert_eq!((counts.get("a"), counts.get("c")), (Some(&2), None));
        counts.retain(|user| user != "a");
        assert_eq!((counts.get("a"), counts.values().count()), (None, 1));
    }
}
