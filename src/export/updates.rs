//! What exports send beside alert events: the latest positions, and open alerts again. Never queued: what cannot be sent now is replaced by
//! what is newer.

use std::fmt;
use std::sync::Arc;
use std::time::Duration;

use futures_util::future::BoxFuture;
use metrics::counter;
use tokio::sync::mpsc;

use crate::api::{Command, Feed};
use crate::journal::{self, Journal};
use crate::metric;
use crate::monitor::{Alert, AlertKind};
use crate::notify::{Clock, Failure};

/// Open alerts are sent again this often, for receivers that forget them: Prometheus does so every minute.
pub(super) const RESEND: Duration = Duration::from_secs(60);
/// Longest pause after a failure; each is twice as long as the one before.
const LONGEST_PAUSE: Duration = Duration::from_secs(60);

/// Sends updates round by round.
pub trait Updates: Send + Sync + fmt::Debug {
    /// From the end of a round to the start of the next.
    fn interval(&self) -> Duration;

    /// Sends what is the latest now. Dropped when its time is over.
    fn round<'a>(&'a self, context: &'a Context) -> BoxFuture<'a, Result<(), Failure>>;
}

/// Where updates come from, and where what a receiver says goes.
#[derive(Clone)]
pub struct Context {
    pub journal: Journal,
    pub feed: Arc<Feed>,
    /// To the compute thread.
    pub commands: mpsc::Sender<Command>,
    pub clock: Clock,
}

impl Context {
    /// Alerts that are not cleared, of these kinds (`None` is all).
    pub(super) async fn open_alerts(&self, kinds: Option<&[AlertKind]>) -> Result<Vec<Alert>, Failure> {
        let journal = self.journal.clone();
        let read = tokio::task::spawn_blocking(move || journal.open_alerts()).await;
        let mut alerts = read
            .unwrap_or(Err(journal::Error::Panicked))
            .map_err(Failure::Journal)?;
        alerts.retain(|alert| kinds.is_none_or(|kinds| kinds.contains(&alert.kind)));
        Ok(alerts)
    }
}

/// Runs round after round; one that takes longer than `timeout` has failed.
pub(super) async fn run(name: String, updates: Arc<dyn Updates>, timeout: Duration, context: Context) {
    let mut pause = updates.interval();
    let mut is_failing = false;
    loop {
        let round = tokio::time::timeout(timeout, updates.round(&context)).await;
        let outcome = round.unwrap_or(Err(Failure::Timeout));
        let word = if outcome.is_ok() { "sent" } else { "failed" };
        counter!(metric::EXPORT_UPDATES, "endpoint" => name.clone(), "outcome" => word).increment(1);
        match (&outcome, is_failing) {
            (Ok(()), true) => tracing::info!(endpoint = name, "updates reach the export's receiver again"),
            (Err(error), false) => {
                tracing::warn!(endpoint = name, %error, "updates do not reach the export's receiver");
            }
            _ => {}
        }
        is_failing = outcome.is_err();
        pause = match is_failing {
            true => (2 * pause).min(LONGEST_PAUSE),
            false => updates.interval(),
        };
        tokio::time::sleep(pause).await;
    }
}
