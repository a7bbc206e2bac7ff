use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use jiff::Timestamp;
use metrics_exporter_prometheus::PrometheusHandle;
use tokio::sync::{mpsc, oneshot, watch};

use super::feed::{Event, Feed};
use super::frame::Pictures;
use crate::claim::Claim;
use crate::monitor::{Alert, AlertKind, AlertState};

/// What the handlers work with. The daemon builds it; cloning is cheap.
#[derive(Clone)]
pub struct State {
    pub feed: Arc<Feed>,
    /// To the compute thread. Full means overload: the client is told to come back.
    pub commands: mpsc::Sender<Command>,
    pub alerts: Arc<dyn AlertStore>,
    pub metrics: PrometheusHandle,
    /// The model is loaded and the pipeline runs; `/readyz` asks for good frames besides.
    pub ready: Arc<AtomicBool>,
    pub(super) pictures: Arc<Pictures>,
    /// Turns true when the server stops, for streams to say goodbye.
    pub(super) stopping: watch::Sender<bool>,
}

impl State {
    pub fn new(
        feed: Arc<Feed>,
        commands: mpsc::Sender<Command>,
        alerts: Arc<dyn AlertStore>,
        metrics: PrometheusHandle,
        ready: Arc<AtomicBool>,
    ) -> Self {
        Self {
            feed,
            commands,
            alerts,
            metrics,
            ready,
            pictures: Arc::default(),
            stopping: watch::Sender::new(false),
        }
    }
}

/// What a client may ask of the compute thread.
#[derive(Debug)]
pub enum Command {
    Claims {
        claims: Vec<Claim>,
        /// Refused claims: index and reason.
        reply: oneshot::Sender<Vec<(usize, String)>>,
    },
    Acknowledge {
        id: String,
        reply: oneshot::Sender<Acknowledged>,
    },
}

/// Outcome of an acknowledgement. Acknowledging twice is no error.
#[derive(Debug)]
pub enum Acknowledged {
    Done(Box<Alert>),
    Unknown,
    AlreadyCleared,
}

/// The alerts of the past and the present, as the journal keeps them. Calls may block on the disk.
pub trait AlertStore: Send + Sync + 'static {
    /// Alerts that answer to `query`, newest first.
    fn list(&self, query: &AlertQuery) -> Result<Vec<Alert>, StoreError>;

    fn get(&self, id: &str) -> Result<Option<Alert>, StoreError>;

    /// Events numbered above `after` up to `until`, in order, `limit` at most.
    fn events(&self, after: u64, until: u64, limit: usize) -> Result<Vec<Event>, StoreError>;
}

/// Which alerts to list.
#[derive(Clone, Debug, Default)]
pub struct AlertQuery {
    pub state: Option<AlertState>,
    pub kind: Option<AlertKind>,
    /// Raised at this time or later.
    pub since: Option<Timestamp>,
    /// Older than this alert: raised earlier, or at the same time with a smaller id.
    pub before: Option<(Timestamp, String)>,
    pub limit: usize,
}

/// The journal could not be read.
#[derive(Debug, thiserror::Error)]
#[error("the journal cannot be read: {0}")]
pub struct StoreError(#[from] pub Box<dyn std::error::Error + Send + Sync>);
