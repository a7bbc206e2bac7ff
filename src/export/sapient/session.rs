//! One connection: registration, what is written, and what the other side says.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use jiff::Timestamp;
use metrics::counter;
use tokio::io::{AsyncWriteExt, BufReader, ReadHalf, WriteHalf};
use tokio::sync::mpsc;
use tokio::task::JoinHandle;

use super::message::{AlertAckStatus, AlertStatus, Content, SapientMessage, TaskAck, TaskStatus};
use super::{frame, reports};
use crate::claim::escape_undisplayable;
use crate::export::link::{Duplex, Link};
use crate::export::place::World;
use crate::metric;
use crate::monitor::{Alert, AlertState};
use crate::notify::{Clock, Failure};

/// Messages that may come before the answer to a registration.
const MOST_BEFORE_ANSWER: usize = 100;

/// Alerts that an acknowledgement is known for; beyond them the other side acknowledges in vain.
const MOST_ALERTS: usize = 10_000;
/// The answer to a task waits no longer for a side that does not read.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(1);

type Stream = Box<dyn Duplex>;
type Reading = BufReader<ReadHalf<Stream>>;

/// What a node knows, shared with the reader of its connection.
#[derive(Debug)]
pub(super) struct Inner {
    pub(super) link: Link,
    pub(super) name: String,
    pub(super) station: String,
    pub(super) node_id: String,
    pub(super) world: World,
    pub(super) interval: Duration,
    pub(super) session: tokio::sync::Mutex<Option<Session>>,
    pub(super) alerts: Mutex<HashMap<String, Known>>,
    pub(super) acknowledge: mpsc::Sender<Acknowledgement>,
    pub(super) clock: Clock,
}

/// An alert that the other side may acknowledge.
#[derive(Clone, Debug)]
pub(super) struct Known {
    pub(super) id: String,
    pub(super) is_acknowledged: bool,
}

/// That the other side took note of an alert.
#[derive(Debug)]
pub(super) struct Acknowledgement {
    pub(super) id: String,
    pub(super) by: String,
}

impl Inner {
    pub(super) fn alerts(&self) -> std::sync::MutexGuard<'_, HashMap<String, Known>> {
        self.alerts.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(super) fn note(&self, alert: &Alert) {
        let ulid = reports::alert_id(alert);
        let mut alerts = self.alerts();
        if alert.state == AlertState::Cleared {
            alerts.remove(&ulid);
        } else if alerts.len() < MOST_ALERTS || alerts.contains_key(&ulid) {
            let known = Known {
                id: alert.id.clone(),
                is_acknowledged: alert.state == AlertState::Acknowledged,
            };
            alerts.insert(ulid, known);
        }
    }

    pub(super) fn wrap(&self, content: Content, now: Timestamp) -> SapientMessage {
        SapientMessage {
            timestamp: Some(reports::timestamp(now)),
            node_id: Some(self.node_id.clone()),
            destination_id: None,
            content: Some(content),
        }
    }
}

/// A connection on which the registration was accepted.
#[derive(Debug)]
pub(super) struct Session {
    writing: WriteHalf<Stream>,
    reader: JoinHandle<()>,
}

impl Drop for Session {
    fn drop(&mut self) {
        self.reader.abort();
    }
}

impl Inner {
    /// Sends these, over a new connection where there is none. When it fails, or is dropped half-way, the connection is given up.
    pub(super) async fn send(
        self: &Arc<Self>,
        contents: impl IntoIterator<Item = Content>,
        now: Timestamp,
    ) -> Result<(), Failure> {
        let mut place = self.session.lock().await;
        let alive = place.take().filter(|session| !session.reader.is_finished());
        let mut session = match alive {
            Some(session) => session,
            None => self.open(now).await?,
        };
        for content in contents {
            let bytes = frame::encode(&self.wrap(content, now));
            session.writing.write_all(&bytes).await.map_err(Failure::Interrupted)?;
        }
        session.writing.flush().await.map_err(Failure::Interrupted)?;
        *place = Some(session);
        Ok(())
    }

    /// Connects and registers.
    async fn open(self: &Arc<Self>, now: Timestamp) -> Result<Session, Failure> {
        let stream = self.link.connect().await.map_err(Failure::Unreachable)?;
        let (reading, mut writing) = tokio::io::split(stream);
        let mut reading = BufReader::new(reading);
        let registration = reports::registration(&self.station, self.interval);
        let bytes = frame::encode(&self.wrap(Content::Registration(registration), now));
        writing.write_all(&bytes).await.map_err(Failure::Interrupted)?;
        writing.flush().await.map_err(Failure::Interrupted)?;
        self.await_acceptance(&mut reading).await?;
        Ok(Session {
            writing,
            reader: tokio::spawn(self.clone().listen(reading)),
        })
    }

