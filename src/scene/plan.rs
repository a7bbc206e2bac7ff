//! The compiled scene, which makes frames.

use std::sync::Arc;

use jiff::{SignedDuration, Timestamp};
use ndarray::Array2;
use rayon::prelude::*;

use super::config::Scene;
use super::detector::Detector;
use super::effect::Effect;
use super::effects::{Fate, FrameLoss};
use super::error::Error;
use super::light::{Light, Shot};
use super::moment::Moment;
use super::network::{Network, Statement};
use super::platform::Telemetry;
use super::population::{Beam, Population};
use super::render::{Renderer, Spot};
use super::report;
use super::report::{Decision, Decisions, Status};
use super::stream::{Ledger, Streams};
use super::truth::{EmitterTruth, Role, SimulatedFrame, Truth};
use crate::claim::Claim;
use crate::frame::Frame;
use crate::optics::{Calibration, Camera};
use crate::pose::Pose;

/// A scene compiled with a seed into the cheapest chain that makes its frames.
#[derive(Debug)]
pub struct Plan {
    camera: Camera,
    rate_hz: f64,
    start: Timestamp,
    streams: Streams,
    population: Population,
    network: Network,
    light: Light,
    telemetry: Option<Telemetry>,
    detector: Detector,
    frame_loss: Option<FrameLoss>,
    decisions: Vec<Decision>,
}

/// Makes frames of a plan one after the other and reuses its buffers.
#[derive(Debug)]
pub struct Maker<'p> {
    plan: &'p Plan,
    ledger: Ledger,
    beams: Vec<Beam>,
    spots: Vec<Spot>,
    shot: Shot,
    renderer: Renderer,
}

/// Poses begin this long before the first frame, s.
const LEAD_S: f64 = 0.5;
/// Most earlier frames that are searched for the delivered one that a repeated frame shows.
const LOOK_BACK: u64 = 1000;

impl Plan {
    /// # Errors
    /// A field of the scene is out of range; it is named.
    pub fn compile(scene: &Scene, seed: u64) -> Result<Self, Error> {
        scene.validate()?;
        let camera = scene.optics.camera()?;
        let streams = Streams { seed };
        let ledger = Ledger::default();
        let thermal = scene.effects.thermal_noise.as_ref().and_then(|t| t.std_j);
        let mut decisions = Decisions::new(thermal.unwrap_or(camera.noise_std_j), scene.tolerance);
        let population = Population::new(scene, streams, &ledger);
        population.explain(&mut decisions);
        let network = Network::new(scene.claims.clone(), !scene.user.is_empty(), &mut decisions);
        let blur = format!("σ_eff = {:.4} mm, computed once", camera.spot_sigma_m * 1e3);
        decisions.note(Effect::Blur, Status::Folded, blur);
        let light = Light::new(scene, &camera, &population, streams, &mut decisions)?;
        let telemetry = scene.platform.as_ref().map(|p| Telemetry::new(p.telemetry.clone()));
        match &telemetry {
            Some(telemetry) => {
                let reason = format!("{} poses a second, noise drawn for each", telemetry.rate_hz());
                decisions.note(Effect::Telemetry, Status::On, reason);
            }
            None => decisions.note(Effect::Telemetry, Status::Off, "not in the scene"),
        }
        let detector = Detector::new(scene, &light, streams, &mut decisions)?;
        let frame_loss = decisions
            .weigh(Effect::FrameLoss, &scene.effects.frame_loss, |_| f64::INFINITY)
            .cloned();
        if frame_loss.is_some() {
            decisions.note(Effect::FrameLoss, Status::On, "one draw a frame");
        }
        let mut decisions = decisions.made;
        decisions.sort_by_key(|d| d.effect);
        Ok(Self {
            rate_hz: scene.rate_hz,
            start: Timestamp::UNIX_EPOCH,
            streams,
            population,
            network,
            light,
            telemetry,
            detector,
            frame_loss,
            decisions,
            camera,
        })
    }

    /// The same plan with frame 0 at `start` (the Unix epoch otherwise).
    pub fn starting_at(self, start: Timestamp) -> Self {
        Self { start, ..self }
    }

