use jiff::Timestamp;
use nalgebra::{Matrix2, Vector2};
use serde_json::{Value, json};

use crate::claims::seconds;
use crate::monitor::alert::{AlertKind, Severity};
use crate::monitor::alert_lifecycle::{Cause, Finding};
use crate::monitor::input::claim_state::{ActiveClaim, User};
use crate::monitor::monitor::{COINCIDENCE_S, ESCALATE_S, Monitor, SYSTEMATIC_M};
use crate::monitor::stats::claim_consistency::{WINDOWS, neg_log_p};
use crate::monitor::stats::error_budget::TestFamily;

/// Frames in a row that must show a beam outside before a single claim's evidence stands.
const OUTSIDE_FRAMES: u32 = 3;
/// Users never seen at all that have an alert each; more of them within a cool-down have one cause, which is not theirs.
const MOST_NEVER_SEEN: usize = 10;
/// Names of them that the common alert gives.
const MOST_NAMES: usize = 20;

/// Users who are claimed and were never seen, too many for an alert each.
#[derive(Debug, Default)]
struct NeverSeen {
    names: Vec<String>,
    longest_s: f64,
    /// Users with an alert of their own, lately. Counted only when somebody asks.
    with_alert: Option<usize>,
}

impl Monitor {
    /// Adds the frame's and the new claims' evidence to what is known of each user.
    pub fn weigh(&mut self, active: &[ActiveClaim], association: &[Option<u64>], now: Timestamp) {
        let tolerated = self.config.tolerated_distance_m;
        let gate = self.budget.level(TestFamily::Mismatch, active.len() as f64);
        let displacement = self.pose.displacement();
        let unsure_s = self.unsure_of_clock_s(now);
        // Before everybody has claimed once our own pose and the log's clock are not known.
        let settled = self.claims_settled(now);
        for (a, answer) in active.iter().zip(association) {
            let track = answer.and_then(|id| self.tracks.get(id));
            let confusion_m = track.map_or(0.0, |t| self.confusion_m(t, association));
            let user = match self.users.get_mut(&a.claim.user) {
                Some(user) => user,
                None => self.users.entry(a.claim.user.clone()).or_default(),
            };
            let Some(track) = track else {
                user.outside = 0;
                if !a.expected || a.is_unresolvable {
                    user.unanswered_since = None;
                    user.absence = 0.0;
                } else {
                    user.unanswered_since.get_or_insert(now);
                    // A beam in view is missed by chance in one frame of ten at the worst.
                    user.absence += (1.0f64 / 0.1).ln();
                }
                continue;
            };
            user.track = Some(track.id);
            user.unanswered_since = None;
            user.absence = 0.0;
            user.first_answered.get_or_insert(now);
            user.last_answered = Some(now);
            if a.ended {
                continue;
            }
            let claimed = Vector2::new(a.claim.x_m, a.claim.y_m);
            let claimed = claimed + displacement.at(claimed);
            if user.residuals.newest().is_none_or(|t| t < a.claim.time) {
                let is_clear = track.confirmed && track.merged_into.is_none() && confusion_m == 0.0;
                if let Some(stamped) = track.at(a.claim.time).filter(|_| is_clear && !user.mismatched) {
                    user.clock.push(stamped - claimed, track.motion.velocity(), a.variance);
                }
                match track.at(a.made) {
                    Some(then) if is_clear && settled => {
                        let beam = track.motion.position_cov();
                        user.residuals.push(a.claim.time, then - claimed, beam, a.variance);
                    }
                    _ if track.confirmed => user.residuals.skip(a.claim.time),
                    _ => {}
                }
            }
            let floor = Matrix2::identity() * (SYSTEMATIC_M.powi(2) + self.pose.variance(a.position));
            let cov = track.motion.position_cov() + Matrix2::identity() * a.variance + floor;
            let offset = track.motion.position() - a.position;
            let reach = tolerated + a.slack_m + confusion_m + unsure_s * track.motion.velocity().norm();
            let is_outside = track.hit && track.confirmed && neg_log_p(offset, &cov, reach) > gate;
            user.outside = if is_outside { user.outside + 1 } else { 0 };
        }
        let alerts = &self.alerts;
        self.users.retain(|name, _| {
            is_present(active, name)
                || [
                    AlertKind::PositionMismatch,
                    AlertKind::UserUnseen,
                    AlertKind::ClaimsStale,
                ]
                .iter()
                .any(|k| alerts.is_open(&Cause::User(*k, name.clone())))
                || alerts.is_open(&Cause::Spot(name.clone()))
        });
    }

