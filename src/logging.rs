//! Logging: text to a terminal, structured fields to journald, JSON to any other stderr.

use std::io::IsTerminal;
use std::sync::Arc;

use serde::{Deserialize, Serialize};
use tracing_appender::non_blocking::{NonBlockingBuilder, WorkerGuard};
use tracing_subscriber::filter::{LevelFilter, Targets};
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

/// Why `log.level` is no filter.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    #[error("log.level: expected a filter such as \"info,oapwatch::frames=debug\", found {level:?}: {source}")]
    Filter {
        level: String,
        source: tracing_subscriber::filter::ParseError,
    },
    #[error("log.level: expected {} or TARGET=LEVEL, found {found:?} in {level:?}", LEVELS.join(", "))]
    Level { level: String, found: String },
}

/// The levels, from nothing to everything.
const LEVELS: [&str; 6] = ["off", "error", "warn", "info", "debug", "trace"];

/// The target of the NATS client's own events.
const NATS_CLIENT: &str = "async_nats";
/// The target under which each refused certificate is an error of its own, without the name of whom it was for.
const CERTIFICATES: &str = "rustls_platform_verifier";

/// Lines that wait for a reader of stderr who stalls; further ones are lost, and nothing waits for them.
const WAITING: usize = 1 << 14;

/// Changes the level of a running daemon; with the last one what waits is written, if it can be within a second.
#[derive(Clone)]
pub struct Handle {
    level: reload::Handle<Targets, Registry>,
    _stderr: Arc<WorkerGuard>,
}

impl Config {
    /// The filter that `level` describes.
    ///
    /// # Errors
    /// A directive without a known level.
    pub fn filter(&self) -> Result<Targets, Error> {
        // `Targets` takes an unknown word for a target, and then logs nothing else.
        let directives = self.level.split(',').map(str::trim);
        let level_of = |directive: &str| {
            directive
                .rsplit_once('=')
                .map_or(directive, |(_, level)| level)
                .trim()
                .to_lowercase()
        };
        if let Some(found) = directives.clone().find(|d| !LEVELS.contains(&level_of(d).as_str())) {
            return Err(Error::Level {
                level: self.level.clone(),
                found: found.to_owned(),
            });
        }
        let filter: Targets = self.level.parse().map_err(|source| Error::Filter {
            level: self.level.clone(),
            source,
        })?;
        // Every attempt to reach a server would be a line: those who connect say when it is gone, and why.
        let quiet = [(NATS_CLIENT, LevelFilter::WARN), (CERTIFICATES, LevelFilter::OFF)];
        let is_usual = filter.default_level() == Some(LevelFilter::INFO);
        let quiet = quiet
            .into_iter()
            .filter(|(target, _)| is_usual && !self.level.contains(target));
        Ok(filter.with_targets(quiet))
    }
}

/// Installs the process's subscriber; called once by `run`.
pub fn install(config: &Config) -> Result<Handle, Error> {
    let filter = match std::env::var("OAPWATCH_LOG") {
        Ok(level) => Config { level }.filter()?,
        Err(_) => config.filter()?,
    };
    let (filter, level) = reload::Layer::new(filter);
    let (stderr, guard) = NonBlockingBuilder::default()
        .buffered_lines_limit(WAITING)
        .thread_name("log")
        .finish(std::io::stderr());
    // systemd sets JOURNAL_STREAM when our stderr is the journal.
    let journald = std::env::var_os("JOURNAL_STREAM").and_then(|_| tracing_journald::layer().ok());
    let output: Box<dyn Layer<_> + Send + Sync> = match journald {
        Some(layer) => layer.boxed(),
        None if std::io::stderr().is_terminal() => tracing_subscriber::fmt::layer()
            .with_writer(stderr)
            .with_target(false)
            .boxed(),
        None => tracing_subscriber::fmt::layer()
            .json()
            .flatten_event(true)
            .with_writer(stderr)
            .boxed(),
    };
    tracing_subscriber::registry().with(filter).with(output).init();
    Ok(Handle {
        level,
        _stderr: Arc::new(guard),
    })
}

impl Handle {
    pub fn set(&self, config: &Config) -> Result<(), Error> {
        let filter = config.filter()?;
        if std::env::var_os("OAPWATCH_LOG").is_none() {
            self.level
                .reload(filter)
                .expect("the subscriber lives as long as the process");
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_directive_needs_a_known_level() {
        let filter = |level: &str| {
            Config {
                level: level.to_owned(),
            }
            .filter()
        };
        for good in [
            "info",
            "WARN",
            "off",
            "info,oapwatch::frames=debug",
            "warn,oapwatch::api=trace,oapwatch::frames=off",
        ] {
            filter(good).unwrap_or_else(|e| panic!("{good}: {e}"));
        }
        for bad in [
            "loud",
            "",
            "info,oapwatch::frames",
            "info,oapwatch::frames=loud",
            "info,,warn",
        ] {
            let error = filter(bad).expect_err(bad).to_string();
            assert!(error.starts_with("log.level: expected"), "{error}");
        }
    }

    #[test]
    fn the_nats_client_speaks_where_it_is_asked_to() {
        let says = |level: &str| {
            let config = Config {
                level: level.to_owned(),
            };
            config
                .filter()
                .unwrap()
                .would_enable(NATS_CLIENT, &tracing::Level::INFO)
        };
        assert!(!says("info") && !says("warn") && !says("off") && !says("info,oapwatch::frames=debug"));
        assert!(says("debug") && says("info,async_nats=info"));
    }
}
