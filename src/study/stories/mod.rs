//! Stories for the monitor: users that walk and claim, beams as an estimator would report them (truth plus an error of
//! the stated covariance), and whatever goes wrong. Nothing here knows how the monitor decides.

pub mod pixels;
mod telling;

pub use telling::{Told, claims, tally, tell, tell_with};

use crate::claim::Claim;
use crate::monitor::{AlertEvent, Config, Monitor};
use crate::optics::{self, Camera};
use jiff::{SignedDuration, Timestamp};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

pub type Path = Box<dyn Fn(f64) -> Option<[f64; 2]>>;

/// One beam and, where there is a name, one user's claims.
pub struct Actor {
    pub user: Option<String>,
    /// Where the beam comes from at a time, s; `None` while it is off.
    pub beam: Path,
    /// Where the claim says; `None` while nothing is claimed.
    pub claim: Path,
    pub period_s: f64,
    pub phase_s: f64,
    pub sigma_m: f64,
    pub states_sigma: bool,
    pub ended_at: Option<f64>,
    pub energy_j: f64,
    /// Factor on the energy at a time.
    pub glow: Box<dyn Fn(f64) -> f64>,
    /// Standard deviation of a frame's energy over its mean. A beam has 25 %.
    pub fading: f64,
    /// Second moment per axis of the light on the ground, m²: zero for a point.
    pub extent_m2: f64,
    /// The actor before this one that it is a reflection of: it fades with that.
    pub reflects: Option<usize>,
    /// Power that the claims state.
    pub reports_w: Option<f64>,
}

impl Actor {
    pub fn new(user: &str, path: impl Fn(f64) -> [f64; 2] + Clone + 'static) -> Self {
        let beam = path.clone();
        Self {
            user: Some(user.into()),
            beam: Box::new(move |t| Some(beam(t))),
            claim: Box::new(move |t| Some(path(t))),
            period_s: 1.0,
            phase_s: 0.0,
            sigma_m: 0.3,
            states_sigma: true,
            ended_at: None,
            energy_j: 0.007,
            glow: Box::new(|_| 1.0),
            fading: 0.25,
            extent_m2: 0.0,
            reflects: None,
            reports_w: None,
        }
    }

    pub fn intruder(path: impl Fn(f64) -> Option<[f64; 2]> + 'static) -> Self {
        Self {
            user: None,
            beam: Box::new(path),
            claim: Box::new(|_| None),
            ..Self::new("", |_| [0.0; 2])
        }
    }

    /// A light that nobody claims: steady to 2 %.
    pub fn lamp(path: impl Fn(f64) -> Option<[f64; 2]> + 'static) -> Self {
        Self {
            fading: 0.02,
            ..Self::intruder(path)
        }
    }

    pub fn beam(mut self, beam: impl Fn(f64) -> Option<[f64; 2]> + 'static) -> Self {
        self.beam = Box::new(beam);
        self
    }

    pub fn claim(mut self, claim: impl Fn(f64) -> Option<[f64; 2]> + 'static) -> Self {
        self.claim = Box::new(claim);
        self
    }
}

/// What the sensor does instead of showing the beams.
#[derive(Clone, Copy, PartialEq)]
pub enum Sensor {
    Fine,
    Nan,
    Zero,
    Saturated,
    Frozen,
    Nothing,
    LensCap,
}

pub struct Story {
    pub seed: u64,
    pub actors: Vec<Actor>,
    pub seconds: f64,
    pub rate_hz: f64,
    /// Standard deviation per axis of a fitted position, m.
    pub position_std_m: f64,
    pub detected: f64,
    /// Beams nearer than this come as one detection between them, m.
    pub resolution_m: f64,
    /// Chance of a spurious detection somewhere in a frame.
    pub ghosts: f64,
    /// Share of a claim's variance that wanders over a minute instead of being fresh in each claim.
    pub claim_wander: f64,
    pub shift: Box<dyn Fn(f64) -> [f64; 2]>,
    /// Relative error of scale, and turn in rad, that positions have beside the shift.
    pub turn: Box<dyn Fn(f64) -> [f64; 2]>,
    pub sensor: Box<dyn Fn(f64) -> Sensor>,
    /// When a claim made at a time comes in; `None` loses it.
    pub delivery: Box<dyn Fn(f64) -> Option<f64>>,
    pub monitor: Config,
    /// Claims beside the actors', with the time they come in.
    pub forged: Vec<(f64, Claim)>,
    /// The monitor is killed and started again then.
    pub restarts_at: Option<f64>,
    /// What the operator does before the frame at a time, after these events.
    pub operator: Box<dyn Fn(f64, &mut Monitor, &[AlertEvent])>,
}

