//! `oapwatch fleet`: the alerts and positions of many access points as one, with what only all of them together show.

mod alerts;
pub mod chain;
mod conflicts;
mod intake;
mod latest;
mod picture;
mod record;
mod refusals;
mod review;
#[allow(clippy::disallowed_methods, reason = "silence is measured in the hub's own time")]
mod run;
mod snapshot;
mod stations;
mod stream;

use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Duration;

use anyhow::{Context, Result};
use jiff::Timestamp;
use metrics_exporter_prometheus::PrometheusHandle;
use tokio::signal::unix::{SignalKind, signal};
use tokio::sync::{mpsc, watch};

use crate::config::Config;
use crate::journal::Journal;
use crate::{api, export, fleet, logging, metric, notify};
pub use review::{ReviewError, review};
use run::Run;

/// Requests that wait for the hub; further ones are answered 503.
const COMMANDS: usize = 64;

/// Checks that a config is a hub's, and reads what proves that to the server; its other files are not opened.
pub fn validate(config: &Config) -> Result<fleet::Access> {
    config.fleet.validate_hub()?;
    config.journal.validate()?;
    Ok(fleet::Access::read(&config.fleet)?)
}

/// A hub whose config has been checked and whose files have been opened; no port is bound yet.
pub struct Hub {
    config: Config,
    access: fleet::Access,
    server: api::Server,
    background: Option<api::Background>,
    endpoints: Vec<notify::Endpoint>,
    exports: Vec<export::Export>,
    journal: Journal,
    metrics: PrometheusHandle,
}

impl Hub {
    /// Checks and opens everything a config names.
    pub fn new(config: Config) -> Result<Self> {
        let access = validate(&config)?;
        let recorder = metric::recorder()?;
        let metrics = recorder.handle();
        // A second daemon in one process (a test) counts into the first one's recorder.
        let _ = metrics::set_global_recorder(recorder);
        metric::describe();
        let server = api::Server::new(config.api.clone())?;
        let background = api::Background::open(&config.api.background, config.world.axes().as_ref())?;
        let endpoints = notify::load(&config.webhook)?;
        let exports = export::load(&config.export, &endpoints, &config.world)?;
        let receivers = endpoints.iter().chain(exports.iter().map(|export| &export.endpoint));
        let subscriptions = receivers.map(notify::Endpoint::subscription).collect();
        let journal = Journal::open(&config.journal, subscriptions)?;
        Ok(Self {
            config,
            access,
            server,
            background,
            endpoints,
            exports,
            journal,
            metrics,
        })
    }

    /// Runs until SIGTERM or SIGINT.
    #[allow(clippy::disallowed_methods, reason = "the hub's own time begins here")]
    pub async fn run(self, _logging: logging::Handle) -> Result<()> {
        let listen = &self.config.api.listen;
        let listener = api::Listener::bind(listen).with_context(|| format!("api.listen: cannot listen on {listen}"))?;
        let client = self.access.connect("hub".to_owned(), fleet::CAPACITY).await?;
        let started_at = Timestamp::now();
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
        let clock = notify::Clock::wall();
        let (commands, orders) = mpsc::channel(COMMANDS);
        let mut exports = export::Running::new(export::Context {
            journal: self.journal.clone(),
            feed: feed.clone(),
            commands: commands.clone(),
            clock,
        });
        let mut endpoints = self.endpoints;
        endpoints.extend(exports.replace(self.exports));
        let (notifier, deliveries) = notify::spawn(endpoints, self.journal.clone(), clock, micros, stops());
        let ready = Arc::new(AtomicBool::new(false));
        let state = api::State::new(
            feed.clone(),
            commands,
            self.journal.clone(),
            self.metrics.clone(),
            ready.clone(),
        );
        let state = state.with_webhooks(notifier.clone()).of_hub();
        let state = state.with_background(self.background);
        tracing::info!(
            site = self.config.fleet.site.as_deref().unwrap_or("all"),
            url = self.config.fleet.url.as_deref().unwrap_or_default(),
            "hub of a fleet; API and page on {}",
            listener.url(self.server.scheme())?,
        );
        let run = Run::new(&self.config, self.journal.clone(), feed, notifier, ready, started_at)?;
        let mut working = tokio::spawn(run.run(client, orders, stops()));
        let mut serving = tokio::spawn(self.server.serve(listener, state, stops()));
        let upkeep = tokio::spawn(maintain(self.journal.clone(), self.metrics.clone()));
        let mut terminate = signal(SignalKind::terminate())?;
        let mut interrupt = signal(SignalKind::interrupt())?;
        let outcome = tokio::select! {
            _ = terminate.recv() => Ok(()),
            _ = interrupt.recv() => Ok(()),
            ended = &mut working => Err(anyhow::anyhow!("the hub ended by itself: {ended:?}")),
            served = &mut serving => match served? {
                Ok(()) => Err(anyhow::anyhow!("the API ended by itself")),
                Err(error) => Err(error.into()),
            },
        };
        stop.send_replace(true);
        upkeep.abort();
        if !working.is_finished() {
            working.await?;
        }
        if !serving.is_finished() {
            serving.await??;
        }
        if tokio::time::timeout(LAST_DELIVERIES, deliveries).await.is_err() {
            tracing::info!("webhook deliveries are left for the next start");
        }
        tracing::info!("stopped");
        outcome
    }
}

/// Interval of journal maintenance (age and size limits).
const MAINTENANCE: Duration = Duration::from_secs(3600);
/// Interval of aggregating histogram samples: until then each sample is kept, also where no server asks for the metrics.
const UPKEEP: Duration = Duration::from_secs(5);

#[allow(clippy::disallowed_methods, reason = "the journal's limits are of age")]
async fn maintain(journal: Journal, metrics: PrometheusHandle) {
    let mut maintenance = tokio::time::interval(MAINTENANCE);
    let mut upkeep = tokio::time::interval(UPKEEP);
    loop {
        tokio::select! {
            _ = maintenance.tick() => journal.maintain(Timestamp::now()),
            _ = upkeep.tick() => metrics.run_upkeep(),
        }
    }
}

/// Time that deliveries under way have when the hub stops.
const LAST_DELIVERIES: Duration = Duration::from_millis(800);
