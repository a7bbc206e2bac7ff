use jiff::Timestamp;
use nalgebra::Vector2;
use serde_json::json;

use crate::claims::{Store, WINDOW_S, seconds};
use crate::monitor::alert::{AlertKind, Severity};
use crate::monitor::alert_lifecycle::{Cause, Finding};
use crate::monitor::input::claim_state::ActiveClaim;
use crate::monitor::monitor::{ESCALATE_S, Monitor};
use crate::monitor::rules::mismatch::claimed;
use crate::monitor::stats::claim_consistency::neg_log_p;
use crate::monitor::stats::error_budget::TestFamily;

/// Claims in a row that may be lost, and how much longer than the whole log one user may be silent.
const MOST_LOST: f64 = 20.0;
const USER_PATIENCE: f64 = 4.0;

impl Monitor {
    /// The health of what we are given: frames and claims.
    pub fn watch_inputs(&mut self, active: &[ActiveClaim], claims: &Store, now: Timestamp) {
        let lost = Cause::Whole(AlertKind::SensorLost);
        let blind_s = self.sensor.blind_s(now);
        if blind_s >= self.config.sensor_lost_s {
            let finding = Finding::new(Severity::Critical, self.sensor.evidence(now));
            self.alerts.report(&lost, finding, now, self.frame);
        } else if blind_s == 0.0 {
            self.alerts.absent(&lost, now);
        }
        self.watch_pose(now);
        self.watch_flood(claims, now);
        let stale = Cause::Whole(AlertKind::ClaimsStale);
        let period = self.period_s.unwrap_or(0.0);
        let limit = self.config.claims_stale_s.max(5.0 * period);
        let log_is_stale =
            self.alerts.is_open(&stale) || claims.quiet_s(now).is_some_and(|(came, made)| came.max(made) > limit);
        self.watch_users_claims(active, log_is_stale, now);
        match claims.quiet_s(now) {
            Some((came, made)) if came.max(made) > limit && self.expects_claims(active) => {
                let severity = if came.max(made) > 6.0 * limit {
                    Severity::Critical
                } else {
                    Severity::Warning
                };
                let evidence = json!({
                    "newest_came_s_ago": came,
                    "newest_made_s_ago": made,
                    "limit_s": limit,
                    "typical_period_s": period,
                });
                self.alerts
                    .report(&stale, Finding::new(severity, evidence), now, self.frame);
            }
            _ => self.alerts.absent(&stale, now),
        }
    }

    /// A beam whose user's claims have stopped while the others' go on: somebody may hold them back. Lost claims are no
    /// matter: thirty in a hundred lost at random leave a gap of twenty periods once in 10¹⁰.
    fn watch_users_claims(&mut self, active: &[ActiveClaim], log_is_stale: bool, now: Timestamp) {
        let period = self.period_s.unwrap_or(0.0);
        for a in active {
            let periods = MOST_LOST * a.period_s.unwrap_or(0.0).clamp(period, 10.0 * period.max(0.1));
            let limit = periods.max(USER_PATIENCE * self.config.claims_stale_s);
            if a.age_s <= limit && !a.has_alert {
                continue;
            }
            let cause = Cause::User(AlertKind::ClaimsStale, a.claim.user.clone());
            let user = self.users.get(&a.claim.user);
            let is_lit = user.is_some_and(|u| u.last_answered.is_some_and(|t| seconds(t, now) < 1.0));
            // The whole log's silence is one cause and not one a user.
            if a.ended || a.age_s <= limit || !is_lit || (log_is_stale && !self.alerts.is_open(&cause)) {
                self.alerts.absent(&cause, now);
                continue;
            }
            let evidence = json!({
                "newest_made_s_ago": a.age_s,
                "limit_s": limit,
                "typical_period_s": period,
            });
            let mut finding = Finding::new(Severity::Warning, evidence);
            finding.claimed = claimed(a);
            self.alerts.report(&cause, finding, now, self.frame);
        }
    }

    /// Claims that are refused or shed for want of room or time, or are more than a frame is held against.
    fn watch_flood(&mut self, claims: &Store, now: Timestamp) {
        let cause = Cause::Whole(AlertKind::ClaimsFlooded);
        let squeezed = claims.squeezed(now);
        if squeezed.total() == 0 && claims.left_out() == 0 {
            self.alerts.absent(&cause, now);
            return;
        }
        let lasted_s = self.alerts.raised_at(&cause).map_or(0.0, |since| seconds(since, now));
        let severity = if squeezed.shed_known > 0 || lasted_s >= ESCALATE_S {
            Severity::Critical
        } else {
            Severity::Warning
        };
        let claims_lost = squeezed.refused + squeezed.shed_new + squeezed.shed_known;
        let evidence = json!({
            "window_s": WINDOW_S,
            "claims_refused": squeezed.refused,
            "claims_shed": squeezed.shed_new,
            "claims_of_known_users_shed": squeezed.shed_known,
            "claims_lost_per_s": claims_lost as f64 / WINDOW_S as f64,
            "users_forgotten_early": squeezed.forgotten_early,
            "log_bytes_skipped": squeezed.skipped_bytes,
            "users": claims.len(),
            "max_users": claims.max_users(),
            "claims_in_view_not_considered": claims.left_out(),
        });
        self.alerts
            .report(&cause, Finding::new(severity, evidence), now, self.frame);
    }

    fn watch_pose(&mut self, now: Timestamp) {
        let cause = Cause::Whole(AlertKind::PoseInconsistent);
        let limit = self
            .config
            .pose_limit_m
            .unwrap_or(0.5 * self.config.tolerated_distance_m);
        let pose = self.pose.displacement();
        let (agreeing, of) = self.pose.support();
        let (place, worst) = self.worst_displacement();
        let neg_log_p = neg_log_p(worst, &self.floor(place), limit);
        let level = self.budget.level(TestFamily::PoseConsensus, 1.0);
        let is_open = self.alerts.is_open(&cause);
        if neg_log_p > level || (is_open && worst.norm() > 0.9 * limit) {
            let severity = if worst.norm() > 4.0 * limit {
                Severity::Critical
            } else {
                Severity::Warning
            };
            let evidence = json!({
                "shift_m": [pose.shift.x, pose.shift.y],
                "turned_deg": pose.turn.to_degrees(),
                "scale": 1.0 + pose.scale,
                "largest_in_view_m": worst.norm(),
                "limit_m": limit,
                "users_agreeing": agreeing,
                "users": of,
                "surprise": neg_log_p,
                "threshold": level,
            });
            self.alerts
                .report(&cause, Finding::new(severity, evidence), now, self.frame);
        } else {
            self.alerts.absent(&cause, now);
        }
    }

    /// Where in view our pose error displaces positions most, of the middle and the four edges, and by how much.
    fn worst_displacement(&self) -> (Vector2<f64>, Vector2<f64>) {
        let pose = self.pose.displacement();
        let [w, h] = [&self.camera.x, &self.camera.y].map(|axis| axis.half_width() * self.camera.ground_scale());
        [[0.0, 0.0], [w, 0.0], [-w, 0.0], [0.0, h], [0.0, -h]]
            .map(|[x, y]| Vector2::new(x, y))
            .map(|p| (p, pose.at(p)))
            .into_iter()
            .max_by(|a, b| a.1.norm().total_cmp(&b.1.norm()))
            .expect("five places")
    }

    /// A network without users has nothing to say.
    fn expects_claims(&self, active: &[ActiveClaim]) -> bool {
        active.iter().any(|a| !a.ended) || self.tracks.all.iter().any(|t| t.confirmed)
    }
}
