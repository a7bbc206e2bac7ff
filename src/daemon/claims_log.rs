//! The claims log beside the frames: a slow disk, a gigabyte of garbage or a flood of names holds up no frame.

use std::collections::{HashMap, HashSet, VecDeque};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, Sender, SyncSender, TryRecvError, channel, sync_channel};
use std::time::{Duration, Instant, SystemTime};

use jiff::Timestamp;

use crate::claims::{Claim, Config, Follower, Inbox, MOST_NEW, Poll};

/// How often the log is looked at.
const FOLLOW_EVERY: Duration = Duration::from_millis(100);
/// Claims in the log before the start that are older than this bear on no frame (a claim answers for a new beam for a minute at most), s.
const OLD_AT_START_S: f64 = 120.0;
/// Of those the newest are taken all the same: they say when the log went quiet.
const OLD_KEPT: usize = 100;
/// Claims of one name that are taken at the start at most: as many as the store keeps.
const KEPT_OF_A_NAME: usize = 16;

/// Who reads the log.
#[derive(Debug)]
pub enum ClaimsLog {
    /// A recording's log is read between its frames, at the same places in every run.
    Inline {
        follower: Box<Follower>,
        looked: Option<Instant>,
    },
    /// A thread leaves the claims in the inbox, and says what else it found; it waits until that is taken. It ends when nobody
    /// can change its settings any more.
    Thread {
        polls: Receiver<io::Result<Poll>>,
        changes: Sender<(PathBuf, Config)>,
    },
}

impl ClaimsLog {
    pub fn new(follower: Follower, inbox: Inbox, is_replay: bool) -> io::Result<Self> {
        if is_replay {
            let follower = Box::new(follower);
            return Ok(Self::Inline { follower, looked: None });
        }
        let (found, polls) = sync_channel(0);
        let (changes, settings) = channel();
        let since = SystemTime::now() - Duration::from_secs_f64(OLD_AT_START_S);
        let follower = follower.live(since);
        std::thread::Builder::new()
            .name("claims".into())
            .spawn(move || read(follower, &inbox, &found, &settings))?;
        Ok(Self::Thread { polls, changes })
    }

    /// Goes on with other settings, and another log where `path` is another.
    pub fn change(&mut self, path: &Path, config: &Config) {
        match self {
            Self::Inline { follower, .. } => follower.change(path, config),
            // The thread lives as long as `polls` is read.
            Self::Thread { changes, .. } => drop(changes.send((path.to_owned(), config.clone()))),
        }
    }

    /// What has been read since, if anything. `again` asks an inline log at once.
    pub fn next(&mut self, again: bool) -> Option<io::Result<Poll>> {
        match self {
            Self::Thread { polls, .. } => polls.try_recv().ok(),
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

/// Reads until nobody listens any more.
fn read(
    mut follower: Follower,
    inbox: &Inbox,
    found: &SyncSender<io::Result<Poll>>,
    settings: &Receiver<(PathBuf, Config)>,
) {
    let mut backlog = Some(Backlog::default());
    loop {
        match settings.try_recv() {
            Ok((path, config)) => {
                follower.change(&path, &config);
                backlog = Some(Backlog::default());
            }
            Err(TryRecvError::Empty) => {}
            Err(TryRecvError::Disconnected) => return,
        }
        let mut poll = follower.poll();
        let more = poll.as_ref().is_ok_and(|p| p.more);
        if let Ok(poll) = &mut poll {
            let claims = std::mem::take(&mut poll.claims);
            inbox.skipped(poll.skipped_bytes);
            match &mut backlog {
                Some(backlog) => backlog.add(claims, Timestamp::now()),
                None => inbox.offer(claims),
            }
        }
        if !more && let Some(backlog) = backlog.take() {
            inbox.offer(backlog.newest());
        }
        let is_news = match &poll {
            Ok(p) => p.restarted || p.refused_count > 0 || p.skipped_at_start_bytes + p.skipped_bytes > 0,
            Err(_) => true,
        };
        if is_news && found.send(poll).is_err() {
            return;
        }
        // Half of a core at most, while there is more.
        std::thread::sleep(if more { FOLLOW_EVERY / 10 } else { FOLLOW_EVERY });
    }
}

/// What the log held before the start: mostly history.
#[derive(Debug, Default)]
struct Backlog {
    old: VecDeque<Claim>,
    recent: Vec<Claim>,
}

impl Backlog {
    fn add(&mut self, claims: Vec<Claim>, now: Timestamp) {
        for claim in claims {
            if now.duration_since(claim.time).as_secs_f64() <= OLD_AT_START_S {
                self.recent.push(claim);
            } else {
                self.old.push_back(claim);
                if self.old.len() > OLD_KEPT {
                    self.old.pop_front();
                }
            }
        }
    }

    /// In the log's order, of each name as many of the newest as the store keeps, fewer where the inbox has not room for that.
    fn newest(self) -> Vec<Claim> {
        let mut claims: Vec<Claim> = Vec::from(self.old).into_iter().chain(self.recent).collect();
        let names: HashSet<&str> = claims.iter().map(|claim| claim.user.as_str()).collect();
        let most = (MOST_NEW / names.len().max(1)).clamp(1, KEPT_OF_A_NAME);
        let mut kept: HashMap<String, usize> = HashMap::new();
        claims.reverse();
        claims.retain(|claim| {
            let count = kept.entry(claim.user.clone()).or_default();
            *count += 1;
            *count <= most
        });
        claims.truncate(MOST_NEW);
        claims.reverse();
        claims
    }
}

#[cfg(test)]
mod tests {
    use jiff::SignedDuration;

    use super::*;
    use crate::claim::ClaimState;

    #[test]
    fn of_a_long_log_what_may_still_bear_is_taken_and_the_end_of_what_may_not() {
        let now: Timestamp = "2026-11-21T08:00:00Z".parse().unwrap();
        let claim = |user: String, ago_s: i64| Claim {
            time: now - SignedDuration::from_secs(ago_s),
            user,
            x_m: 0.0,
            y_m: 0.0,
            z_m: None,
            sigma_m: None,
            cov_m2: None,
            power_w: None,
            state: ClaimState::Active,
        };
        let mut backlog = Backlog::default();
        backlog.add((0..5000).map(|k| claim(format!("!{k}"), 7000 - k)).collect(), now);
        backlog.add((0..100).map(|k| claim("a".into(), 100 - k)).collect(), now);
        let taken = backlog.newest();
        let of_a = taken.iter().filter(|c| c.user == "a").count();
        assert_eq!((taken.len() - of_a, of_a), (OLD_KEPT, KEPT_OF_A_NAME));
        assert_eq!(taken[0].user, "!4900");
        assert_eq!(taken.last().map(|c| c.time), Some(claim("a".into(), 1).time));
        // Of more names than there is room for, the newest.
        let mut backlog = Backlog::default();
        backlog.add((0..5000).map(|k| claim(format!("!{k}"), 100)).collect(), now);
        let taken = backlog.newest();
        assert_eq!((taken.len(), taken[0].user.as_str()), (MOST_NEW, "!2952"));
    }
}
