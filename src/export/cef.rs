//! An alert event in ArcSight's Common Event Format (Micro Focus, "Implementing ArcSight Common Event Format", revision 26).

use super::words::{sigma_m, title};
use crate::claim::escape_undisplayable;
use crate::monitor::Severity;
use crate::notify::Message;
use crate::word::word;

/// `CEF:0|oapwatch|oapwatch|VERSION|KIND|TITLE|SEVERITY|EXTENSION`; `what` is the step in the alert's life.
pub(super) fn event(message: &Message<'_>, station: &str, what: &str) -> String {
    let alert = &message.event.event.alert;
    let kind = word(alert.kind);
    let mut text = format!(
        "CEF:0|oapwatch|oapwatch|{}|{kind}|{}|{}|",
        env!("CARGO_PKG_VERSION"),
        title(alert),
        severity(alert.severity),
    );
    let mut add = |key: &str, value: &str| {
        if !text.ends_with('|') {
            text.push(' ');
        }
        text += key;
        text.push('=');
        for c in escape_undisplayable(value).chars() {
            if matches!(c, '=' | '\\') {
                text.push('\\');
            }
            text.push(c);
        }
    };
    add("rt", &message.event.at.as_millisecond().to_string());
    add("dvchost", station);
    add("externalId", &alert.id);
    add("act", what);
    add("cat", &kind);
    add("start", &alert.raised_at.as_millisecond().to_string());
    if let Some(at) = alert.cleared_at {
        add("end", &at.as_millisecond().to_string());
    }
    if let Some(user) = &alert.user {
        add("suser", user);
    }
    add("cs1Label", "state");
    add("cs1", &word(alert.state));
    let numbers = [
        ("cfp1", "x_m", alert.x_m),
        ("cfp2", "y_m", alert.y_m),
        ("cfp3", "sigma_m", alert.cov_m2.as_ref().and_then(sigma_m)),
    ];
    for (key, label, value) in numbers {
        if let Some(value) = value {
            add(&format!("{key}Label"), label);
            add(key, &format!("{value:.3}"));
        }
    }
    text
}

/// Of 0 to 10: 0 to 3 is low, 4 to 6 medium, 7 and 8 high, 9 and 10 very high.
fn severity(severity: Severity) -> u8 {
    match severity {
        Severity::Info => 3,
        Severity::Warning => 6,
        Severity::Critical => 9,
    }
}