    /// The camera of the data sheet, `[optics]`.
    pub fn camera(&self) -> &Camera {
        &self.camera
    }

    /// The result of a perfect calibration of the camera.
    pub fn calibration(&self) -> Calibration {
        let lens = &self.light.lens;
        Calibration {
            distortion: lens.distortion,
            spot_sigma_m: lens.spot_sigma_m,
            spot_growth: lens.spot_growth,
            spot_shape: None,
            spot_error: None,
            noise_std_j: self.detector.noise_std_j().unwrap_or(lens.noise_std_j),
            quantum_j: None,
            pixels: self.detector.maps(lens.shape()).map(Arc::new),
        }
    }

    pub fn rate_hz(&self) -> f64 {
        self.rate_hz
    }

    /// The decision about each effect, with its reason.
    pub fn decisions(&self) -> &[report::Decision] {
        &self.decisions
    }

    /// Time of frame `k`, the middle of its exposure: start + k/rate.
    pub fn time(&self, k: u64) -> Timestamp {
        self.date(self.seconds(k))
    }

    /// Frame `k` with its truth and the claims that arrived since frame k − 1. Needs no other frame; the same seed gives
    /// the same bits. For many frames on one thread, a [`Maker`] spares the allocations.
    pub fn frame(&self, k: u64) -> SimulatedFrame {
        self.maker().frame(k)
    }

    /// Frames `from` to `until` − 1 on all threads; the same bits on any number of them.
    pub fn frames(&self, from: u64, until: u64) -> Vec<SimulatedFrame> {
        let range = (from..until).into_par_iter();
        range.map_init(|| self.maker(), |maker, k| maker.frame(k)).collect()
    }

    pub fn maker(&self) -> Maker<'_> {
        Maker {
            plan: self,
            ledger: Ledger::default(),
            beams: Vec::new(),
            spots: Vec::new(),
            shot: Shot::default(),
            renderer: Renderer::default(),
        }
    }

    /// The claims that arrived after frame k − 1 and not after frame k.
    pub fn claims(&self, k: u64) -> Vec<Claim> {
        self.claims_counting(k, &Ledger::default())
    }

    fn claims_counting(&self, k: u64, ledger: &Ledger) -> Vec<Claim> {
        // Sessions that began before frame 0 state their position with their next claim.
        let after = if k == 0 {
            -1.0 / self.rate_hz
        } else {
            self.seconds(k - 1)
        };
        let arrivals = self
            .network
            .arrivals(&self.population, after, self.seconds(k), self.streams, ledger);
        let claim = |s: Statement| Claim {
            time: self.date(s.stated),
            user: self.population.actors[s.actor].name.clone(),
            x_m: s.at_m[0],
            y_m: s.at_m[1],
            z_m: None,
            sigma_m: self.network.sigma_m(),
            cov_m2: None,
            power_w: None,
            state: s.state,
        };
        arrivals.into_iter().map(claim).collect()
    }

    /// The poses that came since frame k − 1, until the exposure of frame k ends; with frame 0 from half a second before it on.
    pub fn poses(&self, k: u64) -> Vec<Pose> {
        let after = if k == 0 { -LEAD_S } else { self.exposed(k - 1) };
        self.poses_between(after, self.exposed(k), &Ledger::default())
    }

    /// The poses of the half second after frame k.
    pub fn poses_after(&self, k: u64) -> Vec<Pose> {
        let last = self.exposed(k);
        self.poses_between(last, last + LEAD_S, &Ledger::default())
    }

    /// When the exposure of frame k ends, s: in its middle where nothing moves within it.
    fn exposed(&self, k: u64) -> f64 {
        self.seconds(k) + 0.5 * self.light.smears_over_s().unwrap_or(0.0)
    }

    fn poses_between(&self, after: f64, until: f64, ledger: &Ledger) -> Vec<Pose> {
        let (Some(telemetry), Some(flight)) = (&self.telemetry, self.light.flight()) else {
            return Vec::new();
        };
        let date = |t| self.date(t);
        telemetry.poses(flight, [after, until], date, self.streams, ledger)
    }

    /// The fate of frame `k`, and the frame whose pixels arrive in its place.
    fn fate(&self, k: u64, ledger: &Ledger) -> (Fate, u64) {
        let Some(loss) = &self.frame_loss else {
            return (Fate::Delivered, k);
        };
        let fate = |k| loss.fate(k, self.streams, ledger);
        match fate(k) {
            Fate::Repeated => {
                let earlier = (k.saturating_sub(LOOK_BACK)..k)
                    .rev()
                    .find(|j| fate(*j) == Fate::Delivered);
                earlier.map_or((Fate::Dropped, k), |j| (Fate::Repeated, j))
            }
            other => (other, k),
        }
    }

    fn seconds(&self, k: u64) -> f64 {
        k as f64 / self.rate_hz
    }

    fn date(&self, seconds: f64) -> Timestamp {
        let since = SignedDuration::try_from_secs_f64(seconds).unwrap_or(SignedDuration::MAX);
        self.start.checked_add(since).unwrap_or(Timestamp::MAX)
    }
}

