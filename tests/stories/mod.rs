//! Stories for the monitor: users that walk and claim, beams as an estimator would report them (truth plus an error of
//! the stated covariance), and whatever goes wrong. Nothing here knows how the monitor decides.
#![allow(dead_code, reason = "each test file tells other stories")]

mod expected;

use std::collections::BTreeMap;

use jiff::{SignedDuration, Timestamp};
use oapwatch::claim::{Claim, ClaimState};
use oapwatch::claims::{self, Store};
use oapwatch::estimate::{Emitter, Error, Estimate, Flags};
use oapwatch::monitor::{
    AlertEvent, AlertEventKind, AlertKind, AlertState, Config, Monitor, Observation, Report, Source,
};
use oapwatch::optics::{self, Camera};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, Normal};

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
        }
    }

    pub fn intruder(path: impl Fn(f64) -> Option<[f64; 2]> + 'static) -> Self {
        Self {
            user: None,
            beam: Box::new(path),
            claim: Box::new(|_| None),
            period_s: 1.0,
            phase_s: 0.0,
            sigma_m: 0.3,
            states_sigma: true,
            ended_at: None,
            energy_j: 0.007,
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
    "2026-11-21T08:00:00Z".parse().unwrap()
}

pub fn at(t: f64) -> Timestamp {
    start() + SignedDuration::from_nanos((t * 1e9).round() as i64)
}

pub fn camera() -> Camera {
    optics::Config::default().camera().unwrap()
}

/// What the monitor said.
pub struct Told {
    pub events: Vec<AlertEvent>,
    pub reports: Vec<Report>,
    pub store: Store,
}

impl Told {
    /// (kind, user, seconds) of every alert raised.
    pub fn raised(&self) -> Vec<(AlertKind, Option<String>, f64)> {
        self.of(AlertEventKind::Raised)
    }

    pub fn cleared(&self) -> Vec<(AlertKind, Option<String>, f64)> {
        self.of(AlertEventKind::Cleared)
    }

    fn of(&self, kind: AlertEventKind) -> Vec<(AlertKind, Option<String>, f64)> {
        self.events
            .iter()
            .filter(|e| e.event == kind)
            .map(|e| {
                let time = e.alert.cleared_at.filter(|_| kind == AlertEventKind::Cleared);
                let time = time.unwrap_or(e.alert.raised_at);
                (
                    e.alert.kind,
                    e.alert.user.clone(),
                    time.duration_since(start()).as_secs_f64(),
                )
            })
            .collect()
    }

    pub fn ndjson(&self) -> String {
        self.events
            .iter()
            .map(|e| serde_json::to_string(e).unwrap() + "\n")
            .collect()
    }

    /// Exactly these were raised, each within its interval, and nothing else.
    #[track_caller]
    pub fn expect(&self, expected: &[(AlertKind, Option<&str>, f64, f64)]) {
        expected::expect(&self.raised(), expected, &self.ndjson());
    }
}

/// Detections of one frame: beams that are too near each other melt into one.
fn detect(story: &Story, t: f64, rng: &mut ChaCha8Rng) -> Vec<Emitter> {
    let camera = camera();
    let shift = (story.shift)(t);
    let [s, a] = (story.turn)(t);
    let mut spots: Vec<([f64; 2], f64)> = Vec::new();
    for actor in &story.actors {
        let Some([x, y]) = (actor.beam)(t) else { continue };
        let p = [x + shift[0] + s * x - a * y, y + shift[1] + a * x + s * y];
        if !camera.sees(p) || rng.random::<f64>() >= story.detected {
            continue;
        }
        // Ten coherence times a frame: 29 % scintillation.
        let fading = Normal::<f64>::new(1.0, 0.25).unwrap().sample(rng).clamp(0.3, 2.5);
        spots.push((p, actor.energy_j * fading));
    }
    if rng.random::<f64>() < story.ghosts {
        spots.push(([rng.random_range(-120.0..120.0), rng.random_range(-120.0..120.0)], 1e-3));
    }
    let mut merged: Vec<([f64; 2], f64)> = Vec::new();
    'spots: for (p, energy) in spots {
        for (q, sum) in &mut merged {
            if (p[0] - q[0]).hypot(p[1] - q[1]) < story.resolution_m {
                let share = energy / (*sum + energy);
                *q = [q[0] + share * (p[0] - q[0]), q[1] + share * (p[1] - q[1])];
                *sum += energy;
                continue 'spots;
            }
        }
        merged.push((p, energy));
    }
    let error = Normal::new(0.0, story.position_std_m).unwrap();
    merged
        .into_iter()
        .map(|(p, energy_j)| {
            let variance = story.position_std_m.powi(2);
            let (x_m, y_m) = (p[0] + error.sample(rng), p[1] + error.sample(rng));
            Emitter {
                x_m,
                y_m,
                cov_m2: [[variance, 0.0], [0.0, variance]],
                energy_j,
                energy_std_j: 1e-5,
                sensor_m: camera.to_sensor([x_m, y_m]),
                flags: Flags::empty(),
            }
        })
        .collect()
}

