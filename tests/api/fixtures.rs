//! An alert, and what a daemon would publish of a frame.

use std::collections::BTreeMap;
use std::sync::Arc;

use ndarray::Array2;
use oapwatch::api;
use oapwatch::claim::Claim;
use oapwatch::frame::Frame;
use oapwatch::monitor::{Alert, AlertKind, AlertSource, AlertState, PositionStatus, Report, Severity, TrackedPosition};
use oapwatch::optics;

use super::fake::at;

pub fn alert(id: &str, second: i64) -> Alert {
    Alert {
        id: id.into(),
        kind: AlertKind::UnclaimedEmitter,
        severity: Severity::Critical,
        state: AlertState::Open,
        raised_at: at(second),
        cleared_at: None,
        user: None,
        x_m: Some(-40.0),
        y_m: Some(60.0),
        z_m: Some(0.0),
        geodetic: None,
        cov_m2: Some([[0.01, 0.0], [0.0, 0.01]]),
        claimed: None,
        evidence: serde_json::json!({"seconds_seen": 1.0, "log_likelihood_ratio": 38.2}),
        source: AlertSource {
            kind: "simulator".into(),
            frame: 10,
            file: None,
        },
        zone: None,
        webhooks: None,
        maintenance: None,
        acknowledgement: None,
        station: None,
    }
}

fn beam(track: u64, x_m: f64, y_m: f64, user: Option<&str>, status: PositionStatus) -> TrackedPosition {
    TrackedPosition {
        track,
        x_m,
        y_m,
        z_m: 0.0,
        geodetic: None,
        cov_m2: [[0.04, 0.01], [0.01, 0.03]],
        energy_j: 0.008,
        user: user.map(str::to_owned),
        status,
        flags: Vec::new(),
        known_light: None,
        station: None,
    }
}

fn claim(user: &str, x_m: f64, y_m: f64) -> Claim {
    serde_json::from_value(serde_json::json!({"time": at(0), "user": user, "x_m": x_m, "y_m": y_m})).unwrap()
}

pub fn snapshot(number: u64) -> api::Snapshot {
    let camera = Arc::new(optics::Config::default().camera().unwrap());
    let time = at(number as i64);
    let frame = Frame {
        index: number,
        time,
        pixels: Array2::from_shape_fn(camera.shape(), |(y, x)| ((x * y) % 97) as f64 * 1e-6),
        masked: None,
        exposure_s: None,
        energy_scale: 1.0,
    };
    let report = Report {
        time,
        frame: number,
        emitters: vec![
            beam(1, 10.0, 20.0, Some("u-1"), PositionStatus::Verified),
            beam(2, 55.0, -30.0, Some("u-2"), PositionStatus::Mismatch),
            beam(3, -40.0, 60.0, None, PositionStatus::Unclaimed),
        ],
        unseen: vec!["u-9".into()],
        events: Vec::new(),
        claims: vec![
            claim("u-1", 10.0, 20.0),
            claim("u-2", 90.0, -30.0),
            claim("u-9", 0.0, -90.0),
        ],
    };
    api::Snapshot {
        report,
        frame: Some(Arc::new(frame)),
        pose: Some(api::PoseStatus {
            source: "fixed".into(),
            time,
            is_lost: false,
            pose: None,
        }),
        status: api::Status {
            version: "0",
            started_at: at(0),
            source: api::SourceStatus {
                kind: "simulator".into(),
                state: api::SourceState::Running,
                rate_hz: 10.0,
                last_good_frame_at: Some(time),
                fault: None,
            },
            frames: api::FrameCounts::default(),
            latency: api::Latency::default(),
            claims: api::ClaimsStatus::default(),
            journal: api::JournalStatus {
                healthy: true,
                place: "memory".into(),
                fault: None,
            },
            webhooks: Vec::new(),
            estimator: "fit".into(),
            fit: None,
            alerts_open: BTreeMap::new(),
            field_of_view_m: [125.0, 125.0],
            view: None,
            stations: Vec::new(),
        },
        camera,
    }
}
