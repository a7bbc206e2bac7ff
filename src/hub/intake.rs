//! Messages of the fleet, checked: who may have sent them, and whether they can be read.

use std::borrow::Cow;

use async_nats::Message;
use metrics::counter;
use serde::de::DeserializeOwned;

use crate::fleet::message::{FromStation, VERSION};
use crate::fleet::{Subject, Topic};
use crate::metric;
use crate::monitor::StationName;

/// Largest message, bytes: what a server takes by default.
const LARGEST: usize = 1 << 20;

/// What every message holds, read where the rest of one cannot be.
///
/// `site` and `station` one by one: a flattened [`StationName`] would have all of the message kept to search it.
#[derive(serde::Deserialize)]
struct Head<'a> {
    version: u32,
    #[serde(borrow)]
    site: Cow<'a, str>,
    #[serde(borrow)]
    station: Cow<'a, str>,
}

/// Reads a message of this topic, and counts it. The error says why it cannot be used: it is another version, malformed, too large, or in
/// the name of another station than its subject's, which is the one that the server lets its sender use.
pub fn read<T: DeserializeOwned + FromStation>(message: &Message, topic: Topic) -> Result<T, &'static str> {
    let outcome = parse(message, topic);
    let word = match &outcome {
        Ok(_) => "taken",
        Err(reason) => reason,
    };
    count(topic, word);
    outcome
}

/// The station whose subject a message came on.
pub fn sender(message: &Message) -> Option<StationName> {
    Subject::parse(&message.subject).map(|subject| subject.name)
}

pub fn count(topic: Topic, outcome: &'static str) {
    counter!(metric::FLEET_MESSAGES, "topic" => topic.name(), "outcome" => outcome).increment(1);
}

fn parse<T: DeserializeOwned + FromStation>(message: &Message, topic: Topic) -> Result<T, &'static str> {
    let subject = Subject::parse(&message.subject).filter(|subject| subject.topic == topic);
    let subject = subject.ok_or("wrong_subject")?;
    if message.payload.len() > LARGEST {
        return Err("too_large");
    }
    let check = |version, site: &str, station: &str| match version {
        VERSION if (site, station) == (&*subject.name.site, &*subject.name.station) => Ok(()),
        VERSION => Err("other_station"),
        _ => Err("other_version"),
    };
    let Ok(read) = serde_json::from_slice::<T>(&message.payload) else {
        let head: Head = serde_json::from_slice(&message.payload).map_err(|_| "malformed")?;
        check(head.version, &head.site, &head.station)?;
        return Err("malformed");
    };
    let (version, name) = read.head();
    check(version, &name.site, &name.station)?;
    Ok(read)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fleet::message::{HealthMessage, sequence_number};

    fn message(subject: &str, payload: &str) -> Message {
        Message {
            subject: subject.into(),
            reply: None,
            payload: payload.to_owned().into(),
            headers: None,
            status: None,
            description: None,
            length: payload.len(),
        }
    }

    #[test]
    fn a_number_that_no_journal_can_hold_is_refused() {
        let read = |text: &str| sequence_number(&mut serde_json::Deserializer::from_str(text)).ok();
        assert_eq!(read("9223372036854775807"), Some(i64::MAX as u64));
        assert_eq!(read("9223372036854775808"), None);
    }

    #[test]
    fn a_message_in_another_name_or_version_is_refused() {
        let body = |version: u32, station: &str| {
            format!(
                r#"{{"version":{version},"site":"a","station":"{station}","time":"2026-11-21T08:00:00Z","status":null,"alerts_waiting":0}}"#
            )
        };
        let parsed = |subject: &str, body: &str| {
            parse::<HealthMessage>(&message(subject, body), Topic::Health).map(|m| m.name.station)
        };
        assert_eq!(parsed("oapwatch.a.b.health", &body(1, "b")), Ok("b".to_owned()));
        assert_eq!(parsed("oapwatch.a.b.health", &body(2, "b")), Err("other_version"));
        assert_eq!(parsed("oapwatch.a.b.health", &body(1, "c")), Err("other_station"));
        assert_eq!(parsed("oapwatch.a.b.pose", &body(1, "b")), Err("wrong_subject"));
        assert_eq!(parsed("oapwatch.a.b.health", "{"), Err("malformed"));
        assert_eq!(
            parsed("oapwatch.a.b.health", &" ".repeat(LARGEST + 1)),
            Err("too_large")
        );
    }
}
