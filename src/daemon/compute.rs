//! The compute thread: owns the pipeline, takes the latest frame and handles commands between frames.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use jiff::{SignedDuration, Timestamp};
use tokio::sync::mpsc;

use super::claims_log::ClaimsLog;
use super::pose::Poses;
use super::posts::Posts;
use super::publish::Outlet;
use super::reload::Settings;
use super::status::State;
use super::waiting::Waiting;
use crate::api::{ClaimsStatus, Command, FrameCounts, JournalStatus, Snapshot, SourceState, SourceStatus, Status};
use crate::claims::{Claim, ClaimState, Inbox};
use crate::frame::Frame;
use crate::frames::record::{Recorder, Taken};
use crate::frames::{Arrivals, Capture, Captured, Next};
use crate::journal::Journal;
use crate::metric;
use crate::monitor::{AlertEventKind, Report};
use crate::notify;
use crate::optics::Camera;
use crate::pipeline::{Pipeline, Step};
use crate::supervisor::Supervisor;

/// Longest wait of a command while no frame comes.
const PATIENCE: Duration = Duration::from_millis(50);
/// The same while posted claims wait to be placed.
const POSTING: Duration = Duration::from_millis(1);
/// The same while frames wait for poses.
const AWAITING: Duration = Duration::from_millis(5);
/// Most claims and poses kept for a recorder that accepts nothing.
const MOST_UNRECORDED: usize = 100_000;
/// A source that gives neither a frame nor a failure for this long is reported as failed.
const SILENCE: Duration = Duration::from_secs(2);

/// State of the compute thread.
pub struct Compute {
    pub pipeline: Pipeline,
    pub capture: Capture,
    pub waiting: Waiting,
    pub recorder: Option<Recorder>,
    /// Claims of the log that take effect with the next frame, so that a recording reproduces them.
    pub inbox: Inbox,
    pub posts: Posts,
    /// What the recorder does not have yet.
    pub unrecorded: Arrivals,
    pub commands: mpsc::Receiver<Command>,
    /// Loaded again while running.
    pub settings: mpsc::Receiver<Settings>,
    pub follower: Option<ClaimsLog>,
    pub outlet: Outlet,
    pub journal: Journal,
    pub webhooks: notify::Notifier,
    pub supervisor: Supervisor,
    pub camera: Arc<Camera>,
    pub poses: Poses,
    pub claims_log: Option<String>,
    pub source: String,
    /// A replay runs on the clock of its recording, every other source on the wall clock.
    pub is_replay: bool,
    /// An autopilot sends poses beside the frames.
    pub has_telemetry: bool,
    pub stop: Arc<AtomicBool>,
    pub ready: Arc<AtomicBool>,
    pub state: State,
}

impl Compute {
    /// Runs until `stop` is set.
    pub fn run(mut self) {
        let mut last_event = Instant::now();
        while !self.stop.load(Ordering::Relaxed) {
            self.take_settings();
            self.follow_log();
            self.handle_commands();
            let patience = match (self.posts.is_empty(), self.waiting.is_empty()) {
                (false, _) => POSTING,
                (true, false) => AWAITING,
                (true, true) => PATIENCE,
            };
            let captured = self.capture.next(patience);
            match captured.next {
                Next::Frame(..) | Next::Unusable { .. } => {
                    last_event = Instant::now();
                    self.waiting.push(captured);
                }
                Next::Nothing if !self.is_replay && last_event.elapsed() > SILENCE => {
                    last_event = Instant::now();
                    self.silence();
                }
                Next::End if self.waiting.is_empty() => self.ended(),
                Next::Nothing | Next::End => {}
            }
            while let Some(captured) = self.due() {
                self.process(captured);
            }
        }
        self.supervisor.stopping();
        self.outlet.close();
    }

    /// The next event of the source, once the poses of its time are there or have been waited for.
    fn due(&mut self) -> Option<Captured> {
        if !self.has_telemetry {
            return self.waiting.take(|_| true);
        }
        self.waiting.take(|time| {
            let poses = self.pipeline.receive_poses(Vec::new(), time);
            if self.recorder.is_some() {
                self.unrecorded.poses.extend(poses);
            }
            self.pipeline.is_posed(time)
        })
    }

    fn process(&mut self, captured: Captured) {
        match captured.next {
            Next::Frame(frame, arrivals) => {
                // The latency of a live frame counts from its capture; a recording's frame has waited for this thread.
                let since = if self.is_replay { Instant::now() } else { captured.at };
                self.take_arrivals(arrivals, frame.time);
                self.handle_commands();
                let recorded = self.recorder.as_mut().map(|r| r.frame(&frame, &self.unrecorded));
                self.recorded(recorded.flatten(), captured.file);
                self.frame(frame, since);
            }
            Next::Unusable {
                index,
                time,
                reason,
                arrivals,
            } => {
                self.take_arrivals(arrivals, time);
                self.unusable(index, time, reason, captured.file);
            }
            Next::Nothing | Next::End => {}
        }
    }

