//! Messages of which only the newest counts, until the hub reads them: one of each station and topic. A hub that reads slower than
//! stations speak skips their older messages, and is never behind by more than one of each.

use std::collections::{HashMap, VecDeque};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use async_nats::{Client, Message};
use futures_util::StreamExt;
use futures_util::stream::select_all;
use tokio::sync::Notify;

use super::intake;
use super::stream::subscribe;
use crate::fleet::Topic;

/// Topics of which only the newest message counts.
const TOPICS: [Topic; 3] = [Topic::Health, Topic::Pose, Topic::Positions];
/// Bytes that wait at most: 4096 stations' messages of 16 kB, five times what ten beams take.
const MOST_BYTES: usize = 64 << 20;

/// Shared by the task that hears and the loop that reads.
#[derive(Default)]
pub struct Latest {
    waiting: Mutex<Waiting>,
    arrived: Notify,
}

#[derive(Default)]
struct Waiting {
    /// In the order in which a subject's first unread message came.
    order: VecDeque<Arc<str>>,
    newest: HashMap<Arc<str>, (Topic, Message)>,
    bytes: usize,
}

impl Latest {
    /// Takes what stations publish, as long as there is a client.
    pub async fn hear(&self, client: &Client, site: Option<&str>) {
        let mut all = Vec::new();
        for topic in TOPICS {
            let messages = subscribe(client, site, topic).await;
            all.push(messages.map(move |message| (topic, message)).boxed());
        }
        let mut all = select_all(all);
        while let Some((topic, message)) = all.next().await {
            self.put(topic, message);
        }
    }

    /// What is not kept is counted: a message that a newer one replaced, and one for which there is no room.
    fn put(&self, topic: Topic, message: Message) {
        let mut waiting = self.waiting();
        let subject: Arc<str> = message.subject.as_str().into();
        let before = waiting.newest.get(&subject).map(|(_, old)| old.payload.len());
        let bytes = waiting.bytes + message.payload.len() - before.unwrap_or(0);
        if bytes > MOST_BYTES {
            intake::count(topic, "dropped");
            return;
        }
        waiting.bytes = bytes;
        waiting.newest.insert(subject.clone(), (topic, message));
        match before {
            Some(_) => intake::count(topic, "replaced"),
            None => waiting.order.push_back(subject),
        }
        drop(waiting);
        self.arrived.notify_one();
    }

    /// The message that has waited longest, or rather the newest of its station and topic.
    pub async fn next(&self) -> (Topic, Message) {
        loop {
            // However much waits, the reader's other sources get their turn.
            tokio::task::coop::consume_budget().await;
            if let Some(message) = self.pop() {
                return message;
            }
            self.arrived.notified().await;
        }
    }

    fn pop(&self) -> Option<(Topic, Message)> {
        let mut waiting = self.waiting();
        let subject = waiting.order.pop_front()?;
        let (topic, message) = waiting.newest.remove(&subject)?;
        waiting.bytes -= message.payload.len();
        Some((topic, message))
    }

    /// A panic while the lock is held leaves plain data behind.
    fn waiting(&self) -> MutexGuard<'_, Waiting> {
        self.waiting.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn message(subject: &str, payload: Vec<u8>) -> Message {
        Message {
            subject: subject.into(),
            reply: None,
            length: payload.len(),
            payload: payload.into(),
            headers: None,
            status: None,
            description: None,
        }
    }

    #[test]
    fn a_newer_message_takes_the_place_of_the_older_one() {
        let latest = Latest::default();
        for (subject, payload) in [("a", "1"), ("b", "2"), ("a", "34")] {
            latest.put(Topic::Positions, message(subject, payload.into()));
        }
        let read = std::iter::from_fn(|| latest.pop());
        let read: Vec<_> = read.map(|(_, m)| (m.subject.to_string(), m.payload.to_vec())).collect();
        assert_eq!(
            read,
            [("a".to_owned(), b"34".to_vec()), ("b".to_owned(), b"2".to_vec())]
        );
        assert_eq!(latest.waiting().bytes, 0);
    }

    #[test]
    fn what_waits_is_bounded() {
        let latest = Latest::default();
        for k in 0..100 {
            latest.put(Topic::Health, message(&k.to_string(), vec![0; 1 << 20]));
        }
        assert_eq!(latest.waiting().bytes, MOST_BYTES);
        assert_eq!(std::iter::from_fn(|| latest.pop()).count(), 64);
    }
}
