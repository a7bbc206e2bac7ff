use std::collections::BTreeMap;

use jiff::Timestamp;

use crate::estimate::Flags;
use crate::monitor::alert::AlertKind;
use crate::monitor::alert_lifecycle::Cause;
use crate::monitor::input::claim_state::ActiveClaim;
use crate::monitor::monitor::Monitor;
use crate::monitor::report::{PositionStatus, Report, TrackedPosition};

impl Monitor {
    pub fn report(&mut self, active: &[ActiveClaim], frame: u64, now: Timestamp) -> Report {
        let events = self.alerts.take_events();
        let mut owners: BTreeMap<u64, &str> = BTreeMap::new();
        for a in active {
            let answered = self.users.get(&a.claim.user).filter(|u| u.unanswered_since.is_none());
            if let Some(id) = answered.and_then(|u| u.track) {
                owners.entry(id).or_insert(&a.claim.user);
            }
        }
        let emitters = self
            .tracks
            .all
            .iter()
            .filter(|t| t.is_seen())
            .map(|t| {
                let user = owners.get(&t.id).map(|user| (*user).to_owned());
                let is_open = |kind: AlertKind| match (&user, kind) {
                    (Some(user), kind) => self.alerts.is_open(&Cause::User(kind, user.clone())),
                    (None, kind) => self.alerts.is_open(&Cause::Track(kind, t.id)),
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
                    flags: match t.merged_into.is_some() {
                        true => (t.detection.flags | Flags::UNRESOLVED).names(),
                        false => t.detection.flags.names(),
                    },
                }
            })
            .collect();
        let is_present = |user: &str| active.binary_search_by(|a| a.claim.user.as_str().cmp(user)).is_ok();
        let unseen = self
            .alerts
            .open()
            .filter_map(|(cause, _)| match cause {
                Cause::User(AlertKind::UserUnseen, user) if is_present(user) => Some(user.clone()),
                _ => None,
            })
            .chain(self.never_seen.iter().cloned())
            .collect();
        Report {
            time: now,
            frame,
            emitters,
            unseen,
            events,
            claims: active.iter().map(|a| a.claim.clone()).collect(),
        }
    }
}
