//! All known lights: which are in force, the track of each, and what the journal must keep of them.

use std::collections::BTreeSet;

use jiff::Timestamp;
use nalgebra::Vector2;

use super::light::{DEFAULT_RADIUS_M, KnownLight, LightError, LightSource, MAX_LIGHTS, RADIUS_M, Request};
use super::range::LightRange;
use super::state::{KnownLightStatus, LightState};
use crate::monitor::alert::{Alert, AlertKind, KNOWN_LIGHT};
use crate::monitor::alert_lifecycle::AlertLifecycle;
use crate::monitor::finding::Cause;
use crate::monitor::pose::displacement::Displacement;
use crate::monitor::stats::gaussian::largest_eigenvalue;
use crate::monitor::stats::robust::median_high;
use crate::monitor::track::association::Association;
use crate::monitor::track::tracker::Tracker;
use crate::monitor::track::user_tracks::COINCIDENCE_S;
use crate::time::seconds;

/// Standard deviations of a beam's position by which it may be outside of a light's radius.
const REACH: f64 = 3.0;
/// A light is at another's place within this share of the smaller radius.
const SAME_SHARE: f64 = 0.25;
/// Other lights from which their median is taken for what the air does to all.
const MIN_OTHERS: usize = 2;
/// Time without a frame that shows it after which a light counts as out, s, as for users who vanish.
const OUT_S: f64 = 0.35;

/// The known lights in force.
#[derive(Debug, Default)]
pub(in crate::monitor) struct KnownLights {
    lights: Vec<LightState>,
    changed: Vec<LightRecord>,
}

/// A change that the journal keeps.
#[derive(Clone, Debug, PartialEq)]
pub enum LightRecord {
    Put(Box<KnownLight>),
    Forgotten(String),
}

impl KnownLights {
    pub fn is_empty(&self) -> bool {
        self.lights.is_empty()
    }

    pub fn iter(&self) -> impl Iterator<Item = &LightState> {
        self.lights.iter()
    }

    pub fn iter_mut(&mut self) -> impl Iterator<Item = &mut LightState> {
        self.lights.iter_mut()
    }

    pub fn len(&self) -> usize {
        self.lights.len()
    }

    pub fn get(&self, id: &str) -> Option<&LightState> {
        self.lights.iter().find(|s| s.light.id == id)
    }

    /// Whether this is the place of a known light.
    pub fn has_at(&self, p: Vector2<f64>) -> bool {
        self.lights.iter().any(|s| (s.expected - p).norm() < s.light.radius_m)
    }

    /// The light that this track is associated with.
    pub fn of_track(&self, track: u64) -> Option<&LightState> {
        self.lights.iter().find(|s| s.is_seen && s.track == Some(track))
    }

    /// The lights' tracks, which no user's claim may take.
    pub fn tracks(&self) -> BTreeSet<u64> {
        self.lights.iter().filter_map(|s| s.track).collect()
    }

    /// Puts the config's lights in force in place of those of an earlier config.
    pub fn set_fixed(&mut self, lights: Vec<KnownLight>) {
        let mut before = Vec::new();
        self.lights.retain_mut(|s| {
            let is_fixed = s.light.source == LightSource::Config;
            if is_fixed {
                before.push((s.light.id.clone(), std::mem::take(&mut s.range)));
            }
            !is_fixed
        });
        for light in lights {
            let mut state = LightState::new(light);
            if let Some((_, range)) = before.iter_mut().find(|(id, _)| *id == state.light.id) {
                state.range = std::mem::take(range);
                state.take_learned();
            }
            self.lights.push(state);
        }
    }

    /// Takes over what the journal kept: approvals, and what was learned of the config's lights.
    pub fn restore(&mut self, kept: Vec<KnownLight>) {
        for light in kept {
            let has_room = self.lights.len() < MAX_LIGHTS;
            let known = self.lights.iter_mut().find(|s| s.light.id == light.id);
            match (known, light.source, &light.learned) {
                (Some(state), _, Some(learned)) => {
                    state.range = LightRange::remembered(learned.clone());
                    state.take_learned();
                }
                (None, LightSource::Api, _) if has_room => self.lights.push(LightState::new(light)),
                // A light that is no longer in the config.
                (None, LightSource::Config, _) => self.changed.push(LightRecord::Forgotten(light.id)),
                _ => {}
            }
        }
    }

