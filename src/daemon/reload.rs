//! Signals: stop the daemon, or reload the config.

use std::path::PathBuf;

use anyhow::Result;
use tokio::signal::unix::{SignalKind, signal};
use tokio::sync::{mpsc, oneshot};

use crate::config::Config;
use crate::pipeline::{self, Places};
use crate::supervisor::Supervisor;
use crate::{claims, export, logging, monitor, notify};

/// What the compute thread takes while it runs.
#[derive(Debug)]
pub struct Settings {
    pub monitor: monitor::Config,
    pub claims: claims::Config,
    pub places: Places,
    /// Takes whether they are in force: where zones do not go with those drawn over the API none of them is.
    pub taken: oneshot::Sender<Result<(), pipeline::Error>>,
}

/// What a reload reads and changes.
pub struct Reload {
    /// In force.
    pub current: Config,
    pub path: Option<PathBuf>,
    pub logging: logging::Handle,
    pub webhooks: notify::Notifier,
    pub exports: export::Running,
    pub settings: mpsc::Sender<Settings>,
}

/// Waits for SIGTERM or SIGINT. On SIGHUP the config is reloaded; tables that only a restart can change are logged.
pub async fn until_stopped(mut reload: Reload) -> Result<()> {
    let mut terminate = signal(SignalKind::terminate())?;
    let mut interrupt = signal(SignalKind::interrupt())?;
    let mut hangup = signal(SignalKind::hangup())?;
    loop {
        tokio::select! {
            _ = terminate.recv() => return Ok(()),
            _ = interrupt.recv() => return Ok(()),
            _ = hangup.recv() => {
                let supervisor = Supervisor::default();
                supervisor.reloading();
                if let Err(error) = reload.run().await {
                    tracing::error!("the config is bad; nothing was changed: {error:#}");
                }
                supervisor.reloaded();
            }
        }
    }
}

impl Reload {
    /// Applies a changed config. All of it is checked before anything is changed, so that an invalid file changes nothing.
    async fn run(&mut self) -> Result<()> {
        let Some(path) = &self.path else {
            tracing::info!("there is no config file to read again");
            return Ok(());
        };
        let new = Config::load(path)?;
        new.monitor.validate()?;
        new.claims.validate()?;
        new.journal.validate()?;
        new.log.filter()?;
        let places = Places::of(&new)?;
        let mut endpoints = notify::load(&new.webhook)?;
        let exports = export::load(&new.export, &endpoints, &new.world)?;
        for warning in new.warnings(&new.camera()?) {
            tracing::warn!("{warning}");
        }
        let claims = claims::Config {
            // The origin changes with a restart only, as all of [world].
            axes: self.current.claims.axes,
            ..new.claims.clone()
        };
        let (taken, answer) = oneshot::channel();
        let settings = Settings {
            monitor: new.monitor.clone(),
            claims: claims.clone(),
            places,
            taken,
        };
        // An error would mean that the compute thread has ended, and with it the daemon.
        let _ = self.settings.send(settings).await;
        answer.await.unwrap_or(Ok(()))?;
        if new.log != self.current.log {
            self.logging.set(&new.log)?;
        }
        let changed = new.tables_that_differ(&self.current);
        endpoints.extend(self.exports.replace(exports));
        self.webhooks.replace(endpoints).await?;
        self.current.log = new.log.clone();
        self.current.monitor = new.monitor.clone();
        self.current.claims = claims;
        self.current.webhook = new.webhook.clone();
        self.current.zone = new.zone.clone();
        self.current.known_light = new.known_light.clone();
        self.current.maintenance = new.maintenance.clone();
        self.current.export = new.export.clone();
        let (fixed, changed): (Vec<_>, Vec<_>) = {
            let fixed = new.tables_that_differ(&self.current);
            changed.into_iter().partition(|table| fixed.contains(table))
        };
        tracing::info!(changed = changed.join(", "), "config re-read");
        if !fixed.is_empty() {
            tracing::warn!(
                tables = fixed.join(", "),
                "these tables of the config change with the next restart only"
            );
        }
        Ok(())
    }
}