impl Story {
    pub fn new(seed: u64, actors: Vec<Actor>) -> Self {
        Self {
            seed,
            actors,
            seconds: 30.0,
            rate_hz: 10.0,
            position_std_m: 0.02,
            detected: 0.998,
            resolution_m: 1.5,
            ghosts: 0.0,
            claim_wander: 0.0,
            shift: Box::new(|_| [0.0, 0.0]),
            turn: Box::new(|_| [0.0, 0.0]),
            sensor: Box::new(|_| Sensor::Fine),
            delivery: Box::new(Some),
            monitor: Config::default(),
            forged: Vec::new(),
            restarts_at: None,
            operator: Box::new(|_, _, _| {}),
        }
    }
}

/// Six users on gentle walks, far enough apart that they never meet.
pub fn crowd() -> Vec<Actor> {
    (0..6)
        .map(|k| {
            let (cx, cy) = (-80.0 + 80.0 * f64::from(k % 3), -50.0 + 100.0 * f64::from(k / 3));
            let phase = f64::from(k);
            let path = move |t: f64| {
                [
                    cx + 15.0 * (0.06 * t + phase).sin(),
                    cy + 15.0 * (0.05 * t + 2.0 * phase).cos(),
                ]
            };
            let mut actor = Actor::new(&format!("u-{k}"), path);
            actor.phase_s = 0.13 * f64::from(k);
            actor
        })
        .collect()
}

/// A random-waypoint walk inside the view: legs at 0.3 to 2.5 m/s, a third of the stops a minute's rest.
pub fn wander(seed: u64, seconds: f64) -> impl Fn(f64) -> [f64; 2] + Clone + 'static {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut place = || [rng.random_range(-110.0..110.0), rng.random_range(-110.0..110.0f64)];
    let (mut here, mut stops) = (place(), Vec::new());
    let mut legs = ChaCha8Rng::seed_from_u64(seed ^ 0x1e65);
    let mut t = 0.0;
    while t < seconds {
        stops.push((t, here));
        if legs.random::<f64>() < 0.33 {
            t += legs.random_range(5.0..60.0);
            stops.push((t, here));
        }
        let next = place();
        t += (next[0] - here[0]).hypot(next[1] - here[1]) / legs.random_range(0.3..2.5);
        here = next;
    }
    stops.push((t, here));
    let stops = std::rc::Rc::new(stops);
    move |t: f64| {
        let after = stops.partition_point(|(s, _)| *s <= t).clamp(1, stops.len() - 1);
        let ((ta, a), (tb, b)) = (stops[after - 1], stops[after]);
        let share = ((t - ta) / (tb - ta).max(1e-9)).clamp(0.0, 1.0);
        [a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1])]
    }
}

/// Honest users that join and leave; their claims' errors wander, their beams are missed now and then.
pub fn honest(seed: u64, seconds: f64) -> Story {
    let mut rng = ChaCha8Rng::seed_from_u64(seed ^ 0x0a0e57);
    let users = rng.random_range(3..10);
    let actors = (0..users)
        .map(|k| {
            let path = wander(seed * 16 + k, seconds);
            let mut actor = Actor::new(&format!("u-{k}"), path.clone());
            actor.sigma_m = rng.random_range(0.2..1.2);
            actor.states_sigma = rng.random::<f64>() < 0.9;
            actor.phase_s = rng.random_range(0.0..1.0);
            if rng.random::<f64>() < 0.3 {
                let joins: f64 = rng.random_range(5.0..0.4 * seconds);
                let leaves: f64 = rng.random_range(0.6 * seconds..0.95 * seconds);
                let beam = path.clone();
                // The network admits a user before the beam comes on, and notes the end when it goes off.
                actor.phase_s = joins;
                let on = joins + rng.random_range(0.0..0.5);
                let off = leaves + rng.random_range(0.0..1.5);
                actor.ended_at = Some(leaves);
                actor = actor.beam(move |t| (on..off).contains(&t).then(|| beam(t)));
            }
            actor
        })
        .collect();
    let mut story = Story::new(seed, actors);
    story.seconds = seconds;
    story.detected = 0.995;
    story.ghosts = 0.002;
    story.claim_wander = 0.5;
    story.position_std_m = 10f64.powf(rng.random_range(-2.0..0.0));
    let (a, b) = (rng.random_range(0.0..0.5), rng.random_range(0.02..0.5));
    story.shift = Box::new(move |t| [a * (b * t).sin(), a * (0.7 * b * t).cos()]);
    // Half a per cent of altitude, half a degree of heading, a quarter of a second.
    let off = [rng.random_range(-0.005..0.005), rng.random_range(-0.009..0.009)];
    story.turn = Box::new(move |_| off);
    let late = rng.random_range(0.0..0.25);
    story.delivery = Box::new(move |t| Some(t + late));
    story
}

pub fn start() -> Timestamp {
    "2026-11-21T08:00:00Z".parse().expect("a time")
}

pub fn at(t: f64) -> Timestamp {
    start() + SignedDuration::from_nanos((t * 1e9).round() as i64)
}

pub fn camera() -> Camera {
    optics::Config::default().camera().expect("the default is a camera")
}
