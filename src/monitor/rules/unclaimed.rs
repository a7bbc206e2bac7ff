use jiff::Timestamp;
use nalgebra::Vector2;
use serde_json::{Value, json};

use crate::claims::seconds;
use crate::monitor::alert::SAME_PLACE_M;
use crate::monitor::alert::{AlertKind, Severity};
use crate::monitor::alert_lifecycle::{Cause, Finding};
use crate::monitor::evidence::likelihood_ratio;
use crate::monitor::input::claim_state::ActiveClaim;
use crate::monitor::input::claim_timing::median;
use crate::monitor::monitor::{COINCIDENCE_S, ESCALATE_S, Monitor};
use crate::monitor::track::tracker::Track;

/// ln likelihood ratio from which a user counts as vanished: three frames in a row.
const VANISHED: f64 = 6.9;
/// Share of the time to decide that a beam is given to be claimed; the rest is for frames that miss it, and for a beam that comes on
/// within another's spot and is seen only as it walks out.
const PATIENCE: f64 = 0.65;

impl Monitor {
    /// Notes since when each beam has had no claim.
    pub fn note_unassociated(&mut self, association: &[Option<u64>], now: Timestamp) {
        let tracks = &self.tracks;
        self.unassociated_since.retain(|id, _| tracks.get(*id).is_some());
        for track in &self.tracks.all {
            if association.contains(&Some(track.id)) {
                self.unassociated_since.remove(&track.id);
            } else if track.hit && track.unresolved_from.is_none() {
                self.unassociated_since.entry(track.id).or_insert(now);
            }
        }
    }

    /// How long what may be a user's waits for a claim.
    pub fn patience_s(&self) -> f64 {
        PATIENCE * self.config.decision_s + self.delay_s
    }

    pub fn decide_unclaimed(&mut self, active: &[ActiveClaim], association: &mut [Option<u64>], now: Timestamp) {
        let settled = self.claims_settled(now);
        let patience = self.patience_s();
        let candidates: Vec<Track> = self
            .tracks
            .all
            .iter()
            .filter(|t| self.unassociated_since.contains_key(&t.id))
            .cloned()
            .collect();
        for track in &candidates {
            let cause = Cause::Track(AlertKind::UnclaimedEmitter, track.id);
            let since = self.unassociated_since[&track.id];
            let open = self.alerts.is_open(&cause);
            let ripe = settled
                && track.hit
                && track.unresolved_from.is_none()
                && track.confirmed
                && track.score >= self.level_unclaimed
                && seconds(since, now) >= patience;
            if !open && !ripe {
                continue;
            }
            if !open {
                if let Some(i) = self.displaced_user(active, association, since) {
                    association[i] = Some(track.id);
                    let user = self.users.entry(active[i].claim.user.clone()).or_default();
                    user.track = Some(track.id);
                    user.unanswered_since = None;
                    user.absence = 0.0;
                    user.displaced = true;
                    self.unassociated_since.remove(&track.id);
                    continue;
                }
                if let Some(old) = self.lost_alert_near(track) {
                    self.alerts.rename(&old, cause.clone());
                }
            }
            if track.hit {
                let finding = self.unclaimed(active, track, since, now);
                self.alerts.report(&cause, finding, now, self.frame);
            }
        }
        let open: Vec<(Cause, u64)> = self
            .alerts
            .open()
            .filter_map(|(c, _)| match c {
                Cause::Track(_, id) => Some((c.clone(), *id)),
                _ => None,
            })
            .collect();
        for (cause, id) in open {
            let still = self.tracks.get(id).is_some_and(Track::is_seen) && self.unassociated_since.contains_key(&id);
            if !still {
                match self.swapped_with(id, association) {
                    Some(other) => {
                        self.unassociated_since.insert(other, now);
                        self.alerts
                            .rename(&cause, Cause::Track(AlertKind::UnclaimedEmitter, other));
                    }
                    None => self.alerts.absent(&cause, now),
                }
            }
        }
    }

    /// The beam without a claim in the spot that track `id` is in, when `id` itself answers one: where two beams melt, which
    /// is whose is a guess, and that one of them is nobody's is not.
    fn swapped_with(&self, id: u64, association: &[Option<u64>]) -> Option<u64> {
        let track = self.tracks.get(id).filter(|_| association.contains(&Some(id)))?;
        let here = track.motion.position();
        let reach = 2.0 * track.detection.resolution_m;
        let others = self.tracks.all.iter().filter(|t| {
            let cause = Cause::Track(AlertKind::UnclaimedEmitter, t.id);
            t.id != id
                && t.is_seen()
                && t.confirmed
                && !association.contains(&Some(t.id))
                && !self.alerts.is_open(&cause)
        });
        let near = others.filter(|t| (t.motion.position() - here).norm() < reach);
        near.map(|t| t.id).next()
    }

