use std::collections::BTreeSet;

use jiff::Timestamp;
use nalgebra::Vector2;
use serde_json::json;

use crate::claims::seconds;
use crate::monitor::alert::{AlertKind, Severity};
use crate::monitor::alert_lifecycle::{Cause, Finding};
use crate::monitor::input::claim_state::ActiveClaim;
use crate::monitor::input::claim_timing::median;
use crate::monitor::monitor::{ESCALATE_S, Monitor};
use crate::monitor::stats::co_location::{CoLocationTest, OtherBeams, Scatter};
use crate::monitor::stats::error_budget::TestFamily;
use crate::monitor::stats::second_moment::CommonMode;
use crate::monitor::stats::step_change::{CandidateSteps, TRIED};
use crate::monitor::track::kalman::largest_eigenvalue;
use crate::monitor::track::tracker::Track;

/// Users besides the one at hand whose median tells what befalls everybody.
const FEWEST_OTHERS: usize = 2;
/// Share of the level from which a beam's present is no longer taken into its past.
const SUSPECT: f64 = 0.2;
/// Resolutions within which one beam's light disturbs another's, and where it is lost may have become part of it.
const BESIDE: f64 = 3.0;

impl Monitor {
    /// Looks for a second beam within each user's spot.
    pub fn decide_co_located(&mut self, active: &[ActiveClaim], association: &[Option<u64>], now: Timestamp) {
        let level = self.budget.level(TestFamily::Blended, active.len() as f64);
        let watched: Vec<(usize, Track)> = (0..active.len())
            .filter_map(|i| Some((i, self.tracks.get(association[i]?)?.clone())))
            .filter(|(i, t)| t.hit && t.confirmed && !self.is_shared(*i, t, active, association))
            .map(|(i, t)| (i, self.with_whole_spot(t, association)))
            .collect();
        self.note_co_located(active, &watched);
        let brightening = self.config.tolerated_brightening;
        let patience_s = self.patience_s();
        let mut suspects = BTreeSet::new();
        for (i, track) in &watched {
            let name = &active[*i].claim.user;
            let cause = Cause::Spot(name.clone());
            let other_beams = self.other_beams(name, active, &watched);
            let is_accompanied = self.is_beside_unclaimed(track);
            let Some(user) = self.users.get_mut(name) else { continue };
            if is_accompanied {
                user.accompanied = Some(now);
            }
            let accompanied = user.accompanied;
            let seen = user.co_location.evaluate(brightening, &other_beams);
            let is_suspect = seen.neg_log_p() > SUSPECT * level;
            let began = match seen.stepped.neg_log_p > SUSPECT * level {
                true => seen.stepped.since.unwrap_or(now),
                false => now,
            };
            user.suspected_since = is_suspect.then(|| user.suspected_since.unwrap_or(now).min(began));
            let Some(suspected) = user.suspected_since else {
                continue;
            };
            let open = self.alerts.is_open(&cause);
            // A second beam may be a user's whose claim has yet to come.
            if !open && (seen.neg_log_p() <= level || seconds(suspected, now) < patience_s) {
                continue;
            }
            let past = user.co_location.past_energy();
            // One detection that goes astray does not part the two.
            if !open && accompanied.is_some_and(|t| seconds(t, now) < patience_s) {
                continue;
            }
            suspects.insert(name.clone());
            if !open && let Some(old) = self.alert_melted_into(track) {
                self.alerts.rename(&old, cause.clone());
            }
            let since = self.alerts.raised_at(&cause).unwrap_or(now);
            let severity = match seconds(since, now) >= ESCALATE_S {
                true => Severity::Critical,
                false => Severity::Warning,
            };
            let evidence = json!({
                "track": track.id,
                "shares_the_spot_of": name,
                "resolution_m": track.detection.resolution_m,
                "energy_j": track.detection.energy_j,
                "energy_over_the_past": {
                    "ratio": seen.brighter,
                    "surprise": seen.energy_neg_log_p,
                    "past_ln_j": past.map(|p| p.0),
                    "past_ln_std": past.map(|p| p.1),
                },
                "power_against_reported": self.against_reported(active, association, *i),
                "unrest_over_the_expected": { "ratio": seen.jitter_ratio, "surprise": seen.jitter_neg_log_p },
                "step_aside": {
                    "length_m": seen.stepped.length_m,
                    "surprise": seen.stepped.neg_log_p,
                    "since": seen.stepped.since,
                    "energy_surprise": seen.energy_after,
                    "unrest_surprise": seen.jitter_after,
                },
                "width_over_the_expected": { "moment_in_sigma2": seen.wider, "surprise": seen.width_neg_log_p },
                "surprise": seen.neg_log_p(),
                "threshold": level,
                "flags": track.detection.flags,
            });
            let finding = self.at_track(Finding::new(severity, evidence), track);
            self.alerts.report(&cause, finding, now, self.frame);
        }
        // A spot that cannot be judged now keeps its alert; one whose beam is gone does not.
        let unjudged = |name: &str| {
            let i = active.iter().position(|a| a.claim.user == name);
            let answered = i.is_some_and(|i| association[i].is_some());
            let watched = watched.iter().any(|(j, _)| Some(*j) == i);
            answered && !(watched && self.users.get(name).is_some_and(|u| u.co_location.is_judged()))
        };
        let over: Vec<Cause> = self
            .alerts
            .open()
            .filter_map(|(cause, _)| match cause {
                Cause::Spot(name) => Some((cause.clone(), name)),
                _ => None,
            })
            .filter(|(_, name)| !suspects.contains(*name) && !unjudged(name))
            .map(|(cause, _)| cause)
            .collect();
        for cause in over {
            self.alerts.absent(&cause, now);
        }
    }

