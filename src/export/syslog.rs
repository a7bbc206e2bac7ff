//! Syslog: RFC 5424 messages with structured data, or with CEF in them, over UDP (RFC 5426), TCP (RFC 6587) and TLS (RFC 5425).

use futures_util::future::BoxFuture;

use super::address::Address;
use super::cef;
use super::config::{Config, Format};
use super::link::Link;
use super::words::{sentence, sigma_m};
use crate::claim::escape_undisplayable;
use crate::monitor::{Alert, AlertState, Severity};
use crate::notify::{Channel, Message, Verdict};
use crate::word::word;

/// authpriv: security messages (RFC 5424, table 1).
const FACILITY: u8 = 10;
/// The number that RFC 5612 keeps for examples: we have none of our own.
const ENTERPRISE: u32 = 32473;
/// What a receiver has to take from a datagram (RFC 5426, section 3.2: should, of 2048). A name of 256 characters is the longest that an
/// alert holds.
const LONGEST_DATAGRAM: usize = 2048;

/// One syslog receiver.
#[derive(Debug)]
pub(super) struct Syslog {
    link: Link,
    station: String,
    format: Format,
}

impl Syslog {
    pub(super) fn new(config: &Config, address: &Address, station: String) -> Result<Self, String> {
        Ok(Self {
            link: Link::new(config, address)?,
            station,
            format: config.format,
        })
    }

    /// A message as RFC 5424, section 6, has it.
    fn message(&self, message: &Message<'_>) -> Vec<u8> {
        let event = &message.event.event;
        let alert = &event.alert;
        let what = match message.is_test {
            true => "test".to_owned(),
            false => word(event.told_as()),
        };
        let header = format!(
            "<{}>1 {:.6} {} oapwatch {} {what}",
            FACILITY * 8 + severity(alert, message.is_test),
            message.event.at,
            self.station,
            std::process::id(),
        );
        let (data, text) = match self.format {
            Format::Rfc5424 => (structured(message.id, alert), format!("{what}: {}", sentence(alert))),
            Format::Cef => ("-".to_owned(), cef::event(message, &self.station, &what)),
        };
        // Text that is not plain ASCII begins with the byte order mark (section 6.4).
        let mark = if text.is_ascii() { "" } else { "\u{feff}" };
        let mut line = format!("{header} {data} {mark}{text}");
        if self.link.is_datagram() && line.len() > LONGEST_DATAGRAM {
            let cut = (0..=LONGEST_DATAGRAM).rev().find(|&at| line.is_char_boundary(at));
            line.truncate(cut.unwrap_or(0));
        }
        match self.link.is_datagram() {
            true => line.into_bytes(),
            false => format!("{} {line}", line.len()).into_bytes(),
        }
    }
}

impl Channel for Syslog {
    fn deliver<'a>(&'a self, message: Message<'a>) -> BoxFuture<'a, Verdict> {
        Box::pin(async move {
            match self.link.send(&self.message(&message)).await {
                Ok(()) => Verdict::Delivered(None),
                Err(failure) => failure.into(),
            }
        })
    }
}

/// RFC 5424, table 2.
fn severity(alert: &Alert, is_test: bool) -> u8 {
    const CRITICAL: u8 = 2;
    const WARNING: u8 = 4;
    const NOTICE: u8 = 5;
    const INFORMATIONAL: u8 = 6;
    match alert.severity {
        _ if is_test => INFORMATIONAL,
        _ if alert.state == AlertState::Cleared => NOTICE,
        Severity::Critical => CRITICAL,
        Severity::Warning => WARNING,
        Severity::Info => INFORMATIONAL,
    }
}

/// `[oapwatch@32473 event="…" alert="…" kind="…" …]`.
fn structured(id: &str, alert: &Alert) -> String {
    let mut element = format!("[oapwatch@{ENTERPRISE}");
    let mut add = |name: &str, value: &str| {
        element += &format!(" {name}=\"");
        for c in escape_undisplayable(value).chars() {
            // Section 6.3.3.
            if matches!(c, '"' | '\\' | ']') {
                element.push('\\');
            }
            element.push(c);
        }
        element.push('"');
    };
    add("event", id);
    add("alert", &alert.id);
    add("kind", &word(alert.kind));
    add("severity", &word(alert.severity));
    add("state", &word(alert.state));
    add("raised_at", &format!("{:.6}", alert.raised_at));
    if let Some(at) = alert.cleared_at {
        add("cleared_at", &format!("{at:.6}"));
    }
    if let Some(user) = &alert.user {
        add("user", user);
    }
    if let Some((x, y)) = alert.x_m.zip(alert.y_m) {
        add("x_m", &format!("{x:.3}"));
        add("y_m", &format!("{y:.3}"));
    }
    if let Some(sigma) = alert.cov_m2.as_ref().and_then(sigma_m) {
        add("sigma_m", &format!("{sigma:.3}"));
    }
    if let Some(by) = alert.acknowledgement.as_ref().and_then(|a| a.by.as_deref()) {
        add("acknowledged_by", by);
    }
    element + "]"
}