impl Maker<'_> {
    /// [`Plan::frame`].
    pub fn frame(&mut self, k: u64) -> SimulatedFrame {
        let plan = self.plan;
        let mut pixels = Array2::zeros(plan.camera.shape());
        let (fate, seen) = plan.fate(k, &self.ledger);
        if seen != k {
            self.expose(seen, pixels.as_slice_mut().expect("a fresh array is contiguous"));
        }
        // The truth is that of frame k, whatever the camera handed out.
        let emitters = if seen == k && fate == Fate::Delivered {
            self.expose(k, pixels.as_slice_mut().expect("a fresh array is contiguous"))
        } else {
            self.cast(k)
        };
        if fate == Fate::Dropped {
            pixels.fill(f64::NAN);
        }
        let time = plan.time(k);
        SimulatedFrame {
            frame: Frame {
                index: k,
                time,
                pixels,
                masked: plan.detector.mask().cloned(),
                exposure_s: plan.light.smears_over_s(),
                energy_scale: 1.0,
            },
            truth: Truth {
                frame: k,
                time,
                emitters,
            },
            claims: plan.claims_counting(k, &self.ledger),
            poses: plan.poses(k),
            fate,
        }
    }

    /// Random words drawn so far.
    pub fn ledger(&self) -> &Ledger {
        &self.ledger
    }

    /// Adds what frame `k` reads out to `pixels`, zeros before, row-major (Ny, Nx), J.
    fn expose(&mut self, k: u64, pixels: &mut [f64]) -> Vec<EmitterTruth> {
        let emitters = self.cast(k);
        let plan = self.plan;
        for spot in &self.spots {
            match &plan.light.images {
                Some(images) => images.add(&plan.light.lens, spot, pixels),
                None => self.renderer.add(&plan.light.lens, spot, pixels),
            }
        }
        let at = Moment {
            k,
            t: plan.seconds(k),
            streams: plan.streams,
            ledger: &self.ledger,
        };
        plan.detector.read(&plan.light.lens, at, &mut self.renderer, pixels);
        emitters
    }

    /// Fills `self.spots` for frame `k`; returns its emitters.
    fn cast(&mut self, k: u64) -> Vec<EmitterTruth> {
        let plan = self.plan;
        let at = Moment {
            k,
            t: plan.seconds(k),
            streams: plan.streams,
            ledger: &self.ledger,
        };
        plan.population.beams(k, at.t, at.streams, at.ledger, &mut self.beams);
        plan.light.open(at, &mut self.shot);
        self.spots.clear();
        let mut emitters = Vec::with_capacity(self.beams.len());
        for beam in &self.beams {
            let energy_j = plan
                .light
                .cast(beam, &plan.population, at, &mut self.shot, &mut self.spots);
            let actor = beam.actor.map(|a| &plan.population.actors[a]);
            emitters.push(EmitterTruth {
                x_m: beam.ground[0],
                y_m: beam.ground[1],
                energy_j,
                user: actor.map(|a| a.name.clone()),
                role: actor.map_or(Role::Random, |a| a.role),
                in_view: plan.light.sees(beam.ground, &self.shot),
            });
        }
        emitters
    }
}