/// Every claim with the time it comes in, by that time.
pub fn claims(story: &Story) -> Vec<(f64, Claim)> {
    let mut rng = ChaCha8Rng::seed_from_u64(story.seed ^ 0xc1a1_4500);
    let mut all = Vec::new();
    for actor in &story.actors {
        let Some(user) = &actor.user else { continue };
        let fresh = Normal::new(0.0, actor.sigma_m * (1.0 - story.claim_wander).sqrt()).unwrap();
        // First-order Gauss-Markov with a correlation time of one minute.
        let keeps = (-actor.period_s / 60.0).exp();
        let stationary = actor.sigma_m * story.claim_wander.sqrt();
        let drift = Normal::new(0.0, stationary * (1.0 - keeps * keeps).sqrt()).unwrap();
        let begin = Normal::new(0.0, stationary).unwrap();
        let mut wander = [begin.sample(&mut rng), begin.sample(&mut rng)];
        let mut t = actor.phase_s;
        let mut over = false;
        while t < story.seconds && !over {
            over = actor.ended_at.is_some_and(|end| t >= end);
            wander = wander.map(|w| keeps * w + drift.sample(&mut rng));
            let (ex, ey) = (wander[0] + fresh.sample(&mut rng), wander[1] + fresh.sample(&mut rng));
            if let Some([x, y]) = (actor.claim)(t)
                && let Some(comes) = (story.delivery)(t)
            {
                all.push((
                    comes,
                    Claim {
                        time: at(t),
                        user: user.clone(),
                        x_m: x + ex,
                        y_m: y + ey,
                        sigma_m: actor.states_sigma.then_some(actor.sigma_m),
                        state: if over { ClaimState::Ended } else { ClaimState::Active },
                    },
                ));
            }
            t += actor.period_s;
        }
    }
    all.extend(story.forged.iter().cloned());
    all.sort_by(|a, b| a.0.total_cmp(&b.0));
    all
}

pub fn tell(story: &Story) -> Told {
    tell_with(story, true)
}

/// `keep` holds on to every frame's report; long runs do without.
pub fn tell_with(story: &Story, keep: bool) -> Told {
    let camera = camera();
    let config = claims::Config::default();
    let source = Source {
        kind: "replay".into(),
        file: None,
        rate_hz: story.rate_hz,
    };
    let mut monitor = Monitor::new(&story.monitor, &config, &camera, source.clone());
    let mut store = Store::new(&config);
    let mut rng = ChaCha8Rng::seed_from_u64(story.seed);
    let mut upcoming = claims(story).into_iter().peekable();
    let (mut events, mut reports) = (Vec::<AlertEvent>::new(), Vec::new());
    let mut last_digest = 0;
    for frame in 0..(story.seconds * story.rate_hz).round() as u64 {
        let t = frame as f64 / story.rate_hz;
        if story.restarts_at == Some(t) {
            // What the journal holds.
            let mut open: BTreeMap<String, oapwatch::monitor::Alert> = BTreeMap::new();
            for event in &events {
                open.insert(event.alert.id.clone(), event.alert.clone());
            }
            open.retain(|_, alert| alert.state != AlertState::Cleared);
            monitor = Monitor::new(&story.monitor, &config, &camera, source.clone());
            monitor.restore(open.into_values().collect());
        }
        while let Some((_, claim)) = upcoming.next_if(|(comes, _)| *comes <= t + 1e-9) {
            store.insert(claim, at(t));
        }
        let sensor = (story.sensor)(t);
        if sensor == Sensor::Nothing {
            events.extend(monitor.tick(at(t), &mut store));
            continue;
        }
        let mut estimate = Estimate {
            is_cut_short: false,
            emitters: detect(story, t, &mut rng),
            rung: "story",
            reduced_chi2: 1.0,
            saturated_share: 0.0,
            condition: 1.0,
            steps: 0,
        };
        let mut digest = frame + 1;
        let mut error = None;
        match sensor {
            Sensor::Fine | Sensor::Nothing => {}
            Sensor::Nan => {
                digest = 1 << 40;
                error = Some(Error::NoUsablePixel {
                    total: 4096,
                    nan: 4096,
                    saturated: 0,
                    masked: 0,
                });
            }
            Sensor::Zero => {
                digest = 1 << 41;
                estimate.emitters.clear();
            }
            Sensor::Saturated => {
                digest = 1 << 42;
                estimate.emitters.clear();
                estimate.saturated_share = 1.0;
            }
            Sensor::Frozen => digest = last_digest,
            Sensor::LensCap => estimate.emitters.clear(),
        }
        last_digest = digest;
        let seen = Observation {
            frame,
            time: at(t),
            result: error.as_ref().map_or(Ok(&estimate), Err),
            digest,
        };
        let report = monitor.step(seen, &mut store);
        events.extend(report.events.iter().cloned());
        if keep {
            reports.push(report);
        }
    }
    Told { events, reports, store }
}

/// How often each kind was raised.
pub fn tally(events: &[AlertEvent]) -> BTreeMap<AlertKind, usize> {
    let mut tally = BTreeMap::new();
    for e in events.iter().filter(|e| e.event == AlertEventKind::Raised) {
        *tally.entry(e.alert.kind).or_default() += 1;
    }
    tally
}
