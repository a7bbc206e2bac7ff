//! Prometheus Alertmanager, API v2: an alert as labels that group, sent again while it is open.

use std::path::Path;
use std::time::Duration;

use futures_util::future::BoxFuture;
use jiff::{SignedDuration, Timestamp};
use reqwest::header::{AUTHORIZATION, CONTENT_TYPE, HeaderMap, HeaderValue};
use reqwest::{Client, redirect};
use serde_json::{Value, json};
use tokio::sync::Mutex;
use url::Url;

use super::address::Address;
use super::config::Config;
use super::tls;
use super::updates::{Context, RESEND, Updates};
use super::words::{sentence, title};
use crate::monitor::{Alert, AlertEventKind, AlertKind, Severity};
use crate::notify::{Channel, Failure, Message, Verdict, is_loopback, judge};
use crate::small_file;
use crate::word::word;

/// An open alert that is not sent again for this long is over, as far as Alertmanager knows: four times what one lost request costs, as in
/// Prometheus.
const HOLD: SignedDuration = SignedDuration::from_secs(4 * RESEND.as_secs() as i64);
/// A test event is shown for so long.
const TEST: SignedDuration = SignedDuration::from_secs(60);
/// Alerts in one request.
const MOST_AT_ONCE: usize = 500;

/// One Alertmanager.
#[derive(Debug)]
pub(super) struct Alertmanager {
    url: Url,
    client: Client,
    station: String,
    kinds: Option<Vec<AlertKind>>,
    /// One request at a time, so that an open alert is never sent after its end.
    turn: Mutex<()>,
}

impl Alertmanager {
    pub(super) fn new(config: &Config, address: &Address, station: String) -> Result<Self, String> {
        let mut url = address.url.clone();
        url.set_path(&format!("{}/api/v2/alerts", url.path().trim_end_matches('/')));
        if url.port().is_none() {
            // An error would mean that the URL has no host.
            let _ = url.set_port(Some(address.port));
        }
        let mut headers = HeaderMap::new();
        if let Some(path) = &config.token_file {
            headers.insert(AUTHORIZATION, bearer(path)?);
        }
        let mut builder = Client::builder()
            .user_agent(concat!("oapwatch/", env!("CARGO_PKG_VERSION")))
            .redirect(redirect::Policy::none())
            .default_headers(headers)
            .connect_timeout(Duration::from_secs(10))
            .tls_backend_preconfigured(tls::client(config)?);
        if is_loopback(&url) {
            builder = builder.no_proxy();
        }
        Ok(Self {
            client: builder.build().map_err(|e| format!("address: {e}"))?,
            url,
            station,
            kinds: config.kinds.clone(),
            turn: Mutex::new(()),
        })
    }

    async fn post(&self, alerts: &[Value], now: Timestamp) -> Verdict {
        let body = serde_json::to_vec(alerts).expect("JSON values are written as such");
        let request = self
            .client
            .post(self.url.clone())
            .header(CONTENT_TYPE, "application/json");
        match request.body(body).send().await {
            Ok(answer) => judge(answer, now).await,
            Err(error) => Failure::from(error).into(),
        }
    }

    /// An alert with this severity; its end, where it is over. Alertmanager knows an alert by its labels, so a change of the severity is the end
    /// of one and the start of another.
    fn entry(&self, alert: &Alert, severity: Severity, now: Timestamp, end: Option<Timestamp>) -> Value {
        // Of a recording that plays in the future only what has been counts.
        let start = alert.raised_at.min(now);
        let end = match end {
            Some(end) => end.min(now).max(start),
            None => now.saturating_add(HOLD).unwrap_or(Timestamp::MAX),
        };
        let mut labels = json!({
            "alertname": camel(&title(alert)),
            "job": "oapwatch",
            "instance": self.station,
            "severity": word(severity),
            "alert_id": alert.id,
        });
        if let Some(user) = &alert.user {
            labels["user"] = json!(user);
        }
        let place = |value: Option<f64>| value.map_or(String::new(), |v| format!("{v:.2}"));
        json!({
            "labels": labels,
            "annotations": {
                "summary": sentence(alert),
                "state": word(alert.state),
                "x_m": place(alert.x_m),
                "y_m": place(alert.y_m),
            },
            "startsAt": start,
            "endsAt": end,
        })
    }

    fn entries(&self, message: &Message<'_>) -> Vec<Value> {
        let event = &message.event.event;
        let alert = &event.alert;
        if message.is_test {
            let mut test = self.entry(alert, Severity::Info, message.now, None);
            test["labels"]["alertname"] = json!("OapwatchTest");
            test["annotations"]["summary"] = json!("a test event; no alert stands behind it");
            test["endsAt"] = json!(message.now.saturating_add(TEST).unwrap_or(Timestamp::MAX));
            return vec![test];
        }
        let own = |severity, end| self.entry(alert, severity, message.now, end);
        match event.told_as() {
            AlertEventKind::Cleared => vec![own(alert.severity, Some(alert.cleared_at.unwrap_or(message.now)))],
            // The severity has changed: the alert of the one before is over.
            AlertEventKind::Updated => [Severity::Info, Severity::Warning, Severity::Critical]
                .into_iter()
                .map(|severity| own(severity, (severity != alert.severity).then_some(message.now)))
                .collect(),
            _ => vec![own(alert.severity, None)],
        }
    }
}

impl Updates for Alertmanager {
    fn interval(&self) -> Duration {
        RESEND
    }

    /// Sends the journal's open alerts again.
    fn round<'a>(&'a self, context: &'a Context) -> BoxFuture<'a, Result<(), Failure>> {
        Box::pin(async move {
            let _turn = self.turn.lock().await;
            // Read in our turn: what is over by now is not sent as open after its end.
            let open = context.open_alerts(self.kinds.as_deref()).await?;
            let now = context.clock.now();
            let open: Vec<Value> = open
                .iter()
                .map(|alert| self.entry(alert, alert.severity, now, None))
                .collect();
            for some in open.chunks(MOST_AT_ONCE) {
                if let Verdict::Failed { failure, .. } = self.post(some, now).await {
                    return Err(failure);
                }
            }
            Ok(())
        })
    }
}

impl Channel for Alertmanager {
    fn deliver<'a>(&'a self, message: Message<'a>) -> BoxFuture<'a, Verdict> {
        Box::pin(async move {
            let _turn = self.turn.lock().await;
            self.post(&self.entries(&message), message.now).await
        })
    }
}

/// The `Authorization` of the token in a file.
fn bearer(path: &Path) -> Result<HeaderValue, String> {
    let wrong = |found: String| {
        format!(
            "token_file: {}: expected a token on one line, found {found}",
            path.display()
        )
    };
    let text = small_file::read(path).map_err(|e| wrong(e.to_string()))?;
    let token = text.trim();
    if token.is_empty() || token.lines().count() > 1 {
        return Err(wrong(format!("{} lines", token.lines().count())));
    }
    let mut value =
        HeaderValue::from_str(&format!("Bearer {token}")).map_err(|_| wrong("other characters".to_owned()))?;
    value.set_sensitive(true);
    Ok(value)
}

/// `OapwatchUnclaimedEmitter`.
fn camel(title: &str) -> String {
    let capital = |word: &str| {
        let mut letters = word.chars();
        let first = letters.next().map(|c| c.to_ascii_uppercase());
        first.into_iter().chain(letters).collect::<String>()
    };
    std::iter::once("oapwatch")
        .chain(title.split(' '))
        .map(capital)
        .collect()
}
