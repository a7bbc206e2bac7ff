//! Ids of alerts: kind, time and a count within the same instant, so that the same input gives the same ids.

use std::collections::BTreeMap;

use jiff::Timestamp;

use super::alert::AlertKind;
use crate::word::word;

/// Alerts of each kind raised at the newest instant.
#[derive(Debug, Default)]
pub(super) struct AlertIds {
    now: Timestamp,
    raised: BTreeMap<AlertKind, u32>,
}

impl AlertIds {
    /// The id of the next alert of this kind.
    pub fn next(&mut self, kind: AlertKind, now: Timestamp) -> String {
        if self.now != now {
            (self.now, self.raised) = (now, BTreeMap::new());
        }
        let next = self.raised.entry(kind).or_default();
        let number = *next;
        *next += 1;
        format!("{}-{}-{number}", word(kind), now.strftime("%Y%m%dT%H%M%S%6fZ"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_id_is_of_kind_time_and_number() {
        let mut ids = AlertIds::default();
        let at = |s: i64| Timestamp::from_second(s).unwrap();
        let mut next = |kind: AlertKind, s: i64| ids.next(kind, at(s));
        assert_eq!(
            next(AlertKind::UnclaimedEmitter, 1000),
            "unclaimed_emitter-19700101T001640000000Z-0"
        );
        assert_eq!(
            next(AlertKind::UnclaimedEmitter, 1000),
            "unclaimed_emitter-19700101T001640000000Z-1"
        );
        assert_eq!(
            next(AlertKind::UserUnseen, 1000),
            "user_unseen-19700101T001640000000Z-0"
        );
        assert_eq!(
            next(AlertKind::UserUnseen, 1001),
            "user_unseen-19700101T001641000000Z-0"
        );
    }
}