    async fn await_acceptance(&self, reading: &mut Reading) -> Result<(), Failure> {
        for _ in 0..MOST_BEFORE_ANSWER {
            let read = frame::read(reading).await;
            let message = read.map_err(|e| Failure::Protocol(e.to_string()))?;
            let Some(Content::RegistrationAck(answer)) = message.and_then(|message| message.content) else {
                continue;
            };
            if answer.acceptance == Some(true) {
                return Ok(());
            }
            let reasons: String = answer.ack_response_reason.join("; ").chars().take(200).collect();
            let text = format!(
                "the other side refuses our registration: {}",
                escape_undisplayable(&reasons)
            );
            return Err(Failure::Protocol(text));
        }
        Err(Failure::Protocol(
            "the other side does not answer our registration".to_owned(),
        ))
    }

    /// Reads until the other side closes the connection or cannot be understood, and then closes it.
    async fn listen(self: Arc<Self>, reading: Reading) {
        self.hear(reading).await;
        let mut place = self.session.lock().await;
        if place.as_ref().is_some_and(|s| s.reader.id() == tokio::task::id()) {
            place.take();
        }
    }

    /// Waits for nobody but the compute thread, by way of a bounded queue.
    async fn hear(self: &Arc<Self>, mut reading: Reading) {
        loop {
            let message = match frame::read(&mut reading).await {
                Ok(Some(message)) => message,
                Ok(None) => {
                    self.count("malformed");
                    continue;
                }
                Err(error) => {
                    if matches!(error, frame::ReadError::TooLong(_)) {
                        self.count("oversized");
                    }
                    tracing::info!(endpoint = self.name, %error, "a SAPIENT connection ended");
                    return;
                }
            };
            let by = message.node_id.unwrap_or_default();
            match message.content {
                Some(Content::AlertAck(ack)) if ack.alert_ack_status == Some(AlertAckStatus::Accepted as i32) => {
                    self.heard(ack.alert_id, &by).await;
                }
                Some(Content::Alert(alert)) if alert.status == Some(AlertStatus::Acknowledge as i32) => {
                    self.heard(alert.alert_id, &by).await;
                }
                Some(Content::Task(task)) => self.refuse(task.task_id).await,
                Some(Content::Error(error)) => {
                    self.count("error");
                    let text: String = error.error_message.join("; ").chars().take(200).collect();
                    let text = escape_undisplayable(&text).into_owned();
                    tracing::debug!(endpoint = self.name, text, "the SAPIENT node reports an error");
                }
                _ => self.count("ignored"),
            }
        }
    }

    /// Takes the acknowledgement of an alert. One of an alert that is not known, or acknowledged already, costs nothing further.
    async fn heard(&self, alert: Option<String>, by: &str) {
        let id = {
            let mut alerts = self.alerts();
            let known = alert.and_then(|ulid| alerts.get_mut(&ulid));
            match known {
                None => {
                    drop(alerts);
                    return self.count("unknown_alert");
                }
                Some(known) if known.is_acknowledged => {
                    drop(alerts);
                    return self.count("repeated");
                }
                Some(known) => {
                    known.is_acknowledged = true;
                    known.id.clone()
                }
            }
        };
        self.count("acknowledged");
        let node: String = by.chars().filter(char::is_ascii_graphic).take(36).collect();
        let by = format!("sapient {node}");
        // An error would mean that the export was removed.
        let _ = self.acknowledge.send(Acknowledgement { id, by }).await;
    }

    /// We take no tasks.
    async fn refuse(self: &Arc<Self>, task: Option<String>) {
        self.count("task");
        let answer = TaskAck {
            task_id: task,
            task_status: Some(TaskStatus::Rejected as i32),
            reason: vec!["oapwatch takes no tasks".to_owned()],
        };
        let bytes = frame::encode(&self.wrap(Content::TaskAck(answer), self.clock.now()));
        // A connection that is busy being written to has no room for an answer.
        if let Ok(mut place) = self.session.try_lock()
            && let Some(mut session) = place.take()
            && let Ok(Ok(())) = tokio::time::timeout(ANSWER_TIMEOUT, session.writing.write_all(&bytes)).await
        {
            *place = Some(session);
        }
    }

    fn count(&self, outcome: &'static str) {
        counter!(metric::EXPORT_HEARD, "endpoint" => self.name.clone(), "outcome" => outcome).increment(1);
    }
}