    /// A user whose beam vanished as this one appeared, or who has not been seen yet. Where several have not been seen, which
    /// of them it is would be a guess, and the beam is nobody's.
    fn displaced_user(&self, active: &[ActiveClaim], association: &[Option<u64>], since: Timestamp) -> Option<usize> {
        let seen = |i: usize| {
            let user = self.users.get(&active[i].claim.user);
            user.is_some_and(|u| u.last_answered.is_some())
        };
        let candidates = (0..active.len())
            .filter(|&i| association[i].is_none() && active[i].expected)
            .filter_map(|i| {
                let name = &active[i].claim.user;
                if self.alerts.is_open(&Cause::User(AlertKind::UserUnseen, name.clone())) {
                    return None;
                }
                let user = self.users.get(name)?;
                let gap = seconds(user.unanswered_since?, since).abs();
                (user.absence >= VANISHED && gap <= COINCIDENCE_S).then_some((i, gap))
            });
        let (known, new): (Vec<_>, Vec<_>) = candidates.partition(|(i, _)| seen(*i));
        let candidates = if known.is_empty() && new.len() == 1 { new } else { known };
        let nearest = candidates.into_iter().min_by(|a, b| a.1.total_cmp(&b.1));
        nearest.map(|(i, _)| i)
    }

    /// An open alert near here whose own track was lost, or took the place of the beam that answered a claim: the same cause.
    fn lost_alert_near(&self, track: &Track) -> Option<Cause> {
        let p = track.motion.position();
        self.alerts.open().find_map(|(cause, alert)| {
            let lost = match cause {
                Cause::Track(AlertKind::UnclaimedEmitter, id) => {
                    !self.unassociated_since.contains_key(id) || self.tracks.get(*id).is_none_or(|t| !t.hit)
                }
                Cause::Spot(_) => true,
                _ => return None,
            };
            let (x, y) = (alert.x_m?, alert.y_m?);
            (lost && (p - Vector2::new(x, y)).norm() < SAME_PLACE_M).then(|| cause.clone())
        })
    }

    /// What else tells of an eavesdropper, each with its likelihood ratio against an honest stray beam.
    fn unclaimed(&self, active: &[ActiveClaim], track: &Track, since: Timestamp, now: Timestamp) -> Finding {
        let lasted = seconds(since, now);
        let here = track.motion.position();
        let nearest = active
            .iter()
            .filter(|a| !a.ended)
            .map(|a| (a, (a.position - here).norm()))
            .min_by(|a, b| a.1.total_cmp(&b.1));
        let [width, height] =
            [self.camera.x.half_width(), self.camera.y.half_width()].map(|h| 2.0 * h * self.camera.ground_scale());
        let beside = nearest.map(|(a, distance)| {
            // One who wants a user's light stands within its spot; one who does not is anywhere in view.
            let spot = 3.0 * self.spot_m();
            let by_chance = (std::f64::consts::PI * spot * spot * active.len() as f64 / (width * height)).min(1.0);
            json!({
                "user": a.claim.user,
                "distance_m": distance,
                "likelihood_ratio": if distance <= spot { 1.0 / by_chance } else { 0.5 },
                "second_beam_for_claim": distance <= self.config.tolerated_distance_m + a.slack_m,
            })
        });
        let vanished: Vec<Value> = active
            .iter()
            .filter(|a| !self.crowding.is_crowded() || a.was_seen())
            .filter_map(|a| {
                let gone = self.users.get(&a.claim.user)?.unanswered_since?;
                let gap = seconds(gone, since).abs();
                // Absences come perhaps once an hour and user: one within the gap by chance is that rare.
                let by_chance = (2.0 * gap.max(0.1) / 3600.0).min(1.0);
                Some(json!({ "user": a.claim.user, "apart_s": gap, "likelihood_ratio": 0.5 / by_chance }))
            })
            .collect();
        let usual = median(
            self.users
                .values()
                .filter_map(|u| Some(self.tracks.get(u.track?)?.detection.energy_j)),
        );
        let energy = usual.map(|usual| {
            let off = (track.detection.energy_j.max(1e-30) / usual.max(1e-30)).ln();
            json!({ "users_median_j": usual, "likelihood_ratio": likelihood_ratio(off) })
        });
        let severity = if lasted >= ESCALATE_S {
            Severity::Critical
        } else {
            Severity::Warning
        };
        let evidence = json!({
            "track": track.id,
            "seen_since": track.since,
            "unclaimed_s": lasted,
            "log_likelihood_ratio": track.score,
            "threshold": self.level_unclaimed,
            "energy_j": track.detection.energy_j,
            "energy_against_users": energy,
            "nearest_user": beside,
            "vanished_users": vanished,
            "flags": track.detection.flags,
        });
        self.at_track(Finding::new(severity, evidence), track)
    }
}