    /// Takes what came with a frame, the claims of the log that it has time for, and the poses until now.
    fn take_arrivals(&mut self, Arrivals { claims, poses }: Arrivals, now: Timestamp) {
        let poses = self.pipeline.receive_poses(poses, now);
        let batch = self.inbox.take();
        metrics::counter!(metric::CLAIMS, "outcome" => "shed").increment(batch.shed.shed_new + batch.shed.shed_known);
        self.pipeline.claims.note_shed(batch.shed, now);
        let claims = claims.into_iter().chain(batch.claims);
        if self.recorder.is_none() {
            return self.pipeline.claim(claims, now);
        }
        let claims: Vec<Claim> = claims.collect();
        let arrivals = Arrivals { claims, poses };
        self.unrecorded.append(arrivals.clone());
        self.pipeline.claim(arrivals.claims, now);
    }

    /// Sets the file that alerts name as holding their frame: the recorder's, or the one being replayed.
    fn recorded(&mut self, recorded: Option<Taken>, replayed: Option<Arc<Path>>) {
        // What the recorder could not accept goes with the next frame, unless the disk never recovers.
        let waiting = self.unrecorded.claims.len() + self.unrecorded.poses.len();
        if recorded.is_some() || waiting > MOST_UNRECORDED {
            self.unrecorded = Arrivals::default();
        }
        let file = recorded.and_then(|taken| taken.file).or(replayed);
        self.pipeline.monitor.recorded_in(file.as_deref());
    }

    fn frame(&mut self, frame: Frame, since: Instant) {
        let Step {
            report,
            estimate,
            estimation,
            verdicts,
            placement,
        } = self.pipeline.step(&frame);
        self.poses.update(frame.time, &placement);
        let s = &mut self.state;
        s.counts.captured += 1;
        s.clock = frame.time;
        s.arrived(Instant::now());
        metrics::counter!(metric::FRAMES_CAPTURED).increment(1);
        metrics::histogram!(metric::STAGE_SECONDS, "stage" => "estimate").record(estimation);
        metrics::histogram!(metric::STAGE_SECONDS, "stage" => "monitor").record(verdicts);
        match &estimate {
            Ok(estimate) => {
                metrics::counter!(metric::FRAMES_CUT_SHORT).increment(u64::from(estimate.is_cut_short));
                metrics::counter!(metric::FRAMES_LIMITED).increment(u64::from(estimate.is_limited));
                metrics::gauge!(metric::REDUCED_CHI2).set(estimate.reduced_chi2);
                metrics::gauge!(metric::SPOT_ERROR).set(estimate.spot_error);
                s.explained(estimate, self.camera.spot_error.least());
                if s.last_good.is_none() {
                    tracing::info!(frame = frame.index, "the first usable frame was processed");
                }
                s.last_good = Some(frame.time);
                s.fault = None;
                s.source = SourceState::Running;
                metrics::gauge!(metric::LAST_GOOD_FRAME).set(frame.time.as_millisecond() as f64 * 1e-3);
            }
            Err(error) => {
                s.counts.unusable += 1;
                s.source = SourceState::Blind;
                metrics::counter!(metric::FRAMES_UNUSABLE).increment(1);
                if s.fault.is_none() {
                    tracing::warn!(frame = frame.index, %error, "a frame cannot be used");
                }
                s.fault = Some(error.to_string());
            }
        }
        s.took(since.elapsed());
        metrics::histogram!(metric::FRAME_SECONDS).record(since.elapsed());
        self.publish(report, Some(Arc::new(frame)));
    }

    fn unusable(&mut self, index: u64, time: Timestamp, reason: String, replayed: Option<Arc<Path>>) {
        let recorded = self
            .recorder
            .as_mut()
            .map(|r| r.unusable(index, time, &reason, &self.unrecorded));
        let recorded = recorded.flatten().map(|_| Taken { file: None });
        self.recorded(recorded, replayed);
        let report = self.pipeline.unusable(index, time, &reason);
        let s = &mut self.state;
        s.clock = time;
        s.counts.unusable += 1;
        s.source = SourceState::Lost;
        metrics::counter!(metric::FRAMES_UNUSABLE).increment(1);
        if s.fault.as_deref() != Some(&reason) {
            tracing::warn!(frame = index, reason, "no usable frame");
        }
        s.fault = Some(reason);
        self.publish(report, None);
    }

    /// The source gives neither a frame nor a failure.
    fn silence(&mut self) {
        let index = self.state.counts.captured;
        let now = Timestamp::now();
        self.take_arrivals(Arrivals::default(), now);
        self.unusable(
            index,
            now,
            "the source gives neither frames nor errors".to_owned(),
            None,
        );
    }