    /// Approves a place, or the emitter of an open alert; an alert of a known light that changed has it learned anew.
    pub fn approve(
        &mut self,
        request: Request,
        alerts: &AlertLifecycle,
        displacement: Displacement,
    ) -> Result<KnownLight, LightError> {
        if let Some(until) = request.until.filter(|t| *t <= request.at) {
            return Err(LightError::Past {
                now: request.at,
                found: until,
            });
        }
        let (place, radius_m, alert) = match &request.place {
            Ok((place, radius_m)) => (*place, *radius_m, None),
            Err(id) => {
                let (cause, alert) = alerts
                    .open()
                    .find(|(_, alert)| alert.id == *id)
                    .ok_or_else(|| LightError::NoAlert(id.clone()))?;
                let seen = Vector2::from(place_of(cause, alert)?);
                let place = seen - displacement.at(seen);
                (place.into(), None, Some((cause.clone(), alert)))
            }
        };
        let again = alert
            .as_ref()
            .and_then(|(_, alert)| alert.evidence[KNOWN_LIGHT].as_str());
        let mut light = KnownLight {
            id: self.new_id(request.at),
            x_m: place[0],
            y_m: place[1],
            radius_m: radius_m.unwrap_or(DEFAULT_RADIUS_M),
            note: request.note,
            until: request.until,
            by: request.by,
            at: Some(request.at),
            alert: alert.as_ref().map(|(_, alert)| alert.id.clone()),
            source: LightSource::Api,
            is_radius_stated: radius_m.is_some(),
            learned: None,
        };
        light.check()?;
        if let Some(state) = again.and_then(|id| self.lights.iter_mut().find(|s| s.light.id == id)) {
            if state.light.source == LightSource::Config {
                return Err(LightError::Fixed(state.light.id.clone()));
            }
            light.id = state.light.id.clone();
            let (track, is_seen) = (state.track, state.is_seen);
            *state = LightState {
                track,
                is_seen,
                ..LightState::new(light.clone())
            };
        } else {
            let track = match &alert {
                Some((Cause::Track(id), _)) => Some(*id),
                _ => None,
            };
            self.check_place(&light, track)?;
            self.lights.push(LightState {
                track,
                ..LightState::new(light.clone())
            });
        }
        self.changed.push(LightRecord::Put(Box::new(light.clone())));
        Ok(light)
    }

    /// Ends an approval.
    pub fn revoke(&mut self, id: &str) -> Result<KnownLight, LightError> {
        let k = self
            .lights
            .iter()
            .position(|s| s.light.id == id)
            .ok_or_else(|| LightError::Unknown(id.chars().take(64).collect()))?;
        if self.lights[k].light.source == LightSource::Config {
            return Err(LightError::Fixed(id.to_owned()));
        }
        self.changed.push(LightRecord::Forgotten(id.to_owned()));
        Ok(self.lights.remove(k).light)
    }

    /// Ends the approvals whose time is over.
    pub fn expire(&mut self, now: Timestamp) {
        let changed = &mut self.changed;
        self.lights.retain(|s| {
            let is_over = s.light.until.is_some_and(|t| t <= now);
            if is_over {
                changed.push(LightRecord::Forgotten(s.light.id.clone()));
            }
            !is_over
        });
    }

    /// What the journal must keep since the last call.
    pub fn take_changed(&mut self) -> Vec<LightRecord> {
        std::mem::take(&mut self.changed)
    }

    /// Forgets which track is whose: the tracks are gone.
    pub fn forget_tracks(&mut self) {
        for state in &mut self.lights {
            (state.track, state.is_seen, state.is_displaced) = (None, false, false);
            (state.last_seen, state.gone_since, state.suspected_since) = (None, None, None);
        }
    }

    fn new_id(&self, at: Timestamp) -> String {
        let mut number = at.as_millisecond();
        while self.lights.iter().any(|s| s.light.id == format!("light-{number}")) {
            number += 1;
        }
        format!("light-{number}")
    }

    fn check_place(&self, light: &KnownLight, track: Option<u64>) -> Result<(), LightError> {
        if self.lights.len() >= MAX_LIGHTS {
            return Err(LightError::TooMany { limit: MAX_LIGHTS });
        }
        let is_same = |s: &&LightState| {
            let near = SAME_SHARE * s.light.radius_m.min(light.radius_m);
            let away = (s.light.x_m - light.x_m).hypot(s.light.y_m - light.y_m);
            away < near || (track.is_some() && s.track == track)
        };
        match self.lights.iter().find(is_same) {
            Some(other) => Err(LightError::Taken(other.light.id.clone())),
            None => Ok(()),
        }
    }

