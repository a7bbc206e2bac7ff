//! What reaches the compute thread beside the frames: claims of the log and by POST, acknowledgements.

use std::time::{Duration, Instant};

use super::claims_log::ClaimsLog;
use super::compute::Compute;
use super::reload::Settings;
use crate::api::{Acknowledged, Command};
use crate::claim::escape_undisplayable;
use crate::claims::{Follower, Refused};
use crate::metric;
use crate::monitor::{Acknowledgement, AlertEvent, AlertState, Withdrawal};

/// How often lines of the claims log that are no claims are logged.
const COMPLAIN_EVERY: Duration = Duration::from_secs(10);
impl Compute {
    /// Acknowledgements, and some of the claims by POST.
    pub(super) fn handle_commands(&mut self) {
        while self.posts.has_room()
            && let Ok(command) = self.commands.try_recv()
        {
            match command {
                Command::Claims { claims, reply } => self.posts.add(claims, reply),
                Command::Acknowledge { id, by, note, reply } => {
                    let acknowledgement = Acknowledgement {
                        at: self.now(),
                        by,
                        note,
                        withdrawn: None,
                    };
                    let event = self.pipeline.monitor.acknowledge(&id, acknowledgement);
                    let outcome = self.acknowledged(&id, event);
                    self.outlet.acknowledged(reply, outcome);
                }
                Command::Unacknowledge { id, by, reply } => {
                    let withdrawal = Withdrawal { at: self.now(), by };
                    let event = self.pipeline.monitor.unacknowledge(&id, withdrawal);
                    let outcome = self.acknowledged(&id, event);
                    self.outlet.acknowledged(reply, outcome);
                }
                other => self.operate(other),
            }
        }
        let now = self.now();
        let Self {
            posts,
            pipeline,
            recorder,
            unrecorded,
            ..
        } = self;
        posts.place(|claim| {
            if recorder.is_some() {
                unrecorded.claims.push(claim.clone());
            }
            pipeline.claims.insert(claim, now).refusal()
        });
    }

    /// Publishes what an operator changed; without a change the answer is what the journal has.
    fn acknowledged(&mut self, id: &str, event: Option<AlertEvent>) -> Acknowledged {
        if let Some(mut event) = event {
            self.state.name_evidence(&mut event.alert);
            let alert = event.alert.clone();
            self.outlet.events(vec![event], self.now());
            return Acknowledged::Done(Box::new(alert));
        }
        match self.journal.alert(id) {
            Ok(Some(alert)) if alert.state == AlertState::Cleared => Acknowledged::AlreadyCleared,
            Ok(Some(alert)) => Acknowledged::Done(Box::new(alert)),
            Ok(None) | Err(_) => Acknowledged::Unknown,
        }
    }

    /// Takes settings that were loaded again.
    pub(super) fn take_settings(&mut self) {
        let Ok(Settings {
            monitor,
            claims,
            places,
            taken,
        }) = self.settings.try_recv()
        else {
            return;
        };
        let put = places.put(&mut self.pipeline.monitor);
        let is_put = put.is_ok();
        drop(taken.send(put));
        if !is_put {
            return;
        }
        self.pipeline.reconfigure(&monitor, &claims);
        match (&mut self.follower, &claims.log) {
            (_, None) => self.follower = None,
            (Some(follower), Some(path)) => follower.change(path, &claims),
            (none, Some(path)) => {
                let follower = Follower::new(path, &claims);
                match ClaimsLog::new(follower, self.inbox.clone(), self.is_replay) {
                    Ok(log) => *none = Some(log),
                    Err(error) => tracing::error!(%error, "the claims log is not followed: no thread for it"),
                }
            }
        }
        self.claims_log = claims.log.map(|path| path.display().to_string());
    }

    /// Takes in what the claims log has gained.
    pub(super) fn follow_log(&mut self) {
        let mut again = false;
        while let Some(poll) = self.follower.as_mut().and_then(|log| log.next(again)) {
            let poll = match poll {
                Ok(poll) => poll,
                Err(error) => {
                    if !self.state.log_broken {
                        tracing::warn!(%error, "the claims log cannot be read");
                    }
                    self.state.log_broken = true;
                    return;
                }
            };
            self.state.log_broken = false;
            if poll.restarted {
                tracing::info!("the claims log was replaced; reading it from its start");
            }
            if poll.skipped_at_start_bytes > 0 {
                tracing::warn!(
                    bytes = poll.skipped_at_start_bytes,
                    "the claims log is longer than claims.tail_bytes; its beginning is not read"
                );
            }
            metrics::counter!(metric::CLAIMS_SKIPPED).increment(poll.skipped_at_start_bytes + poll.skipped_bytes);
            if let Some(first) = poll.refused.first() {
                let count = poll.refused_count;
                self.state.malformed += count;
                metrics::counter!(metric::CLAIMS, "outcome" => "malformed").increment(count);
                self.complain(first, count);
            }
            if self.is_replay {
                self.pipeline.claim(poll.claims, self.state.clock);
            }
            // A recording's first frame waits until the whole log has been read, so that no claim comes late.
            again = self.is_replay && self.state.counts.captured == 0;
            if !(poll.more && again) {
                return;
            }
        }
    }

    /// Names a line that is no claim, unless one was named a moment ago: a log of nothing else must not fill ours.
    fn complain(&mut self, first: &Refused, count: u64) {
        self.state.unnamed += count;
        if self.state.complained.is_some_and(|t| t.elapsed() < COMPLAIN_EVERY) {
            return;
        }
        let count = std::mem::take(&mut self.state.unnamed);
        self.state.complained = Some(Instant::now());
        let error = first.error.to_string();
        let error = escape_undisplayable(&error);
        tracing::warn!(line = first.line, %error, count, "lines of the claims log are no claims");
    }
}
