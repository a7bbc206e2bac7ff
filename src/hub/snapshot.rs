//! The picture of all stations, as one station's would be.

use std::sync::Arc;

use jiff::Timestamp;

use super::chain::Chain;
use super::refusals::Refusals;
use crate::api::{
    ClaimsStatus, FrameCounts, JournalStatus, Latency, Snapshot, SourceState, SourceStatus, StationStatus, Status,
};
use crate::journal;
use crate::monitor::Report;
use crate::notify::EndpointStatus;
use crate::optics::Camera;

/// What is shown beside the chain's own.
pub struct Facts<'a> {
    pub started_at: Timestamp,
    /// Pictures a second.
    pub rate_hz: f64,
    pub camera: Arc<Camera>,
    pub journal: journal::Health,
    pub webhooks: Vec<EndpointStatus>,
    pub refusals: &'a Refusals,
}

pub fn of(chain: &mut Chain, facts: Facts<'_>, now: Timestamp) -> Snapshot {
    let picture = chain.picture(now);
    let mut stations = chain.statuses(now);
    let source = source(&stations, facts.rate_hz, picture.time);
    facts.refusals.show(&mut stations);
    let furthest = picture
        .emitters
        .iter()
        .fold([1.0f64; 2], |[x, y], e| [x.max(e.x_m.abs()), y.max(e.y_m.abs())]);
    let views = stations.iter().filter_map(|s| s.field_of_view_m);
    let field_of_view_m = views.fold(furthest, |[x, y], [a, b]| [x.max(a), y.max(b)]);
    let status = Status {
        version: env!("CARGO_PKG_VERSION"),
        started_at: facts.started_at,
        source,
        frames: FrameCounts::default(),
        latency: Latency::default(),
        claims: ClaimsStatus {
            users: picture.claims.len() as u64,
            ..ClaimsStatus::default()
        },
        journal: journal(facts.journal),
        webhooks: facts.webhooks,
        estimator: "fleet".to_owned(),
        fit: None,
        alerts_open: chain.open_by_kind(),
        field_of_view_m,
        view: None,
        stations,
    };
    Snapshot {
        frame: None,
        camera: facts.camera,
        pose: None,
        status,
        report: Report {
            time: now,
            frame: picture.frame,
            emitters: picture.emitters,
            unseen: picture.unseen,
            events: Vec::new(),
            claims: picture.claims,
        },
    }
}

fn source(stations: &[StationStatus], rate_hz: f64, newest: Timestamp) -> SourceStatus {
    let is_running = !stations.is_empty();
    SourceStatus {
        kind: "fleet".to_owned(),
        state: match is_running {
            true => SourceState::Running,
            false => SourceState::Starting,
        },
        rate_hz,
        last_good_frame_at: is_running.then_some(newest),
        fault: None,
    }
}

fn journal(health: journal::Health) -> JournalStatus {
    JournalStatus {
        healthy: health.writable,
        place: health
            .path
            .as_ref()
            .map_or("memory".to_owned(), |p| p.display().to_string()),
        fault: if health.writable { None } else { health.last_error },
    }
}
