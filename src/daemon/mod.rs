//! Composes the daemon: capture thread → latest-wins slot → compute thread → journal, snapshot and events → tasks.

mod claims_log;
mod compute;
mod intake;
mod operator;
mod pose;
mod posts;
mod process;
mod publish;
mod reload;
mod status;
mod waiting;

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use anyhow::{Context, Result};
use jiff::Timestamp;
use metrics_exporter_prometheus::PrometheusHandle;
use tokio::sync::{mpsc, watch};

use crate::claims::{Follower, Inbox};
use crate::config::Config;
use crate::frames::record::Recorder;
use crate::frames::{self, Arrivals, Capture, FrameSource, SourceKind};
use crate::journal::Journal;
use crate::optics::Camera;
use crate::pipeline::Pipeline;
use crate::platform::mavlink::Link;
use crate::platform::{self, Telemetry};
use crate::supervisor::Supervisor;
use crate::{api, export, fleet, logging, metric, notify};
use claims_log::ClaimsLog;
use compute::Compute;
use publish::Outlet;
use reload::Reload;
use status::State;

/// Most requests that wait for the compute thread; further ones are answered 503.
const COMMANDS: usize = 64;
/// Interval of journal maintenance (age and size limits).
const MAINTENANCE: Duration = Duration::from_secs(3600);
/// Interval of aggregating histogram samples: until then each sample is kept, also where no server asks for the metrics.
const UPKEEP: Duration = Duration::from_secs(5);
/// Time that deliveries under way have when the daemon stops.
const LAST_DELIVERIES: Duration = Duration::from_millis(800);

/// A daemon whose config has been checked and whose files have been opened; no port is bound yet.
pub struct Daemon {
    config: Config,
    path: Option<PathBuf>,
    camera: Camera,
    pipeline: Pipeline,
    source: Box<dyn FrameSource>,
    telemetry: Option<Link>,
    recorder: Option<Recorder>,
    server: api::Server,
    background: Option<api::Background>,
    endpoints: Vec<notify::Endpoint>,
    exports: Vec<export::Export>,
    station: Option<fleet::Station>,
    journal: Journal,
    metrics: PrometheusHandle,
}

impl Daemon {
    /// Checks and opens everything a config names. `path` is re-read on SIGHUP.
    pub fn new(config: Config, path: Option<PathBuf>) -> Result<Self> {
        let camera = config.camera()?;
        let pipeline = Pipeline::new(&config, &camera)?;
        config.journal.validate()?;
        // Before anything is opened, so that what is counted while opening is not lost.
        let recorder = metric::recorder()?;
        let metrics = recorder.handle();
        // A second daemon in one process (a test) counts into the first one's recorder.
        let _ = metrics::set_global_recorder(recorder);
        metric::describe();
        for warning in config.warnings(&camera).into_iter().chain(pipeline.warnings()) {
            tracing::warn!("{warning}");
        }
        let server = api::Server::new(config.api.clone())?;
        let background = api::Background::open(&config.api.background, config.world.axes().as_ref())?;
        let endpoints = notify::load(&config.webhook)?;
        let exports = export::load(&config.export, &endpoints, &config.world)?;
        let source = frames::open(&config.source, &camera)?;
        let telemetry = platform::open_telemetry(&config.platform)?;
        let recorder = Recorder::start(&config.record)?;
        let station = fleet::Station::new(&config.fleet)?;
        let receivers = endpoints.iter().chain(exports.iter().map(|export| &export.endpoint));
        let subscriptions = receivers
            .map(notify::Endpoint::subscription)
            .chain(station.as_ref().map(|_| fleet::Station::subscription()))
            .collect();
        let journal = Journal::open(&config.journal, subscriptions)?;
        Ok(Self {
            config,
            path,
            camera,
            pipeline,
            source,
            telemetry,
            recorder,
            server,
            background,
            endpoints,
            exports,
            station,
            journal,
            metrics,
        })
    }

