//! Counters and windows that the compute thread keeps from frame to frame, and the gauges that follow from them.

use std::collections::{BTreeMap, VecDeque};
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};

use jiff::Timestamp;
use metrics::{counter, gauge};

use crate::api::{FitStatus, FrameCounts, Latency, Snapshot, SourceState};
use crate::estimate::Estimate;
use crate::metric;
use crate::monitor::{Alert, AlertEvent, AlertEventKind, AlertKind, AlertState, PositionStatus, Report};
use crate::word::word;

/// Frames over which rate and latency are computed.
const WINDOW: usize = 128;
/// Frames over which it is judged whether spots differ from the model: a single one may by chance.
const SPOT_FRAMES: u32 = 10;
/// Without a frame for this long the rate is 0.
const STALE: Duration = Duration::from_secs(2);

/// State of the compute thread that the status shows.
pub(super) struct State {
    pub started_at: Timestamp,
    pub clock: Timestamp,
    pub counts: FrameCounts,
    pub malformed: u64,
    pub last_good: Option<Timestamp>,
    pub fault: Option<String>,
    /// Whether it was said that the spots differ from the model.
    pub has_warned_of_spot: bool,
    /// How the latest usable frame was explained.
    pub fit: Option<FitStatus>,
    /// Frames whose spots differ from the model less those whose spots do not, within 0 and [`SPOT_FRAMES`].
    misshapen: u32,
    pub source: SourceState,
    pub latencies: VecDeque<Duration>,
    pub arrivals: VecDeque<Instant>,
    pub open: BTreeMap<String, AlertKind>,
    pub log_broken: bool,
    /// When a malformed line was last named, and how many have come since.
    pub complained: Option<Instant>,
    pub unnamed: u64,
    pub last: Option<Snapshot>,
    /// Files that hold the evidence of the alerts that are not cleared, by id.
    pub evidence: BTreeMap<String, Arc<Path>>,
}

impl State {
    pub fn new(started_at: Timestamp, clock: Timestamp, open: impl IntoIterator<Item = (String, AlertKind)>) -> Self {
        for kind in AlertKind::ALL {
            counter!(metric::ALERTS_RAISED, "kind" => word(kind)).increment(0);
        }
        Self {
            started_at,
            clock,
            counts: FrameCounts::default(),
            malformed: 0,
            last_good: None,
            fault: None,
            has_warned_of_spot: false,
            fit: None,
            misshapen: 0,
            source: SourceState::Starting,
            latencies: VecDeque::with_capacity(WINDOW),
            arrivals: VecDeque::with_capacity(WINDOW),
            open: open.into_iter().collect(),
            log_broken: false,
            complained: None,
            unnamed: 0,
            last: None,
            evidence: BTreeMap::new(),
        }
    }

    pub fn arrived(&mut self, at: Instant) {
        push(&mut self.arrivals, at);
    }

    /// Takes how a frame was explained, beside the spot error that is known.
    pub fn explained(&mut self, estimate: &Estimate, known_spot_error: f64) {
        self.misshapen = match estimate.spot_error > known_spot_error {
            true => (self.misshapen + 1).min(SPOT_FRAMES),
            false => self.misshapen.saturating_sub(1),
        };
        let is_misshapen = 2 * self.misshapen > SPOT_FRAMES;
        self.fit = Some(FitStatus {
            reduced_chi2: Some(estimate.reduced_chi2).filter(|c| c.is_finite()),
            spot_error: estimate.spot_error,
            hint: is_misshapen.then_some(FitStatus::CALIBRATE),
        });
        if is_misshapen && !self.has_warned_of_spot {
            self.has_warned_of_spot = true;
            tracing::warn!(spot_error = estimate.spot_error, "{}", FitStatus::CALIBRATE);
        }
    }

    pub fn took(&mut self, time: Duration) {
        push(&mut self.latencies, time);
    }

    /// Makes an alert name the file of its evidence, in place of the ring's segment, which is deleted in time.
    pub fn name_evidence(&self, alert: &mut Alert) {
        if let Some(file) = self.evidence.get(&alert.id) {
            alert.source.file = Some(file.display().to_string());
        }
    }

    /// Keeps count of what is open.
    pub fn note(&mut self, event: &AlertEvent) {
        let alert = &event.alert;
        if alert.state == AlertState::Cleared {
            self.open.remove(&alert.id);
            self.evidence.remove(&alert.id);
        } else {
            self.open.insert(alert.id.clone(), alert.kind);
        }
        if event.event == AlertEventKind::Raised {
            counter!(metric::ALERTS_RAISED, "kind" => word(alert.kind)).increment(1);
        }
    }

    /// Alerts that are not cleared, by kind.
    pub fn open_by_kind(&self) -> BTreeMap<AlertKind, u64> {
        let mut open = BTreeMap::new();
        for kind in self.open.values() {
            *open.entry(*kind).or_insert(0) += 1;
        }
        open
    }

    /// Sets the gauges that follow from a report.
    pub fn gauge(&self, report: &Report) {
        use PositionStatus::{Ignored, Known, Mismatch, Pending, Unclaimed, Verified};
        for status in [Verified, Mismatch, Unclaimed, Pending, Known, Ignored] {
            let count = report.emitters.iter().filter(|e| e.status == status).count();
            gauge!(metric::EMITTERS, "status" => word(status)).set(count as f64);
        }
        gauge!(metric::USERS_UNSEEN).set(report.unseen.len() as f64);
        let open = self.open_by_kind();
        for kind in AlertKind::ALL {
            let count = open.get(&kind).copied().unwrap_or(0);
            gauge!(metric::ALERTS_OPEN, "kind" => word(kind)).set(count as f64);
        }
    }

    pub fn latency(&self) -> Latency {
        let mut sorted: Vec<_> = self.latencies.iter().copied().collect();
        sorted.sort_unstable();
        let us = |d: Option<&Duration>| d.map_or(0, |d| d.as_micros() as u64);
        Latency {
            last_us: us(self.latencies.back()),
            median_us: us(sorted.get(sorted.len() / 2)),
            p99_us: us(sorted.get((sorted.len() * 99) / 100)),
        }
    }

    pub fn rate_hz(&self) -> f64 {
        match (self.arrivals.front(), self.arrivals.back()) {
            (Some(first), Some(last)) if last > first && last.elapsed() < STALE => {
                (self.arrivals.len() - 1) as f64 / (*last - *first).as_secs_f64()
            }
            _ => 0.0,
        }
    }
}

fn push<T>(window: &mut VecDeque<T>, value: T) {
    if window.len() == WINDOW {
        window.pop_front();
    }
    window.push_back(value);
}