    pub fn decide_users(&mut self, active: &[ActiveClaim], association: &[Option<u64>], now: Timestamp) {
        let each = (active.len() * WINDOWS.len()) as f64;
        let level = self
            .budget
            .level_every(self.period_s.unwrap_or(0.0), TestFamily::Mismatch, each);
        let level_unseen = self.budget.level(TestFamily::Unseen, active.len() as f64);
        let mut never_seen = NeverSeen::default();
        for (i, a) in active.iter().enumerate() {
            self.decide_mismatch(active, association, i, level, now);
            self.decide_unseen(a, level_unseen, &mut never_seen, now);
        }
        self.decide_never_seen(never_seen, now);
        let orphans: Vec<Cause> = self
            .alerts
            .open()
            .filter(|(c, _)| matches!(c, Cause::User(_, user) if !is_present(active, user)))
            .map(|(c, _)| c.clone())
            .collect();
        for cause in orphans {
            self.alerts.absent(&cause, now);
        }
    }

    fn decide_mismatch(
        &mut self,
        active: &[ActiveClaim],
        association: &[Option<u64>],
        i: usize,
        level: f64,
        now: Timestamp,
    ) {
        let a = &active[i];
        if association[i].is_none() && !a.was_seen() && !a.has_alert {
            return;
        }
        let tolerated = self.config.tolerated_distance_m;
        let floor = self.floor(a.position);
        let cause = Cause::User(AlertKind::PositionMismatch, a.claim.user.clone());
        let track = association[i].and_then(|id| self.tracks.get(id));
        let unsure_s = self.unsure_of_clock_s(now);
        let settled = self.claims_settled(now);
        let Some(user) = self.users.get_mut(&a.claim.user) else {
            return;
        };
        if user.mismatched && user.outside == 0 && user.residuals.agree(2, tolerated) {
            // What told of the mismatch is over and must not tell of another one.
            user.residuals.forget();
            user.mismatched = false;
            user.displaced = false;
        }
        let unsure = track.map_or(0.0, |t| unsure_s * t.motion.velocity().norm());
        let excess = user.residuals.excess(tolerated + unsure, &floor);
        user.mismatched |= settled && (user.outside >= OUTSIDE_FRAMES || excess.neg_log_p > level);
        let Some(track) = track.filter(|_| !a.ended && user.mismatched) else {
            self.alerts.absent(&cause, now);
            return;
        };
        let distance = (track.motion.position() - a.position).norm();
        let (is_displaced, outside) = (user.displaced, user.outside);
        let severity = if is_displaced || distance > 2.0 * tolerated {
            Severity::Critical
        } else {
            Severity::Warning
        };
        let evidence = json!({
            "track": track.id,
            "distance_m": distance,
            "tolerated_distance_m": tolerated,
            "surprise": excess.neg_log_p,
            "threshold": level,
            "claims_in_window": excess.window,
            "mean_distance_m": excess.distance_m,
            "frames_outside": outside,
            "clock_offset_s": self.ahead_s,
            "answered_from_elsewhere": is_displaced,
            "power_against_reported": self.against_reported(active, association, i),
        });
        let mut finding = self.at_track(Finding::new(severity, evidence), track);
        finding.claimed = claimed(a);
        self.alerts.report(&cause, finding, now, self.frame);
    }

