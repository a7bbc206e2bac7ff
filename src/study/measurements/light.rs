//! How well the light alone tells a beam from a lamp: the likelihood ratio in an alert's evidence, over many lights of either kind.

use std::fmt::Write;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

use super::measured::Measured;
use crate::monitor::{AlertEventKind, AlertKind};
use crate::study::stories::{Actor, Story, crowd, tell};

/// Where the light is, and when it is on, s.
const PLACE: [f64; 2] = [30.0, 5.0];
const ON_S: [f64; 2] = [4.0, 20.0];
/// Seconds of a story: until the alert has ended.
const STORY_S: f64 = 36.0;
const RATES_HZ: [f64; 2] = [10.0, 100.0];
/// Standard deviations of a frame's energy over its mean: calm air, and up to ten coherence times in a frame.
const SCINTILLATIONS: [f64; 4] = [0.05, 0.1, 0.2, 0.3];
/// Standard deviations per axis of the light of lamps on the ground, m: points, and a lit front or several lamps in one spot.
const EXTENTS_M: [[f64; 2]; 2] = [[0.0, 0.0], [2.0, 6.0]];
/// Area under the curve that beams of strong scintillation must reach at 10 Hz.
const GOAL: f64 = 0.99;

/// The ratio of a light that nobody claims, when its alert ends; none where nothing was said.
fn ratio(seed: u64, rate_hz: f64, light: Actor) -> Option<f64> {
    let mut actors = crowd();
    actors.push(light);
    let mut story = Story::new(seed, actors);
    story.rate_hz = rate_hz;
    story.seconds = STORY_S;
    let told = tell(&story);
    let is_theirs = |kind, alert| kind == AlertEventKind::Cleared && alert == AlertKind::UnclaimedEmitter;
    let ended = told.events.iter().find(|e| is_theirs(e.event, e.alert.kind))?;
    ended.alert.evidence["lamp_or_beam"]["likelihood_ratio"].as_f64()
}

fn shining(t: f64) -> Option<[f64; 2]> {
    (ON_S[0]..ON_S[1]).contains(&t).then_some(PLACE)
}

/// A lamp: steady, or with the mains' beat, which frames of 10 and 100 Hz show as a slow change; a point, or of that extent, m.
fn lamp(seed: u64, extent_m: [f64; 2]) -> Actor {
    let mut rng = ChaCha8Rng::seed_from_u64(seed ^ 0x1a39);
    let mut lamp = Actor::lamp(shining);
    if extent_m[1] > 0.0 {
        lamp.extent_m2 = rng.random_range(extent_m[0]..extent_m[1]).powi(2);
    }
    if rng.random::<bool>() {
        let (depth, beat_hz) = (rng.random_range(0.02..0.15), rng.random_range(0.02..0.4));
        let phase = rng.random_range(0.0..std::f64::consts::TAU);
        lamp.glow = Box::new(move |t| 1.0 + depth * (std::f64::consts::TAU * beat_hz * t + phase).sin());
    }
    lamp
}

fn beam(scintillation: f64) -> Actor {
    let mut beam = Actor::intruder(shining);
    beam.fading = scintillation;
    beam
}

/// Share of pairs of a beam and a lamp of which the beam has the larger ratio: the area under the curve of true over false
/// positives (Hanley and McNeil, 1982).
fn area(beams: &[f64], lamps: &[f64]) -> f64 {
    let won = |(b, l): (f64, f64)| match b.total_cmp(&l) {
        std::cmp::Ordering::Greater => 1.0,
        std::cmp::Ordering::Equal => 0.5,
        std::cmp::Ordering::Less => 0.0,
    };
    let pairs = beams.iter().flat_map(|b| lamps.iter().map(move |l| (*b, *l)));
    pairs.map(won).sum::<f64>() / (beams.len() * lamps.len()).max(1) as f64
}

/// `stories` lights of each kind at either rate.
pub fn lamp_or_beam(stories: u64, seed: u64) -> Measured {
    let mut text = format!(
        "{stories} lights of each kind, 16 s each; half of the lamps beat with the mains by 2 to 15 %.\n\n\
         | frames/s | lamps | beam's scintillation | area under the curve | beams above 1 | lamps above 1 |\n|---|---|---|---|---|---|\n"
    );
    let mut holds = true;
    for rate_hz in RATES_HZ {
        let seeds = || (seed..seed + stories).into_par_iter();
        let beams = SCINTILLATIONS
            .map(|s| -> (f64, Vec<f64>) { (s, seeds().filter_map(|k| ratio(k, rate_hz, beam(s))).collect()) });
        for extent_m in EXTENTS_M {
            let lamps: Vec<f64> = seeds().filter_map(|k| ratio(k, rate_hz, lamp(k, extent_m))).collect();
            let kind = match extent_m {
                [_, 0.0] => "points".to_owned(),
                [least, most] => format!("{least} to {most} m"),
            };
            for (scintillation, beams) in &beams {
                let area = area(beams, &lamps);
                let above = |ratios: &[f64]| {
                    100.0 * ratios.iter().filter(|r| **r > 1.0).count() as f64 / ratios.len().max(1) as f64
                };
                writeln!(
                    text,
                    "| {rate_hz} | {kind} | {scintillation} | {area:.3} | {:.0} % of {} | {:.0} % of {} |",
                    above(beams),
                    beams.len(),
                    above(&lamps),
                    lamps.len()
                )
                .expect("text takes all");
                holds &= area >= GOAL || *scintillation < 0.2 || rate_hz > 10.0;
            }
        }
    }
    Measured { text, holds }
}
