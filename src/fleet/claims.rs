//! Claims that the access network publishes on a NATS subject, in the format of `[claims]`.

use std::time::Duration;

use async_nats::{Client, Message};
use futures_util::StreamExt;
use metrics::counter;

use crate::claims::{Config, Inbox, parse_body};
use crate::metric;

/// Messages that wait to be read; what comes beyond is dropped. At the server's usual limit of 1 MiB each a second's backlog of a
/// network of 10,000 users fits several times.
pub const CAPACITY: usize = 64;
/// Wait before the subscription is made again.
const RETRY: Duration = Duration::from_secs(5);

/// Where claims go, and how they are written.
#[derive(Clone, Debug)]
pub struct Intake {
    pub reading: Config,
    pub inbox: Inbox,
}

/// Takes claims as long as there is a client; a message holds one or many, as the body of `POST /v1/claims` does.
pub async fn receive(client: &Client, subject: &str, intake: &Intake) {
    let mut is_telling = true;
    loop {
        match client.subscribe(subject.to_owned()).await {
            Ok(mut messages) => {
                while let Some(message) = messages.next().await {
                    let intake = intake.clone();
                    // A full message takes some tens of milliseconds, in which the fleet's other messages go on.
                    let taken = tokio::task::spawn_blocking(move || take(&message, &intake));
                    let refused = taken.await.ok().flatten();
                    // The first of several in a row.
                    if let Some(why) = refused.as_ref().filter(|_| is_telling) {
                        tracing::warn!(subject, "a claim cannot be taken: {why}");
                    }
                    is_telling = refused.is_none();
                }
            }
            Err(error) => tracing::warn!(subject, %error, "claims cannot be subscribed to"),
        }
        tokio::time::sleep(RETRY).await;
    }
}

/// Returns why the first claim that is refused is refused.
fn take(message: &Message, intake: &Intake) -> Option<String> {
    let (mut refused, mut first) = (0, None);
    let claims = parse_body(&message.payload, &intake.reading, |line, why| {
        refused += 1;
        first.get_or_insert_with(|| format!("line {line}: {why}"));
    });
    counter!(metric::CLAIMS, "outcome" => "malformed").increment(refused);
    intake.inbox.offer(claims.into_iter().map(|(_, claim)| claim).collect());
    first
}
