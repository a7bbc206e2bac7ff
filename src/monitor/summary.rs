//! The report of a frame: every beam with its position, user and status, and who is unseen.

use std::collections::{BTreeMap, BTreeSet};

use super::alert::{AlertEvent, AlertKind};
use super::finding::Cause;
use super::frame_context::FrameContext;
use super::report::{PositionStatus, Report, TrackedPosition};
use super::track::beam_track::Track;
use crate::estimate::Flags;

/// The report of frame `index`; `never_seen` share one alert.
pub(super) fn report(frame: &FrameContext, index: u64, never_seen: &[String], events: Vec<AlertEvent>) -> Report {
    let mut owners: BTreeMap<u64, &str> = BTreeMap::new();
    for claim in &frame.claims {
        let user = frame.users.get(&claim.claim.user).filter(|u| u.unseen_since.is_none());
        if let Some(track) = user.and_then(|u| u.track) {
            owners.entry(track).or_insert(&claim.claim.user);
        }
    }
    let mismatched = frame.alerts.users_with(AlertKind::PositionMismatch);
    let unseen = frame.alerts.users_with(AlertKind::UserUnseen);
    let seen = frame.tracker.tracks.iter().filter(|t| t.is_seen());
    Report {
        time: frame.now,
        frame: index,
        emitters: seen
            .map(|track| position(frame, track, owners.get(&track.id).copied(), &mismatched))
            .collect(),
        unseen: frame
            .claims
            .iter()
            .map(|a| &a.claim.user)
            .filter(|user| unseen.contains(user.as_str()))
            .chain(never_seen)
            .cloned()
            .collect(),
        events,
        claims: frame.claims.iter().map(|a| a.claim.clone()).collect(),
    }
}

fn position(frame: &FrameContext, track: &Track, user: Option<&str>, mismatched: &BTreeSet<&str>) -> TrackedPosition {
    let known_light = frame.lights.of_track(track.id).map(|s| s.light.id.clone());
    let status = match user {
        Some(user) if mismatched.contains(user) => PositionStatus::Mismatch,
        Some(_) if track.confirmed => PositionStatus::Verified,
        None if frame.alerts.is_open(&Cause::Track(track.id)) => PositionStatus::Unclaimed,
        None if known_light.is_some() => PositionStatus::Known,
        None if track.confirmed && frame.ignore_zone(track).is_some() => PositionStatus::Ignored,
        _ => PositionStatus::Pending,
    };
    let (place, c) = (frame.place(track), frame.position_cov(track));
    let flags = track.detection.flags;
    TrackedPosition {
        track: track.id,
        x_m: place.x,
        y_m: place.y,
        z_m: place.z,
        geodetic: frame.geodetic(place),
        cov_m2: [[c[(0, 0)], c[(0, 1)]], [c[(1, 0)], c[(1, 1)]]],
        energy_j: track.detection.energy_j,
        user: user.map(str::to_owned),
        status,
        flags: match track.merged_into.is_some() {
            true => (flags | Flags::UNRESOLVED).names(),
            false => flags.names(),
        },
        known_light,
        station: None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::monitor::alert::Severity;
    use crate::monitor::finding::{Content, Finding};
    use crate::monitor::fixture::Scene;

    #[test]
    fn a_beam_is_verified_pending_unclaimed_or_mismatched() {
        let mut scene = Scene::of_users(&[[0.0, 0.0], [50.0, 0.0]]);
        scene.show(&[[0.0, 0.0], [50.0, 0.0], [0.0, 60.0], [0.0, -60.0]]);
        let statuses = |scene: &Scene| {
            let report = report(scene.context(), 7, &["z".to_owned()], Vec::new());
            assert_eq!((report.frame, report.unseen), (7, vec!["z".to_owned()]));
            let of = |e: TrackedPosition| (e.user.unwrap_or_default(), e.status);
            report.emitters.into_iter().map(of).collect::<Vec<_>>()
        };
        use PositionStatus::*;
        let own = |user: &str, status: PositionStatus| (user.to_owned(), status);
        assert_eq!(
            statuses(&scene),
            [
                own("u-0", Verified),
                own("u-1", Verified),
                own("", Pending),
                own("", Pending)
            ]
        );
        let raise = |cause: Cause| Finding::present(cause, Content::new(Severity::Warning, serde_json::json!({})));
        scene.apply(vec![
            raise(Cause::User(AlertKind::PositionMismatch, "u-1".into())),
            raise(Cause::Track(3)),
        ]);
        assert_eq!(
            statuses(&scene),
            [
                own("u-0", Verified),
                own("u-1", Mismatch),
                own("", Unclaimed),
                own("", Pending)
            ]
        );
    }
}
