//! Cursor on Target: emitters and alerts as events for TAK, over UDP (multicast too), TCP and TLS.

use std::time::Duration;

use futures_util::future::BoxFuture;
use jiff::{SignedDuration, Timestamp};
use quick_xml::escape::escape;
use tokio::sync::Mutex;
use tokio::time::Instant;

use super::address::Address;
use super::config::Config;
use super::link::Link;
use super::place::{Place, World};
use super::updates::{Context, RESEND, Updates};
use super::words::{sentence, title, track};
use crate::claim::escape_undisplayable;
use crate::monitor::{Alert, AlertEventKind, AlertKind, PositionStatus, TrackedPosition};
use crate::notify::{Channel, Failure, Message, Verdict};
use crate::word::word;

/// An emitter goes stale after so many of its own updates have failed to come, and not before five seconds.
const STALE_UPDATES: f64 = 3.0;
const SHORTEST_STALE_S: f64 = 5.0;
/// An alert goes stale when it has not been sent again twice.
const ALERT_STALE: SignedDuration = SignedDuration::from_secs(2 * RESEND.as_secs() as i64 + 30);
/// An error that is not known (event schema 2.0).
const UNKNOWN_M: f64 = 9_999_999.0;
/// Emitters of one frame that are sent; more are a flood that no map shows.
const MOST_EMITTERS: usize = 500;
/// Something in doubt on the ground; a marker; the removal of another event.
const SUSPECT: &str = "a-s-G";
const MARKER: &str = "b-m-p-s-m";
const REMOVAL: &str = "t-x-d-d";

/// One receiver of events.
#[derive(Debug)]
pub(super) struct Cot {
    link: Link,
    station: String,
    world: World,
    kinds: Option<Vec<AlertKind>>,
    interval: Duration,
    /// Alerts in one order: one that is over is not sent again after its removal.
    turn: Mutex<()>,
    shown: Mutex<Shown>,
}

/// What was sent last.
#[derive(Debug, Default)]
struct Shown {
    /// Of the feed.
    positions: u64,
    alerts_at: Option<Instant>,
}

/// One event.
struct Event<'a> {
    uid: String,
    kind: &'a str,
    time: Timestamp,
    stale: SignedDuration,
    place: Place,
    callsign: String,
    remarks: String,
    /// Elements of the detail, as XML.
    detail: String,
}

impl Cot {
    pub(super) fn new(config: &Config, address: &Address, station: String, world: World) -> Result<Self, String> {
        Ok(Self {
            link: Link::new(config, address)?,
            station,
            world,
            kinds: config.kinds.clone(),
            interval: Duration::from_secs_f64(config.interval_s),
            turn: Mutex::new(()),
            shown: Mutex::default(),
        })
    }

    fn of_emitter(&self, emitter: &TrackedPosition, now: Timestamp) -> String {
        let user = emitter.user.as_deref().map(escape_undisplayable);
        let verdict = word(emitter.status);
        Event {
            uid: format!("oapwatch.{}.beam-{}", self.station, track(emitter)),
            kind: match emitter.status {
                PositionStatus::Verified => "a-f-G",
                PositionStatus::Known | PositionStatus::Ignored => "a-n-G",
                PositionStatus::Pending => "a-p-G",
                PositionStatus::Mismatch | PositionStatus::Unclaimed => SUSPECT,
            },
            time: now,
            stale: SignedDuration::from_secs_f64((STALE_UPDATES * self.interval.as_secs_f64()).max(SHORTEST_STALE_S)),
            place: self.world.on_ellipsoid(self.world.emitter(emitter)),
            callsign: user.map_or(format!("beam {}", track(emitter)), |user| user.into_owned()),
            remarks: format!("{verdict}, {:.3e} J a frame", emitter.energy_j),
            detail: String::new(),
        }
        .xml()
    }

    fn alert_uid(&self, alert: &Alert) -> String {
        format!("oapwatch.{}.alert.{}", self.station, alert.id)
    }

    fn of_alert(&self, alert: &Alert, now: Timestamp) -> String {
        let place = self.world.on_ellipsoid(self.world.alert(alert));
        Event {
            uid: self.alert_uid(alert),
            kind: if alert.x_m.is_some() { SUSPECT } else { MARKER },
            time: now,
            stale: ALERT_STALE,
            place,
            callsign: title(alert),
            remarks: format!("{}, {}, {}", sentence(alert), word(alert.severity), word(alert.state)),
            detail: String::new(),
        }
        .xml()
    }