    fn decide_unseen(&mut self, a: &ActiveClaim, level: f64, never_seen: &mut NeverSeen, now: Timestamp) {
        let Some(user) = self.users.get(&a.claim.user) else {
            return;
        };
        let gone_s = user.unanswered_since.map_or(0.0, |t| seconds(t, now));
        let claimed_since = user
            .unanswered_since
            .is_some_and(|t| a.claim.time > t || user.last_answered.is_none());
        let is_unseen = a.expected
            && user.absence >= level
            && gone_s >= self.config.decision_s
            && claimed_since
            && self.claims_settled(now)
            && !self.awaits_unassociated(user, gone_s);
        if !is_unseen && !a.has_alert {
            return;
        }
        let cause = Cause::User(AlertKind::UserUnseen, a.claim.user.clone());
        let goes_on = self.alerts.is_open(&cause) && a.expected && user.absence > 0.0;
        if !is_unseen && !goes_on {
            self.alerts.absent(&cause, now);
            return;
        }
        if user.last_answered.is_none() && !self.alerts.is_open(&cause) {
            let with_alert = never_seen
                .with_alert
                .get_or_insert_with(|| self.alerts.users_lately(AlertKind::UserUnseen, now));
            if *with_alert >= MOST_NEVER_SEEN || self.alerts.is_open(&Cause::Whole(AlertKind::UserUnseen)) {
                never_seen.names.push(a.claim.user.clone());
                never_seen.longest_s = never_seen.longest_s.max(gone_s);
                return;
            }
            *with_alert += 1;
        }
        let severity = severity_after(gone_s);
        let evidence = json!({
            "unseen_s": gone_s,
            "last_seen": user.last_answered,
            "log_likelihood_ratio": user.absence,
            "threshold": level,
        });
        let mut finding = Finding::new(severity, evidence);
        finding.claimed = claimed(a);
        self.alerts.report(&cause, finding, now, self.frame);
    }

    /// One alert for all who were never seen, beyond the first few: who floods the log with invented users must not bury
    /// the alerts of others. A user who was ever seen always has their own.
    fn decide_never_seen(&mut self, never_seen: NeverSeen, now: Timestamp) {
        let cause = Cause::Whole(AlertKind::UserUnseen);
        self.never_seen = never_seen.names;
        if self.never_seen.is_empty() {
            self.alerts.absent(&cause, now);
            return;
        }
        let evidence = json!({
            "users_never_seen": self.never_seen.len(),
            "users": &self.never_seen[..self.never_seen.len().min(MOST_NAMES)],
            "unseen_s": never_seen.longest_s,
        });
        let finding = Finding::new(severity_after(never_seen.longest_s), evidence);
        self.alerts.report(&cause, finding, now, self.frame);
    }

    /// Whether a beam that came as the user went is still being judged: it may be the user answering from elsewhere, which is
    /// one alert and not two. New beams without end put the verdict off by no more than a coincidence lasts.
    fn awaits_unassociated(&self, user: &User, gone_s: f64) -> bool {
        let Some(gone) = user.unanswered_since else {
            return false;
        };
        gone_s < self.config.decision_s + COINCIDENCE_S
            && self.unassociated_since.iter().any(|(id, since)| {
                let coincides = seconds(gone, *since).abs() <= COINCIDENCE_S;
                coincides && !self.alerts.is_open(&Cause::Track(AlertKind::UnclaimedEmitter, *id))
            })
    }
}

/// Whether the user has a claim in the frame; claims come by name.
fn is_present(active: &[ActiveClaim], user: &str) -> bool {
    active.binary_search_by(|a| a.claim.user.as_str().cmp(user)).is_ok()
}

fn severity_after(gone_s: f64) -> Severity {
    if gone_s >= ESCALATE_S {
        Severity::Critical
    } else {
        Severity::Warning
    }
}

pub fn claimed(a: &ActiveClaim) -> Option<Value> {
    Some(json!({
        "x_m": a.claim.x_m,
        "y_m": a.claim.y_m,
        "sigma_m": a.claim.sigma_m,
        "time": a.claim.time,
    }))
}
