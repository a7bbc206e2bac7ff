//! Signals: stop the daemon, or reload the config.

use std::path::Path;

use anyhow::Result;
use tokio::signal::unix::{SignalKind, signal};

use super::supervisor::Supervisor;
use crate::config::Config;
use crate::logging;

/// Waits for SIGTERM or SIGINT. On SIGHUP the config is reloaded; tables that only a restart can change are logged.
pub async fn until_stopped(config: &Config, path: Option<&Path>, logging: &logging::Handle) -> Result<()> {
    let mut terminate = signal(SignalKind::terminate())?;
    let mut interrupt = signal(SignalKind::interrupt())?;
    let mut hangup = signal(SignalKind::hangup())?;
    let mut current = config.clone();
    loop {
        tokio::select! {
            _ = terminate.recv() => return Ok(()),
            _ = interrupt.recv() => return Ok(()),
            _ = hangup.recv() => {
                let supervisor = Supervisor::default();
                supervisor.reloading();
                match path {
                    Some(path) => reload(&mut current, path, logging),
                    None => tracing::info!("there is no config file to read again"),
                }
                supervisor.reloaded();
            }
        }
    }
}

/// Applies a changed config; an invalid file changes nothing.
fn reload(current: &mut Config, path: &Path, logging: &logging::Handle) {
    let new = match Config::load(path) {
        Ok(new) => new,
        Err(error) => return tracing::error!(%error, "the config is bad; nothing was changed"),
    };
    if new.log != current.log {
        match logging.set(&new.log) {
            Ok(()) => tracing::info!(level = new.log.level, "log level changed"),
            Err(error) => return tracing::error!(%error, "the config is bad; nothing was changed"),
        }
        current.log = new.log.clone();
    }
    let fixed = new.tables_that_differ(current);
    if fixed.is_empty() {
        tracing::info!("config re-read");
    } else {
        tracing::warn!(
            tables = fixed.join(", "),
            "config re-read; these tables change with the next restart only"
        );
    }
}