    /// Takes the alert's event from the map.
    fn removal(&self, alert: &Alert, now: Timestamp) -> String {
        let uid = self.alert_uid(alert);
        Event {
            uid: format!("{uid}.removal"),
            kind: REMOVAL,
            time: now,
            stale: SignedDuration::from_secs(60),
            place: self.world.on_ellipsoid(self.world.alert(alert)),
            callsign: title(alert),
            remarks: format!("{}: cleared", sentence(alert)),
            detail: format!(
                "<link uid=\"{}\" relation=\"none\" type=\"none\"/><__forcedelete/>",
                escape(&uid)
            ),
        }
        .xml()
    }

    fn test(&self, now: Timestamp) -> String {
        Event {
            uid: format!("oapwatch.{}.test", self.station),
            kind: MARKER,
            time: now,
            stale: SignedDuration::from_secs(60),
            place: self.world.on_ellipsoid(self.world.origin()),
            callsign: "oapwatch test".to_owned(),
            remarks: "a test event; no alert stands behind it".to_owned(),
            detail: String::new(),
        }
        .xml()
    }
}

impl Event<'_> {
    fn xml(&self) -> String {
        let at = |time: Timestamp| format!("{time:.3}");
        let stale = self.time.saturating_add(self.stale).unwrap_or(Timestamp::MAX);
        let metres = |error: Option<f64>| error.unwrap_or(UNKNOWN_M).min(UNKNOWN_M);
        format!(
            "<?xml version=\"1.0\" encoding=\"UTF-8\" standalone=\"yes\"?>\
             <event version=\"2.0\" uid=\"{}\" type=\"{}\" time=\"{time}\" start=\"{time}\" stale=\"{}\" how=\"m-p\">\
             <point lat=\"{:.8}\" lon=\"{:.8}\" hae=\"{:.2}\" ce=\"{:.2}\" le=\"{:.2}\"/>\
             <detail><contact callsign=\"{}\"/><remarks>{}</remarks>{}</detail></event>",
            escape(&self.uid),
            self.kind,
            at(stale),
            self.place.latitude_deg,
            self.place.longitude_deg,
            self.place.height_m,
            metres(self.place.horizontal_sigma_m),
            metres(self.place.vertical_sigma_m),
            escape(&self.callsign),
            escape(&self.remarks),
            self.detail,
            time = at(self.time),
        )
    }
}

impl Channel for Cot {
    fn deliver<'a>(&'a self, message: Message<'a>) -> BoxFuture<'a, Verdict> {
        Box::pin(async move {
            let _turn = self.turn.lock().await;
            let event = &message.event.event;
            let text = match event.event {
                _ if message.is_test => self.test(message.now),
                AlertEventKind::Cleared => self.removal(&event.alert, message.now),
                _ => self.of_alert(&event.alert, message.now),
            };
            match self.link.send(text.as_bytes()).await {
                Ok(()) => Verdict::Delivered(None),
                Err(failure) => failure.into(),
            }
        })
    }
}

impl Updates for Cot {
    fn interval(&self) -> Duration {
        self.interval
    }

    fn round<'a>(&'a self, context: &'a Context) -> BoxFuture<'a, Result<(), Failure>> {
        Box::pin(async move {
            let now = context.clock.now();
            let mut shown = self.shown.lock().await;
            if let Some(latest) = context.feed.latest().filter(|latest| latest.seq != shown.positions) {
                for emitter in latest.snapshot.report.emitters.iter().take(MOST_EMITTERS) {
                    self.link.send(self.of_emitter(emitter, now).as_bytes()).await?;
                }
                shown.positions = latest.seq;
            }
            if shown.alerts_at.is_none_or(|at| at.elapsed() >= RESEND) {
                let _turn = self.turn.lock().await;
                for alert in context.open_alerts(self.kinds.as_deref()).await? {
                    self.link.send(self.of_alert(&alert, now).as_bytes()).await?;
                }
                shown.alerts_at = Some(Instant::now());
            }
            Ok(())
        })
    }
}