    /// Associates lights with the tracks that no user's claim is associated with. A light keeps its track however far that goes,
    /// unless there is another beam in its place; one with an alert of its own becomes a light's only by an approval.
    pub fn associate(
        &mut self,
        tracker: &Tracker,
        association: &mut Association,
        alerts: &AlertLifecycle,
        displacement: Displacement,
        now: Timestamp,
    ) {
        let mut pairs: Vec<(f64, usize, u64)> = Vec::new();
        for (k, state) in self.lights.iter_mut().enumerate() {
            state.is_seen = false;
            let place = Vector2::new(state.light.x_m, state.light.y_m);
            state.expected = place + displacement.at(place);
            for track in tracker
                .tracks
                .iter()
                .filter(|t| t.is_seen() && !association.contains(t.id))
            {
                let away_m = (track.filter.position() - state.expected).norm();
                let error_m = largest_eigenvalue(&track.filter.position_cov()).sqrt();
                let is_own = state.track == Some(track.id);
                let is_here = away_m <= state.light.radius_m + REACH * error_m;
                let is_alerted = state.last_seen.is_some() && alerts.is_open(&Cause::Track(track.id));
                let cost = match (is_own, is_here && !is_alerted) {
                    (true, true) => away_m - 2.0 * RADIUS_M.end(),
                    (true, false) => away_m + 1e6,
                    (false, true) => away_m,
                    (false, false) => continue,
                };
                pairs.push((cost, k, track.id));
            }
        }
        pairs.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)).then(a.2.cmp(&b.2)));
        for (_, k, track) in pairs {
            if !self.lights[k].is_seen && !association.contains(track) {
                self.lights[k].found(track, now);
                association.assign_light(track);
            }
        }
        for state in self.lights.iter_mut().filter(|s| !s.is_seen) {
            state.gone_since.get_or_insert(now);
            if state.track.is_some_and(|id| tracker.get(id).is_none()) {
                state.track = None;
            }
        }
    }

    /// The light that went out as, or within `within_s` before, a beam came on at `since` that nobody claims: the beam is
    /// associated with it from now on.
    pub fn displace(&mut self, track: u64, since: Timestamp, now: Timestamp, within_s: f64) -> bool {
        let gap = |s: &LightState| {
            let gone = s
                .gone_since
                .filter(|t| s.last_seen.is_some() && seconds(*t, now) >= OUT_S)?;
            let gap = seconds(gone, since);
            (gap >= -COINCIDENCE_S && seconds(gone, now) <= within_s).then_some(gap.abs())
        };
        let out = self.lights.iter_mut().filter_map(|s| Some((gap(s)?, s)));
        let nearest = out.min_by(|a, b| a.0.total_cmp(&b.0));
        let Some((_, state)) = nearest else {
            return false;
        };
        state.found(track, now);
        state.is_displaced = true;
        true
    }

    /// What the air does to the lights other than `id`, in ln energy.
    pub fn common_offset(&self, id: &str) -> f64 {
        let others = self.lights.iter().filter(|s| s.is_seen && s.light.id != id);
        let offsets: Vec<f64> = others.filter_map(|s| s.range.offset()).collect();
        match offsets.len() >= MIN_OTHERS {
            true => median_high(offsets.into_iter()).unwrap_or(0.0),
            false => 0.0,
        }
    }

    /// Takes up what the range of a light has become; the journal keeps it with `is_kept`.
    pub fn take_learned(&mut self, id: &str, is_kept: bool) {
        if let Some(state) = self.lights.iter_mut().find(|s| s.light.id == id) {
            state.take_learned();
            if is_kept {
                self.changed.push(LightRecord::Put(Box::new(state.light.clone())));
            }
        }
    }

    /// All lights for the API; `tolerated` is `[monitor] tolerated_brightening`.
    pub fn status(&self, tolerated: f64) -> Vec<KnownLightStatus> {
        let of = |s: &LightState| {
            let learned = s.range.learned();
            let widest = learned.map_or(1.0, |l| l.energy_j[1] / l.ln_energy.exp());
            let reach_m = s
                .range
                .place()
                .map_or(s.light.radius_m, |(_, m)| m.min(s.light.radius_m));
            KnownLightStatus {
                light: s.light.clone(),
                is_seen: s.is_seen,
                track: s.track.filter(|_| s.is_seen),
                last_seen: s.last_seen,
                unseen_share: tolerated * widest - 1.0,
                unseen_area_m2: std::f64::consts::PI * reach_m * reach_m,
            }
        };
        self.lights.iter().map(of).collect()
    }
}

/// Where the emitter of an alert is.
fn place_of(cause: &Cause, alert: &Alert) -> Result<[f64; 2], LightError> {
    let is_emitter = matches!(cause, Cause::Track(_) | Cause::KnownLight(_));
    let place = alert.x_m.zip(alert.y_m).filter(|_| is_emitter);
    place.map(|(x, y)| [x, y]).ok_or_else(|| LightError::NoEmitter {
        id: alert.id.clone(),
        kind: match alert.kind {
            AlertKind::UnclaimedEmitter => "a second beam in a user's spot",
            AlertKind::KnownLightChanged => "a known light that is not seen",
            _ => "no emitter that nobody claims",
        },
    })
}
