//! A small scene for the tests of rules: users, beams and a clock, all set by hand.

use jiff::{SignedDuration, Timestamp};
use nalgebra::Vector2;

use super::alert_lifecycle::AlertLifecycle;
use super::config::Config;
use super::finding::{Cause, Finding};
use super::frame_context::{FrameContext, Overload};
use super::input::claim_state::ActiveClaim;
use super::input::claim_state::fixture::active_claim;
use super::input::claim_timing::ClaimTiming;
use super::input::crowding::Crowding;
use super::input::sensor_health::SensorHealth;
use super::pose::consensus::PoseConsensus;
use super::stats::error_budget::ErrorBudget;
use super::track::association::{Association, Limits, UserTracks, associate};
use super::track::detection::Detection;
use super::track::detection::fixture::detection;
use super::track::eligibility::Eligibility;
use super::track::tracker::Tracker;
use crate::claims::{self, Store};
use crate::optics::{self, Camera};

pub struct Scene {
    pub now: Timestamp,
    pub config: Config,
    pub camera: Camera,
    pub budget: ErrorBudget,
    pub sensor: SensorHealth,
    pub timing: ClaimTiming,
    pub claims_quiet_s: Option<(f64, f64)>,
    pub overload: Overload,
    pub crowding: Crowding,
    pub store: Store,
    pub claims: Vec<ActiveClaim>,
    pub tracker: Tracker,
    pub association: Association,
    pub users: UserTracks,
    pub pose: PoseConsensus,
    pub alerts: AlertLifecycle,
}

impl Scene {
    /// Users u-0, u-1, … who claim once a second to be at these places, m; their beams have been there for two seconds, tracks 1,
    /// 2, …
    pub fn of_users(places: &[[f64; 2]]) -> Self {
        let claims: Vec<ActiveClaim> = places
            .iter()
            .enumerate()
            .map(|(k, [x, y])| active_claim(&format!("u-{k}"), *x, *y))
            .collect();
        let config = Config::default();
        let mut timing = ClaimTiming::default();
        timing.begin(Timestamp::UNIX_EPOCH);
        timing.update(&claims, &Crowding::default(), true, Timestamp::UNIX_EPOCH);
        let mut scene = Self {
            now: Timestamp::from_second(100).unwrap(),
            budget: ErrorBudget::new(&config, 10.0),
            config,
            camera: optics::Config::default().camera().unwrap(),
            sensor: SensorHealth::default(),
            timing,
            claims_quiet_s: Some((0.0, 0.0)),
            overload: Overload::default(),
            crowding: Crowding::default(),
            store: Store::new(&claims::Config::default()),
            association: Association::none(claims.len()),
            claims,
            tracker: Tracker::new(50.0),
            users: UserTracks::default(),
            pose: PoseConsensus::default(),
            alerts: AlertLifecycle::new("replay".into(), None, 60.0),
        };
        (0..20).for_each(|_| scene.show(places));
        scene
    }

    /// A frame 0.1 s later with beams at these places.
    pub fn show(&mut self, places: &[[f64; 2]]) {
        let beams: Vec<_> = places.iter().map(|[x, y]| detection(*x, *y)).collect();
        self.detect(&beams);
    }

    /// A frame 0.1 s later with these detections.
    pub fn detect(&mut self, beams: &[Detection]) {
        self.now += SignedDuration::from_millis(100);
        self.tracker.step(self.now, beams, 0.1);
        let limits = Limits {
            tolerated_m: self.config.tolerated_distance_m,
            claims_stale_s: self.config.claims_stale_s,
            period_s: self.timing.period_s(),
            is_log_stale: false,
        };
        for claim in &mut self.claims {
            claim.before = self.users.get(&claim.claim.user).copied().unwrap_or_default();
        }
        self.association = associate(&self.claims, &self.tracker, &limits, &self.eligibility());
        self.users.update(&self.claims, &self.association, self.now);
    }

    /// User `i` claims anew, to be at (`x`, `y`), m.
    pub fn claim(&mut self, i: usize, x: f64, y: f64) {
        let claim = &mut self.claims[i];
        (claim.claim.x_m, claim.claim.y_m) = (x, y);
        (claim.claim.time, claim.made) = (self.now, self.now);
        claim.position = Vector2::new(x, y);
    }

    pub fn context(&self) -> FrameContext<'_> {
        FrameContext {
            now: self.now,
            config: &self.config,
            camera: &self.camera,
            budget: &self.budget,
            sensor: &self.sensor,
            timing: &self.timing,
            clock_offset_s: 0.0,
            claims_quiet_s: self.claims_quiet_s,
            overload: self.overload,
            crowding: self.crowding,
            claims: &self.claims,
            tracker: &self.tracker,
            association: &self.association,
            users: &self.users,
            pose: &self.pose,
            alerts: &self.alerts,
        }
    }

    pub fn eligibility(&self) -> Eligibility<'_> {
        Eligibility {
            now: Some(self.now),
            crowding: self.crowding,
            alerts: &self.alerts,
            store: &self.store,
            decision_s: self.config.decision_s,
            tolerated_m: self.config.tolerated_distance_m,
        }
    }

    /// So many names are claimed in view without a beam.
    pub fn crowd(&mut self, names: f64) {
        self.crowding = Crowding::of_claims(&[], names, &self.camera);
    }

    /// The log says that `user` is at (`x`, `y`), m, now; gives the claim.
    pub fn hear(&mut self, user: &str, x: f64, y: f64) -> ActiveClaim {
        let mut claim = active_claim(user, x, y);
        (claim.claim.time, claim.made) = (self.now, self.now);
        self.store.insert(claim.claim.clone(), self.now);
        claim
    }

    pub fn apply(&mut self, findings: Vec<Finding>) {
        self.alerts.apply(findings, self.now, 0);
    }
}

/// The causes that are present.
pub fn present(findings: &[Finding]) -> Vec<&Cause> {
    let is_present = |f: &&Finding| matches!(f, Finding::Present(..));
    findings.iter().filter(is_present).map(Finding::cause).collect()
}

/// The causes that are absent.
pub fn absent(findings: &[Finding]) -> Vec<&Cause> {
    let is_absent = |f: &&Finding| matches!(f, Finding::Absent(_));
    findings.iter().filter(is_absent).map(Finding::cause).collect()
}
