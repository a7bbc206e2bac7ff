//! A webhook: one signed HTTP request and how its answer is classified.

use std::time::Duration;

use futures_util::future::BoxFuture;
use jiff::Timestamp;
use jiff::fmt::rfc2822::DateTimeParser;
use reqwest::header::{CONTENT_TYPE, HeaderMap, RETRY_AFTER};
use reqwest::{Response, StatusCode};
use url::Url;

use super::channel::{Channel, Failure, Message, Verdict};
use super::payload;
use super::signature::Signer;

/// Read of an answer so that its connection can be used again; a longer one costs the connection.
const ANSWER: usize = 4 << 10;

/// Upper limit of `Retry-After`: no receiver may put off alerts indefinitely.
const LONGEST_RETRY_AFTER: Duration = Duration::from_secs(3600);

/// A receiver of signed webhooks.
#[derive(Debug)]
pub(super) struct Webhook {
    pub(super) url: Url,
    pub(super) signer: Signer,
    pub(super) client: reqwest::Client,
}

impl Channel for Webhook {
    /// Makes one signed request and judges the answer.
    fn deliver<'a>(&'a self, message: Message<'a>) -> BoxFuture<'a, Verdict> {
        Box::pin(async move {
            let (id, unix_s) = (message.id, message.now.as_second());
            let body = payload::body(message.event, message.is_test);
            let request = self
                .client
                .post(self.url.clone())
                .header(CONTENT_TYPE, "application/json")
                .header("webhook-id", id)
                .header("webhook-timestamp", unix_s)
                .header("webhook-signature", self.signer.sign(id, unix_s, &body))
                .body(body);
            match request.send().await {
                Ok(answer) => judge(answer, message.now).await,
                Err(error) => Failure::from(error).into(),
            }
        })
    }
}

/// What an HTTP answer means for the delivery.
pub async fn judge(mut answer: Response, now: Timestamp) -> Verdict {
    let mut read = 0;
    while read < ANSWER
        && let Ok(Some(chunk)) = answer.chunk().await
    {
        read += chunk.len();
    }
    let failure = match answer.status() {
        StatusCode::GONE => return Verdict::Gone,
        status if status.is_success() => return Verdict::Delivered(Some(status)),
        status if status.is_redirection() => Failure::Redirect(status),
        status => Failure::Status(status),
    };
    Verdict::Failed {
        failure,
        retry_after: retry_after(answer.headers(), now),
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
