//! What the handlers work with, and the commands they send to the compute thread.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use axum::http::StatusCode;
use metrics_exporter_prometheus::PrometheusHandle;
use tokio::sync::{mpsc, oneshot, watch};

use super::audit::Audit;
use super::background::Background;
use super::evidence_fit::Fitter;
use super::feed::Feed;
use super::picture_cache::PictureCache;
use super::problem::Problem;
use crate::claim::Claim;
use crate::estimate;
use crate::frames::record;
use crate::geo::LocalAxes;
use crate::journal::Journal;
use crate::monitor::zones::{Zone, ZoneError, ZoneMap};
use crate::monitor::{Alert, KnownLight, KnownLightStatus, LightError, LightRequest, MaintenanceError, Window};
use crate::notify::Notifier;

/// What the handlers work with. The daemon builds it; cloning is cheap.
#[derive(Clone)]
pub struct State {
    pub feed: Arc<Feed>,
    /// To the compute thread. A full queue means overload: the client gets 503 with `Retry-After`.
    pub commands: mpsc::Sender<Command>,
    pub journal: Journal,
    pub metrics: PrometheusHandle,
    /// The model is loaded and the pipeline runs; `/readyz` asks for good frames besides.
    pub ready: Arc<AtomicBool>,
    /// Webhook status and replay; none where no webhook is configured.
    pub(super) notifier: Option<Notifier>,
    pub(super) pictures: Arc<PictureCache>,
    pub(super) audit: Audit,
    /// The recorder's folder for evidence, where frames are recorded.
    pub(super) evidence: Option<Arc<Path>>,
    pub(super) fitter: Arc<Fitter>,
    /// The local axes on the earth, for posted claims in latitude and longitude.
    pub(super) axes: Option<LocalAxes>,
    /// Whether places may be known on the earth: there is an origin, or this is a hub, whose stations have their own.
    pub(super) has_latitudes: bool,
    /// What lies below the page's map.
    pub(super) background: Option<Arc<Background>>,
    /// Turns true when the server stops: streams then close.
    pub(super) stopping: watch::Sender<bool>,
}

impl State {
    pub fn new(
        feed: Arc<Feed>,
        commands: mpsc::Sender<Command>,
        journal: Journal,
        metrics: PrometheusHandle,
        ready: Arc<AtomicBool>,
    ) -> Self {
        Self {
            feed,
            commands,
            audit: Audit::new(journal.clone()),
            evidence: None,
            fitter: Arc::new(Fitter::new(estimate::Config::default())),
            journal,
            metrics,
            ready,
            axes: None,
            has_latitudes: false,
            background: None,
            notifier: None,
            pictures: Arc::default(),
            stopping: watch::Sender::new(false),
        }
    }

    /// `folder` is the recorder's; `estimator` explains what it recorded.
    pub fn with_evidence(mut self, folder: &Path, estimator: &estimate::Config) -> Self {
        self.fitter = Arc::new(Fitter::new(estimator.clone()));
        self.evidence = Some(folder.join(record::EVIDENCE).into());
        self
    }

    /// Asks the compute thread and waits for its answer; a full queue is overload.
    pub(super) async fn ask<T>(&self, command: impl FnOnce(oneshot::Sender<T>) -> Command) -> Result<T, Problem> {
        let (reply, answer) = oneshot::channel();
        self.commands.try_send(command(reply)).map_err(|e| match e {
            mpsc::error::TrySendError::Full(_) => busy(),
            mpsc::error::TrySendError::Closed(_) => {
                Problem::later(StatusCode::SERVICE_UNAVAILABLE, 5, "the monitor is stopping")
            }
        })?;
        answer.await.map_err(|_| busy())
    }

    pub fn with_axes(mut self, axes: Option<LocalAxes>) -> Self {
        self.axes = axes;
        self.has_latitudes = axes.is_some();
        self
    }

    pub fn with_background(mut self, background: Option<Background>) -> Self {
        self.background = background.map(Arc::new);
        self
    }

    /// The API of a hub: places are those of its stations.
    pub fn of_hub(mut self) -> Self {
        self.has_latitudes = true;
        self
    }

    pub fn with_webhooks(mut self, notifier: Notifier) -> Self {
        self.notifier = Some(notifier);
        self
    }
}

pub(super) fn busy() -> Problem {
    let detail = "the monitor is too busy to take this now";
    Problem::later(StatusCode::SERVICE_UNAVAILABLE, 1, detail)
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
        /// Name of the operator's token.
        by: Option<String>,
        note: Option<String>,
        reply: oneshot::Sender<Acknowledged>,
    },
    Unacknowledge {
        id: String,
        by: Option<String>,
        reply: oneshot::Sender<Acknowledged>,
    },
    KnownLights {
        reply: oneshot::Sender<Vec<KnownLightStatus>>,
    },
    /// The compute thread sets the request's time.
    Approve {
        request: LightRequest,
        reply: oneshot::Sender<Result<KnownLight, LightError>>,
    },
    Revoke {
        id: String,
        reply: oneshot::Sender<Result<KnownLight, LightError>>,
    },
    Zones {
        reply: oneshot::Sender<ZoneMap>,
    },
    PutZones {
        zones: Vec<Zone>,
        /// Digest of the zones that the operator has changed; none to change whatever is in force.
        unless_changed: Option<u64>,
        reply: oneshot::Sender<Result<ZoneMap, ZonesRefused>>,
    },
    Maintenance {
        reply: oneshot::Sender<Vec<Window>>,
    },
    /// A window that begins when the compute thread takes it, unless `from` says otherwise.
    BeginMaintenance {
        from: Option<jiff::Timestamp>,
        until: jiff::Timestamp,
        by: String,
        note: Option<String>,
        reply: oneshot::Sender<Result<Window, MaintenanceError>>,
    },
    EndMaintenance {
        id: String,
        reply: oneshot::Sender<Result<Window, MaintenanceError>>,
    },
}

/// Why zones were not put in force.
#[derive(Debug)]
pub enum ZonesRefused {
    Bad(ZoneError),
    /// Somebody else has changed them meanwhile.
    Changed,
    AtHub,
}

/// Outcome of an acknowledgement or its withdrawal. Asking twice is no error.
#[derive(Debug)]
pub enum Acknowledged {
    Done(Box<Alert>),
    Unknown,
    AlreadyCleared,
}
