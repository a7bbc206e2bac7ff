//! `user_out_of_zone`: a user is in a restricted zone that does not list them, or outside of all zones that do.

use serde_json::json;

use crate::monitor::alert::{AlertKind, Severity};
use crate::monitor::evidence::claimed;
use crate::monitor::finding::{Cause, Content, Finding};
use crate::monitor::frame_context::FrameContext;
use crate::monitor::stats::error_budget::TestFamily;
use crate::monitor::track::beam_track::Track;
use crate::monitor::zones::{Inside, REACH_M, Zone, ZoneKind};
use crate::time::seconds;

/// Standard deviations of a position by which a user must be inside of a restricted zone. More let somebody in before the alert, fewer
/// raise alerts for who walks along its edge.
const INSIDE: f64 = 3.0;

/// Where a user is who should not be there.
struct Breach {
    zones: Vec<String>,
    is_restricted: bool,
    depth_m: f64,
}

pub fn evaluate(frame: &FrameContext) -> Vec<Finding> {
    let open = frame.alerts.users_with(AlertKind::UserOutOfZone);
    if frame.zones.is_empty() && open.is_empty() {
        return Vec::new();
    }
    let mut findings = Vec::new();
    for (i, claim) in frame.claims.iter().enumerate() {
        let user = claim.claim.user.as_str();
        let track = frame.track(i).filter(|t| t.hit && t.confirmed);
        let breach = track.and_then(|t| Some((breach(frame, user, t)?, t)));
        if breach.is_none() && !open.contains(user) {
            continue;
        }
        let cause = Cause::User(AlertKind::UserOutOfZone, user.to_owned());
        let raised_at = frame.alerts.raised_at(&cause).unwrap_or(frame.now);
        // A user who cannot be placed in this frame is where they were.
        if track.is_none() && frame.association.track_id(i).is_some() {
            continue;
        }
        let content = breach.map(|(breach, track)| {
            let severity = match breach.is_restricted {
                true => Severity::Critical,
                false => Severity::of_duration(seconds(raised_at, frame.now)),
            };
            let evidence = json!({
                "track": track.id,
                "zones": breach.zones,
                "is_restricted": breach.is_restricted,
                "depth_m": breach.depth_m,
            });
            Content::new(severity, evidence)
                .at(frame.place(track), frame.position_cov(track))
                .with_claim(claimed(claim))
        });
        findings.push(Finding::of(cause, content));
    }
    findings
}

fn breach(frame: &FrameContext, user: &str, track: &Track) -> Option<Breach> {
    let place = frame.world(track);
    let error_m = frame.position_error_m(track);
    let is_of_interest = |zone: &Zone| zone.kind == ZoneKind::Restricted || zone.lists(user);
    let near: Vec<Inside> = frame.zones.near(place, REACH_M, is_of_interest).collect();
    let forbidden = near
        .iter()
        .filter(|i| i.zone.kind == ZoneKind::Restricted && i.depth_m > INSIDE * error_m && !i.zone.lists(user));
    if let Some(inside) = forbidden.max_by(|a, b| a.depth_m.total_cmp(&b.depth_m)) {
        return Some(Breach {
            zones: vec![inside.zone.name.clone()],
            is_restricted: true,
            depth_m: inside.depth_m,
        });
    }
    let allowed = frame.zones.listing(user);
    if allowed.is_empty() || !frame.is_settled() {
        return None;
    }
    // One test of each user's place at each frame.
    let threshold = frame.budget.threshold(TestFamily::Mismatch, frame.claims.len() as f64);
    let reach_m = (2.0 * threshold).sqrt() * error_m;
    let depths = near.iter().filter(|i| i.zone.lists(user)).map(|i| i.depth_m);
    let depth_m = depths.fold(f64::NEG_INFINITY, f64::max);
    (depth_m < -reach_m).then(|| Breach {
        zones: allowed.into_iter().take(20).map(|z| z.name.clone()).collect(),
        is_restricted: false,
        // What is farther off has no depth that JSON could state.
        depth_m: depth_m.max(-REACH_M),
    })
}