    fn ended(&mut self) {
        if self.state.source != SourceState::Ended {
            self.state.source = SourceState::Ended;
            tracing::info!(
                frames = self.state.counts.captured,
                "the recording has ended; the API stays up"
            );
            if let Some(mut last) = self.state.last.take() {
                last.status.source.state = SourceState::Ended;
                self.outlet.snapshot(last);
            }
        }
        self.alive();
        // The ended capture returns at once; the pause avoids a busy loop.
        std::thread::sleep(PATIENCE);
    }

    fn publish(&mut self, mut report: Report, frame: Option<Arc<Frame>>) {
        for event in &mut report.events {
            // What came before an alert without a frame is recorded too, but is no file with its frame.
            if let (AlertEventKind::Raised, Some(recorder)) = (event.event, &mut self.recorder)
                && let Some(file) = recorder.evidence(&event.alert.id, report.time)
                && frame.is_some()
            {
                self.state.evidence.insert(event.alert.id.clone(), file);
            }
            self.state.name_evidence(&mut event.alert);
            self.state.note(event);
        }
        self.keep_lights();
        self.state.gauge(&report);
        let at = report.time;
        self.outlet.events(std::mem::take(&mut report.events), at);
        let status = self.status(&report);
        self.ready.store(true, Ordering::Relaxed);
        let camera = self.camera.clone();
        let snapshot = Snapshot {
            report,
            frame,
            camera,
            pose: Some(self.poses.latest()),
            status,
        };
        if self.is_replay {
            self.state.last = Some(snapshot.clone());
        }
        self.outlet.snapshot(snapshot);
        self.alive();
    }

    fn alive(&mut self) {
        let s = &self.state;
        let line = format!(
            "{} {:?}, {:.1} frames/s, {} µs a frame, {} open alerts",
            self.source,
            s.source,
            s.rate_hz(),
            s.latency().median_us,
            s.open.len()
        );
        self.supervisor.alive(&line);
    }

    fn status(&self, report: &Report) -> Status {
        let s = &self.state;
        let health = self.journal.health();
        let counts = self.pipeline.claims.counts();
        metrics::counter!(metric::CLAIMS, "outcome" => "accepted").absolute(counts.accepted);
        metrics::counter!(metric::CLAIMS, "outcome" => "late").absolute(counts.late);
        metrics::counter!(metric::CLAIMS, "outcome" => "duplicate").absolute(counts.duplicate);
        let refused = counts.too_late + counts.conflicting + counts.full;
        metrics::counter!(metric::CLAIMS, "outcome" => "refused").absolute(refused);
        if let Some(newest) = self.pipeline.claims.newest() {
            metrics::gauge!(metric::CLAIMS_LAST).set(newest.as_millisecond() as f64 * 1e-3);
        }
        Status {
            version: env!("CARGO_PKG_VERSION"),
            started_at: s.started_at,
            source: SourceStatus {
                kind: self.source.clone(),
                state: s.source,
                rate_hz: s.rate_hz(),
                last_good_frame_at: s.last_good,
                fault: s.fault.clone(),
            },
            frames: FrameCounts {
                dropped: self.capture.dropped(),
                ..s.counts
            },
            latency: s.latency(),
            claims: ClaimsStatus {
                log: self.claims_log.clone(),
                accepted: counts.accepted,
                malformed: s.malformed,
                users: report.claims.iter().filter(|c| c.state == ClaimState::Active).count() as u64,
                last_at: self.pipeline.claims.newest(),
            },
            journal: JournalStatus {
                healthy: health.writable,
                place: health
                    .path
                    .as_ref()
                    .map_or("memory".to_owned(), |p| p.display().to_string()),
                fault: if health.writable { None } else { health.last_error },
            },
            webhooks: self.webhooks.status(),
            estimator: self.pipeline.estimator().to_owned(),
            fit: s.fit.clone(),
            alerts_open: s.open_by_kind(),
            field_of_view_m: self
                .camera
                .to_ground([self.camera.x.half_width(), self.camera.y.half_width()]),
            view: self.poses.view(),
            stations: Vec::new(),
        }
    }

    /// The clock of the frames: a recording's own, else the wall clock.
    pub(super) fn now(&self) -> Timestamp {
        if self.is_replay {
            self.state.clock
        } else {
            Timestamp::now()
        }
    }
}

/// The clock of the frames before the first frame, at which no claim is late.
pub fn first_clock(is_replay: bool, start: Option<Timestamp>) -> Timestamp {
    match (is_replay, start) {
        (true, Some(start)) => start - SignedDuration::from_nanos(1),
        (true, None) => Timestamp::UNIX_EPOCH,
        (false, _) => Timestamp::now(),
    }
}
