//! The claims log beside the frames: a slow disk, or a gigabyte of garbage, holds up no frame.

use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::time::{Duration, Instant};

use crate::claims::{Follower, Poll};

/// How often the log is looked at.
const FOLLOW_EVERY: Duration = Duration::from_millis(100);

/// Who reads the log.
#[derive(Debug)]
pub enum ClaimsLog {
    /// A recording's log is read between its frames, at the same places in every run.
    Inline {
        follower: Box<Follower>,
        looked: Option<Instant>,
    },
    /// A thread reads ahead by one poll and then waits.
    Thread(Receiver<io::Result<Poll>>),
}

impl ClaimsLog {
    pub fn new(follower: Follower, is_replay: bool, stop: Arc<AtomicBool>) -> io::Result<Self> {
        if is_replay {
            let follower = Box::new(follower);
            return Ok(Self::Inline { follower, looked: None });
        }
        let (polls, log) = sync_channel(0);
        std::thread::Builder::new()
            .name("claims".into())
            .spawn(move || read(follower, &polls, &stop))?;
        Ok(Self::Thread(log))
    }

    /// What has been read since, if anything. `again` asks an inline log at once.
    pub fn next(&mut self, again: bool) -> Option<io::Result<Poll>> {
        match self {
            Self::Thread(log) => log.try_recv().ok(),
            Self::Inline { follower, looked } => {
                if !again && looked.is_some_and(|t| t.elapsed() < FOLLOW_EVERY) {
                    return None;
                }
                *looked = Some(Instant::now());
                Some(follower.poll())
            }
        }
    }
}

/// Reads until it is told to stop, or nobody listens any more.
fn read(mut follower: Follower, polls: &SyncSender<io::Result<Poll>>, stop: &AtomicBool) {
    while !stop.load(Ordering::Relaxed) {
        let poll = follower.poll();
        let more = poll.as_ref().is_ok_and(|p| p.more);
        let is_news = match &poll {
            Ok(p) => p.restarted || p.refused_count > 0 || !p.claims.is_empty(),
            Err(_) => true,
        };
        if is_news && polls.send(poll).is_err() {
            return;
        }
        if !more {
            std::thread::sleep(FOLLOW_EVERY);
        }
    }
}