    /// `track` with all the light of its spot that answers nobody else's claim.
    fn with_whole_spot(&self, mut track: Track, association: &[Option<u64>]) -> Track {
        let detection = &track.detection;
        let others = self.tracks.all.iter().filter(|t| {
            let near = &t.detection;
            let reach = detection.resolution_m + 2.0 * largest_eigenvalue(&near.cov).sqrt().min(detection.resolution_m);
            let is_near = (near.position - detection.position).norm() < reach;
            t.hit && t.id != track.id && is_near && !association.contains(&Some(t.id))
        });
        track.detection = detection.united(others.map(|t| &t.detection), &self.camera);
        track
    }

    /// Whether another user's beam may be in this spot, by tracks or by claims.
    fn is_shared(&self, i: usize, track: &Track, active: &[ActiveClaim], association: &[Option<u64>]) -> bool {
        let (here, reach) = (track.motion.position(), track.detection.resolution_m);
        self.confusion_m(track, association) > 0.0
            || (0..active.len())
                .filter(|&j| j != i && association[j].is_none())
                .filter(|&j| !self.crowding.is_crowded() || active[j].is_established)
                .any(|j| {
                    let a = &active[j];
                    let away = (a.position - here).norm() - a.slack_m - 2.0 * a.variance.sqrt();
                    away < reach + self.config.tolerated_distance_m || (a.is_unresolvable && away < self.overlap_m())
                })
    }

    fn note_co_located(&mut self, active: &[ActiveClaim], watched: &[(usize, Track)]) {
        let names: BTreeSet<&str> = watched.iter().map(|(i, _)| active[*i].claim.user.as_str()).collect();
        for (name, user) in &mut self.users {
            if !names.contains(name.as_str()) {
                user.co_location.pause();
            }
        }
        let jumps: Vec<_> = watched
            .iter()
            .map(|(i, track)| {
                let user = self.users.get_mut(&active[*i].claim.user)?;
                user.co_location.jump(track.last_hit, &track.detection)
            })
            .collect();
        let steps: Vec<CandidateSteps> = watched
            .iter()
            .map(|(i, track)| {
                let user = self.users.get_mut(&active[*i].claim.user);
                user.map_or_else(CandidateSteps::default, |u| {
                    u.co_location.steps.look(track.last_hit, &track.detection)
                })
            })
            .collect();
        let common_jump = common(jumps.iter().flatten().map(|jump| jump.by));
        let common_steps =
            std::array::from_fn::<_, { TRIED }, _>(|k| common(steps.iter().filter_map(|s| Some(s[k]?.aside))));
        for (((i, track), jump), steps) in watched.iter().zip(jumps).zip(steps) {
            if let Some(user) = self.users.get_mut(&active[*i].claim.user) {
                let jump = jump.map(|jump| jump.less(common_jump));
                let learn = user.suspected_since.is_none();
                user.co_location.note(track.last_hit, &track.detection, jump, learn);
                user.co_location.steps.note(&steps, &common_steps, learn);
            }
        }
    }

    fn other_beams(&self, name: &str, active: &[ActiveClaim], watched: &[(usize, Track)]) -> OtherBeams {
        let blends: Vec<(bool, &CoLocationTest)> = watched
            .iter()
            .map(|(i, _)| &active[*i].claim.user)
            .filter_map(|user| Some((user != name, &self.users.get(user)?.co_location)))
            .collect();
        let others = || blends.iter().filter(|(other, _)| *other).map(|(_, b)| b);
        let enough = |values: Vec<f64>| match values.len() >= FEWEST_OTHERS {
            true => median(values.into_iter()),
            false => None,
        };
        let scatters = blends.iter().map(|(_, b)| b.scatter());
        OtherBeams {
            moments: CommonMode::of(others().map(|b| &b.moment_test)),
            rise: enough(others().filter_map(|b| b.recent_rise()).collect()),
            jitter: enough(others().filter_map(|b| b.recent_jitter()).collect()),
            scatter: scatters.fold(Scatter::default(), |sum, s| Scatter {
                squares: sum.squares + s.squares,
                freedom: sum.freedom + s.freedom,
            }),
        }
    }

    /// Whether an emitter that has its alert stands so near that its light explains what is odd about this beam.
    fn is_beside_unclaimed(&self, track: &Track) -> bool {
        let here = track.motion.position();
        self.alerts.open().any(|(cause, _)| match cause {
            Cause::Track(AlertKind::UnclaimedEmitter, id) => self.tracks.get(*id).is_some_and(|t| {
                t.is_seen() && (t.motion.position() - here).norm() < BESIDE * track.detection.resolution_m
            }),
            _ => false,
        })
    }

    /// The alert of an emitter that can no longer be told apart from this beam: the same cause.
    fn alert_melted_into(&self, track: &Track) -> Option<Cause> {
        let here = track.motion.position();
        self.alerts.open().find_map(|(cause, alert)| {
            let Cause::Track(AlertKind::UnclaimedEmitter, id) = cause else {
                return None;
            };
            let away = (Vector2::new(alert.x_m?, alert.y_m?) - here).norm();
            let lost = self.tracks.get(*id).is_none_or(|t| !t.hit);
            (lost && away < BESIDE * track.detection.resolution_m).then(|| cause.clone())
        })
    }
}

/// What displacements have in common: nothing, where too few are known.
fn common(displacements: impl Iterator<Item = Vector2<f64>>) -> Vector2<f64> {
    let known: Vec<_> = displacements.collect();
    let axis = |k: usize| median(known.iter().map(|d| d[k])).unwrap_or(0.0);
    match known.len() > FEWEST_OTHERS {
        true => Vector2::new(axis(0), axis(1)),
        false => Vector2::zeros(),
    }
}
