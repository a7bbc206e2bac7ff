//! Where log lines go: human to a terminal, structured to journald or, elsewhere, JSON on stderr.

use std::io::IsTerminal;

use serde::{Deserialize, Serialize};
use tracing_subscriber::filter::Targets;
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::util::SubscriberInitExt;
use tracing_subscriber::{Layer, Registry, reload};

/// `[log]`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// "error", "warn", "info", "debug", "trace", or a filter such as "info,oapwatch::frames=debug".
    /// The environment variable `OAPWATCH_LOG` wins over it. Changes live on reload.
    pub level: String,
}

impl Default for Config {
    fn default() -> Self {
        Self { level: "info".into() }
    }
}

#[derive(Debug, thiserror::Error)]
#[error("log.level: expected a level or filter such as \"info,oapwatch::frames=debug\", found {level:?}: {source}")]
pub struct Error {
    level: String,
    source: tracing_subscriber::filter::ParseError,
}

/// Changes the level of a running daemon.
#[derive(Clone)]
pub struct Handle(reload::Handle<Targets, Registry>);

impl Config {
    pub fn filter(&self) -> Result<Targets, Error> {
        self.level.parse().map_err(|source| Error {
            level: self.level.clone(),
            source,
        })
    }
}

/// Installs the process's subscriber; called once by `run`.
pub fn install(config: &Config) -> Result<Handle, Error> {
    let filter = match std::env::var("OAPWATCH_LOG") {
        Ok(level) => Config { level }.filter()?,
        Err(_) => config.filter()?,
    };
    let (filter, handle) = reload::Layer::new(filter);
    // systemd sets JOURNAL_STREAM when our stderr is the journal.
    let journald = std::env::var_os("JOURNAL_STREAM").and_then(|_| tracing_journald::layer().ok());
    let output: Box<dyn Layer<_> + Send + Sync> = match journald {
        Some(layer) => layer.boxed(),
        None if std::io::stderr().is_terminal() => tracing_subscriber::fmt::layer()
            .with_writer(std::io::stderr)
            .with_target(false)
            .boxed(),
        None => tracing_subscriber::fmt::layer()
            .json()
            .flatten_event(true)
            .with_writer(std::io::stderr)
            .boxed(),
    };
    tracing_subscriber::registry().with(filter).with(output).init();
    Ok(Handle(handle))
}

impl Handle {
    pub fn set(&self, config: &Config) -> Result<(), Error> {
        let filter = config.filter()?;
        if std::env::var_os("OAPWATCH_LOG").is_none() {
            self.0
                .reload(filter)
                .expect("the subscriber lives as long as the process");
        }
        Ok(())
    }
}