    /// Runs until SIGTERM or SIGINT.
    pub async fn run(mut self, logging: logging::Handle) -> Result<()> {
        let metrics = self.metrics.clone();
        let started_at = Timestamp::now();
        let is_replay = self.config.source.kind == SourceKind::Replay;
        let first_clock = compute::first_clock(is_replay, self.config.source.start);
        let open = self.journal.open_alerts()?;
        let known: Vec<_> = open.iter().map(|a| (a.id.clone(), a.kind)).collect();
        self.pipeline.monitor.restore(open);
        operator::restore(&self.journal, &mut self.pipeline.monitor, first_clock)?;
        let listen = &self.config.api.listen;
        let listener = api::Listener::bind(listen).with_context(|| format!("api.listen: cannot listen on {listen}"))?;

        let (stop, stopped) = watch::channel(false);
        let stops = || {
            let mut stopped = stopped.clone();
            async move {
                // An error would mean that the sender is gone, which is a stop too.
                let _ = stopped.wait_for(|s| *s).await;
            }
        };
        let micros = u64::try_from(started_at.as_microsecond()).unwrap_or(0);
        let feed = Arc::new(api::Feed::new(self.journal.last_seq(), micros));
        let outlet = Outlet::default();
        let publisher = tokio::spawn(outlet.clone().publish(self.journal.clone(), feed.clone()));
        let (commands, orders) = mpsc::channel(COMMANDS);
        let mut exports = export::Running::new(export::Context {
            journal: self.journal.clone(),
            feed: feed.clone(),
            commands: commands.clone(),
            clock: notify::Clock::wall(),
        });
        let mut endpoints = self.endpoints;
        endpoints.extend(exports.replace(self.exports));
        let (notifier, deliveries) =
            notify::spawn(endpoints, self.journal.clone(), notify::Clock::wall(), micros, stops());
        let inbox = Inbox::new(self.pipeline.claims.roster());
        if let Some(station) = self.station {
            // A recording has its own claims.
            let intake = (!is_replay).then(|| fleet::Intake {
                reading: self.config.claims.clone(),
                inbox: inbox.clone(),
            });
            let publishing = station.run(self.journal.clone(), feed.clone(), intake, stops());
            tokio::spawn(async move {
                if let Err(error) = publishing.await {
                    tracing::error!(%error, "nothing is published to the fleet");
                }
            });
        }
        let (reloaded, settings) = mpsc::channel(1);
        let ready = Arc::new(AtomicBool::new(false));
        let state = api::State::new(feed, commands, self.journal.clone(), metrics.clone(), ready.clone());
        let mut state = state.with_webhooks(notifier.clone()).with_axes(self.config.claims.axes);
        state = state.with_background(self.background);
        if let Some(folder) = &self.config.record.folder {
            state = state.with_evidence(folder, &self.config.estimator);
        }

        let source = &self.config.source;
        let log = self.config.claims.log.as_deref();
        tracing::info!(
            source = source.kind.name(),
            pixels = format!("{} × {}", self.camera.x.n, self.camera.y.n),
            estimator = self.pipeline.estimator(),
            claims = log.map_or("POST only".to_owned(), |l| l.display().to_string()),
            journal = self
                .config
                .journal
                .path
                .as_ref()
                .map_or("memory".to_owned(), |p| p.display().to_string()),
            "watching; API and page on {}",
            listener.url(self.server.scheme())?,
        );
        let has_telemetry = self.telemetry.is_some();
        let telemetry = self.telemetry.zip(self.pipeline.pose_inbox());
        let telemetry = telemetry.map(|(link, inbox)| Telemetry::start(link, inbox, self.config.world.clone()));
        let _telemetry = telemetry.transpose()?;
        let halt = Arc::new(AtomicBool::new(false));
        if !is_replay {
            self.pipeline.claims.expect_live_claims();
        }
        let compute = Compute {
            pipeline: self.pipeline,
            capture: Capture::start(self.source)?,
            waiting: waiting::Waiting::default(),
            recorder: self.recorder,
            inbox: inbox.clone(),
            posts: posts::Posts::default(),
            unrecorded: Arrivals::default(),
            commands: orders,
            settings,
            follower: log
                .map(|l| ClaimsLog::new(Follower::new(l, &self.config.claims), inbox, is_replay))
                .transpose()?,
            outlet,
            journal: self.journal.clone(),
            webhooks: notifier.clone(),
            supervisor: Supervisor::default(),
            poses: pose::Poses::new(&self.config.platform, self.config.world.axes(), &self.camera),
            camera: Arc::new(self.camera),
            claims_log: log.map(|l| l.display().to_string()),
            source: source.kind.name().to_owned(),
            is_replay,
            has_telemetry,
            stop: halt.clone(),
            ready,
            state: State::new(started_at, first_clock, known),
        };
        let mut compute = tokio::task::spawn_blocking(move || compute.run());
        let mut serving = tokio::spawn(self.server.serve(listener, state, stops()));
        let upkeep = tokio::spawn(maintain(self.journal.clone(), metrics, started_at));

        let reload = Reload {
            current: self.config,
            path: self.path,
            logging,
            webhooks: notifier,
            exports,
            settings: reloaded,
        };
        let outcome = tokio::select! {
            signal = reload::until_stopped(reload) => signal,
            ended = &mut compute => Err(ended.err().map_or(
                anyhow::anyhow!("the compute thread ended by itself"),
                |panic| anyhow::anyhow!("the compute thread panicked: {panic}"),
            )),
            served = &mut serving => match served {
                Ok(Ok(())) => Err(anyhow::anyhow!("the API ended by itself")),
                Ok(Err(error)) => Err(error.into()),
                Err(panic) => Err(anyhow::anyhow!("the API panicked: {panic}")),
            },
        };

        // The compute thread stops first, then its readers; the journal is dropped last and writes what is left.
        halt.store(true, Ordering::Relaxed);
        if !compute.is_finished() {
            compute.await?;
        }
        publisher.await?;
        stop.send_replace(true);
        if !serving.is_finished() {
            serving.await??;
        }
        if tokio::time::timeout(LAST_DELIVERIES, deliveries).await.is_err() {
            tracing::info!("webhook deliveries are left for the next start");
        }
        upkeep.abort();
        tracing::info!("stopped");
        outcome
    }
}

async fn maintain(journal: Journal, metrics: PrometheusHandle, started_at: Timestamp) {
    let mut maintenance = tokio::time::interval(MAINTENANCE);
    let mut upkeep = tokio::time::interval(UPKEEP);
    loop {
        tokio::select! {
            _ = maintenance.tick() => journal.maintain(Timestamp::now()),
            _ = upkeep.tick() => {
                metrics.run_upkeep();
                process::measure(started_at);
            }
        }
    }
}
