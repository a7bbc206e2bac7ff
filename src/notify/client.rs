//! One HTTP request to a receiver and how its answer is classified.

use std::error::Error as _;
use std::time::Duration;

use jiff::Timestamp;
use jiff::fmt::rfc2822::DateTimeParser;
use reqwest::StatusCode;
use reqwest::header::{CONTENT_TYPE, HeaderMap, RETRY_AFTER};

use super::endpoint::Endpoint;
use super::payload;
use crate::journal::{self, Recorded};

/// Read of an answer so that its connection can be used again; a longer one costs the connection.
const ANSWER: usize = 4 << 10;

/// Upper limit of `Retry-After`: no receiver may put off alerts indefinitely.
const LONGEST_RETRY_AFTER: Duration = Duration::from_secs(3600);

/// How a request ended.
#[derive(Debug)]
pub(super) enum Verdict {
    Delivered,
    /// 410: the receiver wants no more.
    Gone,
    /// The journal no longer holds the event: it was given up while the endpoint was disabled.
    Expired,
    Failed {
        failure: Failure,
        retry_after: Option<Duration>,
    },
}

/// Why a request was no delivery.
#[derive(Debug, thiserror::Error)]
pub(super) enum Failure {
    #[error("the receiver answered {0}")]
    Status(StatusCode),
    #[error("the receiver answered {0}, a redirect, which is not followed; put its new address into the config")]
    Redirect(StatusCode),
    #[error("no answer in time")]
    Timeout,
    #[error("the journal cannot be read: {0}")]
    Journal(journal::Error),
    #[error("the request broke off inside oapwatch")]
    Broken,
    #[error("no connection: {0}")]
    Connect(Cause),
    #[error("{0}")]
    Transport(Cause),
}

/// Prints the innermost causes, which say what happened; the outer ones only say that something did.
#[derive(Debug)]
pub(super) struct Cause(reqwest::Error);

impl std::fmt::Display for Cause {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let mut causes = Vec::new();
        let mut source = self.0.source();
        while let Some(cause) = source {
            causes.push(cause.to_string());
            source = cause.source();
        }
        match &causes[..] {
            [] => self.0.fmt(f),
            [cause] => f.write_str(cause),
            [.., outer, inner] => write!(f, "{outer}: {inner}"),
        }
    }
}

/// What a receiver answered.
pub(super) struct Answer {
    pub(super) status: StatusCode,
    retry_after: Option<Duration>,
}

impl Answer {
    /// Why it is no confirmation; `None` where it is one.
    pub(super) fn failure(&self) -> Option<Failure> {
        match self.status {
            status if status.is_success() => None,
            status if status.is_redirection() => Some(Failure::Redirect(status)),
            status => Some(Failure::Status(status)),
        }
    }
}

/// Delivers an event and judges the answer.
pub(super) async fn send(endpoint: &Endpoint, id: &str, event: &Recorded, now: Timestamp) -> Verdict {
    let (failure, retry_after) = match post(endpoint, id, payload::body(event), now).await {
        Ok(answer) if answer.status == StatusCode::GONE => return Verdict::Gone,
        Ok(answer) => match answer.failure() {
            None => return Verdict::Delivered,
            Some(failure) => (failure, answer.retry_after),
        },
        Err(failure) => (failure, None),
    };
    Verdict::Failed { failure, retry_after }
}

/// Makes one signed request.
pub(super) async fn post(endpoint: &Endpoint, id: &str, body: Vec<u8>, now: Timestamp) -> Result<Answer, Failure> {
    let unix_s = now.as_second();
    let request = endpoint
        .client
        .post(endpoint.url.clone())
        .header(CONTENT_TYPE, "application/json")
        .header("webhook-id", id)
        .header("webhook-timestamp", unix_s)
        .header("webhook-signature", endpoint.signer.sign(id, unix_s, &body))
        .body(body);
    let mut answer = request.send().await.map_err(|error| describe(error.without_url()))?;
    let mut read = 0;
    while read < ANSWER
        && let Ok(Some(chunk)) = answer.chunk().await
    {
        read += chunk.len();
    }
    Ok(Answer {
        status: answer.status(),
        retry_after: retry_after(answer.headers(), now),
    })
}

fn describe(error: reqwest::Error) -> Failure {
    if error.is_timeout() {
        Failure::Timeout
    } else if error.is_connect() {
        Failure::Connect(Cause(error))
    } else {
        Failure::Transport(Cause(error))
    }
}

/// RFC 9110 §10.2.3: seconds, or a date.
fn retry_after(headers: &HeaderMap, now: Timestamp) -> Option<Duration> {
    let text = headers.get(RETRY_AFTER)?.to_str().ok()?.trim();
    let wait = if !text.is_empty() && text.bytes().all(|b| b.is_ascii_digit()) {
        // More digits than fit are as good as for ever.
        Duration::from_secs(text.parse().unwrap_or(u64::MAX))
    } else {
        const DATE: DateTimeParser = DateTimeParser::new().relaxed_weekday(true);
        let date = DATE.parse_timestamp(text).ok()?;
        Duration::try_from(date.duration_since(now)).unwrap_or(Duration::ZERO)
    };
    Some(wait.min(LONGEST_RETRY_AFTER))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn retry_after_is_seconds_or_a_date_and_bounded() {
        let now: Timestamp = "1994-11-06T08:49:07Z".parse().unwrap();
        let read = |text: &str| {
            let mut headers = HeaderMap::new();
            headers.insert(RETRY_AFTER, text.parse().unwrap());
            retry_after(&headers, now).map(|d| d.as_secs())
        };
        assert_eq!(read("120"), Some(120));
        assert_eq!(read("Sun, 06 Nov 1994 08:49:37 GMT"), Some(30));
        assert_eq!(read("Sun, 06 Nov 1994 08:48:37 GMT"), Some(0));
        assert_eq!(read("Sun, 06 Nov 2094 08:49:37 GMT"), Some(3600));
        assert_eq!(read("99999999999999999999999"), Some(3600));
        assert_eq!(read("-5"), None);
        assert_eq!(read("soon"), None);
        assert_eq!(read(""), None);
    }
}
