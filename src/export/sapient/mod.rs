//! SAPIENT (BSI Flex 335 v2.0): a sensor node that registers, reports its status and its detections, and raises alerts; the other side
//! acknowledges them. Over TCP or TLS.

mod frame;
mod ids;
mod message;
mod reports;
mod session;

use std::sync::{Arc, Mutex};
use std::time::Duration;

use futures_util::future::BoxFuture;
use tokio::sync::mpsc;
use tokio::time::Instant;

use super::address::Address;
use super::config::Config;
use super::link::Link;
use super::place::World;
use super::updates::{Context, Updates};
use crate::api::{Acknowledged, Command};
use crate::journal::{AuditAction, AuditEntry};
use crate::notify::{Channel, Clock, Failure, Message, Verdict};
use message::Content;
use reports::STATUS_EVERY;
use session::{Acknowledgement, Inner};

/// Emitters of one frame that are reported; more are a flood.
const MOST_EMITTERS: usize = 500;
/// Acknowledgements that wait for the compute thread; the connection is not read while they are so many.
const MOST_WAITING: usize = 64;

/// One SAPIENT node, as a client of the other side.
#[derive(Debug)]
pub(super) struct Sapient {
    inner: Arc<Inner>,
    /// What the other side acknowledged, until a round takes it.
    acknowledged: tokio::sync::Mutex<mpsc::Receiver<Acknowledgement>>,
    reported: tokio::sync::Mutex<Reported>,
    interval: Duration,
}

/// The reader of a connection holds what it reads for.
impl Drop for Sapient {
    fn drop(&mut self) {
        if let Ok(mut session) = self.inner.session.try_lock() {
            session.take();
        }
    }
}

/// What was reported last.
#[derive(Debug, Default)]
struct Reported {
    positions: u64,
    status_at: Option<Instant>,
    /// The alerts that were open at the start are known.
    is_resumed: bool,
}

impl Sapient {
    pub(super) fn new(
        config: &Config,
        address: &Address,
        name: String,
        station: String,
        world: World,
    ) -> Result<Self, String> {
        let (acknowledge, acknowledged) = mpsc::channel(MOST_WAITING);
        let interval = Duration::from_secs_f64(config.interval_s);
        let inner = Inner {
            link: Link::new(config, address)?,
            name,
            node_id: ids::uuid(&["oapwatch", &station]),
            station,
            world,
            interval,
            session: tokio::sync::Mutex::new(None),
            alerts: Mutex::default(),
            acknowledge,
            clock: Clock::wall(),
        };
        Ok(Self {
            inner: Arc::new(inner),
            acknowledged: tokio::sync::Mutex::new(acknowledged),
            reported: tokio::sync::Mutex::default(),
            interval,
        })
    }

    /// Has the compute thread acknowledge what the other side has, and writes it to the audit log.
    async fn pass_on(&self, context: &Context) -> Result<(), Failure> {
        let mut acknowledged = self.acknowledged.lock().await;
        while let Ok(Acknowledgement { id, by }) = acknowledged.try_recv() {
            let (reply, answer) = tokio::sync::oneshot::channel();
            let command = Command::Acknowledge {
                id: id.clone(),
                by: Some(by.clone()),
                note: None,
                reply,
            };
            let stopping = |()| Failure::Protocol("the daemon is stopping".to_owned());
            context.commands.send(command).await.map_err(|_| stopping(()))?;
            if let Acknowledged::Done(_) = answer.await.map_err(|_| stopping(()))? {
                let entry = AuditEntry {
                    action: AuditAction::Acknowledge,
                    actor: Some(by),
                    client: self.inner.link.to_string(),
                    target: Some(id),
                    detail: None,
                    count: 1,
                };
                context.journal.audit(entry, context.clock.now());
            }
        }
        Ok(())
    }
}

impl Channel for Sapient {
    fn deliver<'a>(&'a self, message: Message<'a>) -> BoxFuture<'a, Verdict> {
        Box::pin(async move {
            let alert = &message.event.event.alert;
            if !message.is_test {
                self.inner.note(alert);
            }
            let report = reports::alert(alert, message.is_test, &self.inner.world);
            let sent = self.inner.send([Content::Alert(report)], message.now).await;
            match sent {
                Ok(()) => Verdict::Delivered(None),
                Err(failure) => failure.into(),
            }
        })
    }
}

impl Updates for Sapient {
    fn interval(&self) -> Duration {
        self.interval
    }

    fn round<'a>(&'a self, context: &'a Context) -> BoxFuture<'a, Result<(), Failure>> {
        Box::pin(async move {
            let inner = &self.inner;
            let mut reported = self.reported.lock().await;
            if !reported.is_resumed {
                for alert in context.open_alerts(None).await? {
                    inner.note(&alert);
                }
                reported.is_resumed = true;
            }
            self.pass_on(context).await?;
            let now = context.clock.now();
            let latest = context.feed.latest();
            let mut contents = Vec::new();
            if reported.status_at.is_none_or(|at| at.elapsed() >= STATUS_EVERY) {
                let status = latest.as_ref().map(|latest| &latest.snapshot.status);
                let is_first = reported.status_at.is_none();
                contents.push(Content::StatusReport(reports::status(
                    status,
                    is_first,
                    &inner.world,
                    now,
                )));
            }
            let newer = latest.filter(|latest| latest.seq != reported.positions);
            if let Some(latest) = &newer {
                let started_at = latest.snapshot.status.started_at;
                let emitters = latest.snapshot.report.emitters.iter().take(MOST_EMITTERS);
                contents.extend(emitters.map(|emitter| {
                    Content::DetectionReport(reports::detection(emitter, latest.seq, started_at, &inner.world, now))
                }));
            }
            let has_status = contents
                .iter()
                .any(|content| matches!(content, Content::StatusReport(_)));
            inner.send(contents, now).await?;
            if has_status {
                reported.status_at = Some(Instant::now());
            }
            if let Some(latest) = newer {
                reported.positions = latest.seq;
            }
            Ok(())
        })
    }
}
