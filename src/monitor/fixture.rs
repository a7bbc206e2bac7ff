//! A small scene for the tests of rules: users, beams and a clock, all set by hand.

use std::collections::BTreeSet;
use std::ops::{Deref, DerefMut};

use jiff::{SignedDuration, Timestamp};
use nalgebra::Vector2;

use super::config::{Config, Source};
use super::finding::{Cause, Finding};
use super::frame_context::FrameContext;
use super::input::claim_state::ActiveClaim;
use super::input::claim_state::fixture::active_claim;
use super::input::crowding::Crowding;
use super::track::association::associate;
use super::track::detection::Detection;
use super::track::detection::fixture::detection;
use super::track::eligibility::Eligibility;
use crate::claims::{self, Store};
use crate::optics;

/// No track is a known light's.
static NO_LIGHTS: BTreeSet<u64> = BTreeSet::new();

pub(super) struct Scene {
    pub frame: FrameContext,
    pub store: Store,
}

impl Deref for Scene {
    type Target = FrameContext;

    fn deref(&self) -> &FrameContext {
        &self.frame
    }
}

impl DerefMut for Scene {
    fn deref_mut(&mut self) -> &mut FrameContext {
        &mut self.frame
    }
}

impl Scene {
    /// Users u-0, u-1, … who claim once a second to be at these places, m; their beams have been there for two seconds, tracks 1,
    /// 2, …
    pub fn of_users(places: &[[f64; 2]]) -> Self {
        let camera = optics::Config::default().camera().unwrap();
        let source = Source {
            kind: "replay".into(),
            file: None,
            rate_hz: 10.0,
        };
        let claims = claims::Config::default();
        let mut frame = FrameContext::new(&Config::default(), &claims, &camera, source);
        frame.now = Timestamp::from_second(100).unwrap();
        frame.claims_quiet_s = Some((0.0, 0.0));
        let users = places.iter().enumerate();
        frame.claims = users
            .map(|(k, [x, y])| active_claim(&format!("u-{k}"), *x, *y))
            .collect();
        frame.timing.begin(Timestamp::UNIX_EPOCH);
        frame
            .timing
            .update(&frame.claims, &Crowding::default(), true, Timestamp::UNIX_EPOCH);
        let store = Store::new(&claims);
        let mut scene = Self { frame, store };
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
        let frame = &mut self.frame;
        frame.now += SignedDuration::from_millis(100);
        frame.tracker.step(frame.now, beams, 0.1);
        for claim in &mut frame.claims {
            claim.before = frame.users.get(&claim.claim.user).copied().unwrap_or_default();
        }
        self.frame.association = associate(&self.claims, &self.tracker, &self.eligibility());
        let frame = &mut self.frame;
        frame.users.update(&frame.claims, &frame.association, frame.now);
    }

    /// User `i` claims anew, to be at (`x`, `y`), m.
    pub fn claim(&mut self, i: usize, x: f64, y: f64) {
        let now = self.now;
        let claim = &mut self.claims[i];
        (claim.claim.x_m, claim.claim.y_m) = (x, y);
        (claim.claim.time, claim.made) = (now, now);
        claim.claimed = Vector2::new(x, y);
        claim.position = claim.claimed;
    }

    pub fn context(&self) -> &FrameContext {
        &self.frame
    }

    pub fn eligibility(&self) -> Eligibility<'_> {
        Eligibility {
            now: Some(self.now),
            config: &self.config,
            timing: &self.timing,
            crowding: self.crowding,
            alerts: &self.alerts,
            of_lights: &NO_LIGHTS,
            store: &self.store,
        }
    }

    /// So many names are claimed in view without a beam.
    pub fn crowd(&mut self, names: f64) {
        self.crowding = Crowding::of_claims(&[], names, &self.view);
    }

    /// The log says that `user` is at (`x`, `y`), m, now; gives the claim.
    pub fn hear(&mut self, user: &str, x: f64, y: f64) -> ActiveClaim {
        let mut claim = active_claim(user, x, y);
        (claim.claim.time, claim.made) = (self.now, self.now);
        self.store.insert(claim.claim.clone(), self.frame.now);
        claim
    }

    pub fn apply(&mut self, findings: Vec<Finding>) {
        let now = self.now;
        self.alerts.apply(findings, now, 0);
    }
}

/// The causes that are present.
pub(super) fn present(findings: &[Finding]) -> Vec<&Cause> {
    let is_present = |f: &&Finding| matches!(f, Finding::Present(..));
    findings.iter().filter(is_present).map(Finding::cause).collect()
}

/// The causes that are absent.
pub(super) fn absent(findings: &[Finding]) -> Vec<&Cause> {
    let is_absent = |f: &&Finding| matches!(f, Finding::Absent(_));
    findings.iter().filter(is_absent).map(Finding::cause).collect()
}
