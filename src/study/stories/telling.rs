//! A story told to the monitor, and what it said.

use std::collections::BTreeMap;

use crate::claim::{Claim, ClaimState};
use crate::claims::{self, Store};
use crate::estimate::{Emitter, Error, Estimate, Flags, SecondMomentScore};
use crate::monitor::{AlertEvent, AlertEventKind, AlertKind, AlertState, Monitor, Observation, Report, Source};
use crate::optics::Camera;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, Normal, StandardNormal};

use super::{Sensor, Story, at, camera, start};

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
            .map(|e| serde_json::to_string(e).expect("an event is plain data") + "\n")
            .collect()
    }
}

/// Light that is one spot.
struct Blob {
    place: [f64; 2],
    energy_j: f64,
    /// Of the brightest of them.
    brightest_j: f64,
    /// Second moments about the centre of light: xx, xy, yy.
    moments_m2: [f64; 3],
}

/// What a fit of one spot would say of the second moments. For a Gaussian spot their information is ¼, ½ and ¼ of that of a
/// coordinate, in units of σ: ⟨f_xx, f_xx⟩ less what the amplitude takes is half of ⟨f, f⟩, as is ⟨f_x, f_x⟩. The story's error of
/// positions is one beam's; information grows with the square of the energy.
fn score(blob: &Blob, story: &Story, camera: &Camera, rng: &mut ChaCha8Rng) -> SecondMomentScore {
    let sigma_m = camera.spot_sigma_m * camera.ground_scale();
    let coordinate = (sigma_m / story.position_std_m * blob.energy_j / blob.brightest_j).powi(2);
    let mut score = SecondMomentScore::default();
    for (k, share) in [0.25, 0.5, 0.25].into_iter().enumerate() {
        let information = share * coordinate;
        let z: f64 = StandardNormal.sample(rng);
        score.score[k] = information * blob.moments_m2[k] / sigma_m.powi(2) + information.sqrt() * z;
        score.information[k][k] = information;
    }
    score
}

/// Detections of one frame: beams that are too near each other melt into one.
fn detect(story: &Story, t: f64, rng: &mut ChaCha8Rng) -> Vec<Emitter> {
    let camera = camera();
    let shift = (story.shift)(t);
    let [s, a] = (story.turn)(t);
    let mut spots: Vec<([f64; 2], f64, f64)> = Vec::new();
    let mut fadings = vec![1.0; story.actors.len()];
    for (k, actor) in story.actors.iter().enumerate() {
        let Some([x, y]) = (actor.beam)(t) else { continue };
        let p = [x + shift[0] + s * x - a * y, y + shift[1] + a * x + s * y];
        if !camera.sees(p) || rng.random::<f64>() >= story.detected {
            continue;
        }
        // A beam's ten coherence times a frame: 29 % scintillation.
        let own = || Normal::<f64>::new(1.0, actor.fading).expect("a standard deviation");
        fadings[k] = match actor.reflects {
            Some(of) => fadings[of],
            None => own().sample(rng).clamp(0.3, 2.5),
        };
        let fading = fadings[k];
        spots.push((p, actor.energy_j * fading * (actor.glow)(t), actor.extent_m2));
    }
    if rng.random::<f64>() < story.ghosts {
        spots.push((
            [rng.random_range(-120.0..120.0), rng.random_range(-120.0..120.0)],
            1e-3,
            0.0,
        ));
    }
    let mut merged: Vec<Blob> = Vec::new();
    'spots: for (p, energy, extent_m2) in spots {
        for blob in &mut merged {
            let [x, y] = [p[0] - blob.place[0], p[1] - blob.place[1]];
            if x.hypot(y) < story.resolution_m {
                let share = energy / (blob.energy_j + energy);
                blob.place = [blob.place[0] + share * x, blob.place[1] + share * y];
                blob.energy_j += energy;
                blob.brightest_j = blob.brightest_j.max(energy);
                let theirs = [extent_m2, 0.0, extent_m2];
                for ((m, own), d) in blob.moments_m2.iter_mut().zip(theirs).zip([x * x, x * y, y * y]) {
                    *m = (1.0 - share) * *m + share * own + share * (1.0 - share) * d;
                }
                continue 'spots;
            }
        }
        merged.push(Blob {
            place: p,
            energy_j: energy,
            brightest_j: energy,
            moments_m2: [extent_m2, 0.0, extent_m2],
        });
    }
    // A stream of its own: the other draws stay what they are without it.
    let mut shapes = ChaCha8Rng::seed_from_u64(story.seed ^ t.to_bits());
    let error = Normal::new(0.0, story.position_std_m).expect("a standard deviation");
    merged
        .into_iter()
        .map(|blob| {
            let variance = story.position_std_m.powi(2);
            let (p, energy_j) = (blob.place, blob.energy_j);
            let (x_m, y_m) = (p[0] + error.sample(rng), p[1] + error.sample(rng));
            Emitter {
                x_m,
                y_m,
                cov_m2: [[variance, 0.0], [0.0, variance]],
                energy_j,
                energy_std_j: 1e-5,
                sensor_m: camera.to_sensor([x_m, y_m]),
                velocity: None,
                lasting_cov_m2: None,
                second_moment: score(&blob, story, &camera, &mut shapes),
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
        let fresh = Normal::new(0.0, actor.sigma_m * (1.0 - story.claim_wander).sqrt()).expect("a standard deviation");
        // First-order Gauss-Markov with a correlation time of one minute.
        let keeps = (-actor.period_s / 60.0).exp();
        let stationary = actor.sigma_m * story.claim_wander.sqrt();
        let drift = Normal::new(0.0, stationary * (1.0 - keeps * keeps).sqrt()).expect("a standard deviation");
        let begin = Normal::new(0.0, stationary).expect("a standard deviation");
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
                        z_m: None,
                        sigma_m: actor.states_sigma.then_some(actor.sigma_m),
                        cov_m2: None,
                        power_w: actor.reports_w,
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
            let mut open: BTreeMap<String, crate::monitor::Alert> = BTreeMap::new();
            for event in &events {
                open.insert(event.alert.id.clone(), event.alert.clone());
            }
            open.retain(|_, alert| alert.state != AlertState::Cleared);
            monitor = Monitor::new(&story.monitor, &config, &camera, source.clone());
            monitor.restore(open.into_values().collect());
        }
        (story.operator)(t, &mut monitor, &events);
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
            is_limited: false,
            emitters: detect(story, t, &mut rng),
            estimator: "story",
            reduced_chi2: 1.0,
            spot_error: 0.0,
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
            energy_scale: 1.0,
            digest,
            look: crate::monitor::Look::Level,
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
