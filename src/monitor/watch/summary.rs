use jiff::Timestamp;

use super::Monitor;
use crate::estimate::Flags;
use crate::monitor::book::Cause;
use crate::monitor::users::Asserted;
use crate::monitor::{AlertKind, PositionStatus, Report, TrackedPosition};

impl Monitor {
    pub(super) fn report(&mut self, asserted: &[Asserted], frame: u64, now: Timestamp) -> Report {
        let events = self.book.take_events();
        let owner = |id: u64| {
            asserted.iter().find(|a| {
                self.users
                    .get(&a.claim.user)
                    .is_some_and(|u| u.track == Some(id) && u.unanswered_since.is_none())
            })
        };
        let emitters = self
            .tracks
            .all
            .iter()
            .filter(|t| t.is_seen())
            .map(|t| {
                let user = owner(t.id).map(|a| a.claim.user.clone());
                let is_open = |kind: AlertKind| match (&user, kind) {
                    (Some(user), kind) => self.book.is_open(&Cause::User(kind, user.clone())),
                    (None, kind) => self.book.is_open(&Cause::Track(kind, t.id)),
                };
                let status = match &user {
                    Some(_) if is_open(AlertKind::PositionMismatch) => PositionStatus::Mismatch,
                    Some(_) if t.confirmed => PositionStatus::Verified,
                    None if is_open(AlertKind::UnclaimedEmitter) => PositionStatus::Unclaimed,
                    _ => PositionStatus::Pending,
                };
                let (p, c) = (t.motion.position(), t.motion.position_cov());
                TrackedPosition {
                    track: t.id,
                    x_m: p.x,
                    y_m: p.y,
                    cov_m2: [[c[(0, 0)], c[(0, 1)]], [c[(1, 0)], c[(1, 1)]]],
                    energy_j: t.detection.energy_j,
                    user,
                    status,
                    flags: match t.merged.is_some() {
                        true => (t.detection.flags | Flags::UNRESOLVED).names(),
                        false => t.detection.flags.names(),
                    },
                }
            })
            .collect();
        let unseen = asserted
            .iter()
            .filter(|a| {
                self.book
                    .is_open(&Cause::User(AlertKind::UserUnseen, a.claim.user.clone()))
            })
            .map(|a| a.claim.user.clone())
            .chain(self.strangers.iter().cloned())
            .collect();
        Report {
            time: now,
            frame,
            emitters,
            unseen,
            events,
            claims: asserted.iter().map(|a| a.claim.clone()).collect(),
        }
    }
}
