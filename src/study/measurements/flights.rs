//! Platforms that move, through the simulator's pixels: honest users, strangers, and a place that is dragged away.

use std::fmt::Write;
use std::time::Instant;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use rayon::prelude::*;

use super::measured::{Measured, Raised, exceptions};
use crate::estimate;
use crate::monitor::AlertKind::{PoseInconsistent, UnclaimedEmitter};
use crate::study::stories::pixels::{PixelStory, RATE_HZ, Reviewed, review};

/// Six users, the farther apart the better a view that sways by 8° still holds all of them.
const USERS: [[f64; 2]; 6] = [
    [-50.0, -45.0],
    [0.0, -55.0],
    [50.0, -40.0],
    [-45.0, 45.0],
    [5.0, 50.0],
    [50.0, 40.0],
];
/// Seconds of an honest flight.
const HONEST_S: f64 = 60.0;
/// When a stranger comes on, s, and how long the flight goes on.
const COMES_S: f64 = 20.0;
const STRANGER_S: f64 = 4.0;
/// No stranger comes nearer to a user: nearer ones are other measurements' subject.
const CLEAR_M: f64 = 15.0;
/// When the dragging begins, s: the lasting error has been learned.
const DRAGGED_S: f64 = 45.0;
/// How late the autopilot is, s, and when it is asked how late it is taken to be, s.
const LATE_S: f64 = 0.03;
const LEARNED_S: f64 = 10.0;
/// Frames of which the median tells what poses cost.
const COST_FRAMES: u64 = 1000;
/// Errors count from here on, s: the lasting pose error and the delay have been learned.
const SETTLED_S: f64 = 15.0;
/// Within these the alerts must come, s, and the share of strangers for which they do.
const STRANGER_LIMIT_S: f64 = 1.0;
const DRAG_LIMIT_S: f64 = 10.0;
const GOAL: f64 = 0.998;

struct Kind {
    name: &'static str,
    laws: &'static str,
    /// Where the users are for the motion to keep them in view, from those of [`USERS`], m.
    shift_m: [f64; 2],
}

const fn kind(name: &'static str, laws: &'static str, shift_m: [f64; 2]) -> Kind {
    Kind { name, laws, shift_m }
}

const KINDS: &[Kind] = &[
    kind(
        "sway of 3°",
        "sway = { amplitude_deg = [3, 3], period_s = [8, 9] }",
        [0.0; 2],
    ),
    kind(
        "sway of 8°",
        "sway = { amplitude_deg = [8, 8], period_s = [8, 9] }",
        [0.0; 2],
    ),
    kind(
        "sway of 3°, turning 60° a minute",
        "yaw_rate_deg_s = 1\nsway = { amplitude_deg = [3, 3], period_s = [8, 9] }",
        [0.0; 2],
    ),
    kind(
        "sway of 3°, drifting at 1 m/s",
        "velocity_m_s = [0.8, 0.6, 0]\nsway = { amplitude_deg = [3, 3], period_s = [8, 9] }",
        [24.0, 18.0],
    ),
    kind(
        "sway of 3°, climbing at 1 m/s",
        "velocity_m_s = [0, 0, 1]\nsway = { amplitude_deg = [3, 3], period_s = [8, 9] }",
        [0.0; 2],
    ),
    kind(
        "mount turned by 90°, sway of 5°, turning, circling",
        "mount = { roll_deg = 2, pitch_deg = -3, yaw_deg = 90 }\nyaw_rate_deg_s = 1\n\
         sway = { amplitude_deg = [5, 5], period_s = [8, 9] }\norbit = { radius_m = 10, period_s = 60 }",
        [0.0; 2],
    ),
];

/// An autopilot of 3 mrad, 1.5° of heading and 1 m, 30 ms late; and six users with claims of 0.3 m.
fn scene(kind: &Kind, seed: u64) -> String {
    let mut rng = ChaCha8Rng::seed_from_u64(seed ^ 0xf11e);
    let mut normal = |std: f64| {
        let z: f64 = StandardNormal.sample(&mut rng);
        std * z
    };
    let turn = [0.003, 0.003, 1.5f64.to_radians()].map(&mut normal);
    let place = [1.0; 3].map(&mut normal);
    let mut text = format!(
        "[platform]\n{}\n[platform.telemetry]\nattitude_sigma_rad = 0.026\nposition_sigma_m = 1.0\nattitude_noise_rad = 5e-4\n\
         position_noise_m = 0.02\nattitude_bias_rad = {turn:?}\nposition_bias_m = {place:?}\ndelay_s = {LATE_S:?}\n",
        kind.laws
    );
    text.push_str(&users(kind.shift_m));
    text
}

fn users(shift_m: [f64; 2]) -> String {
    let mut text = String::new();
    for (k, [x, y]) in USERS.into_iter().enumerate() {
        let [x, y] = [x + shift_m[0], y + shift_m[1]];
        writeln!(
            text,
            "[[user]]\nname = \"u-{k}\"\nmotion.roam = {{ home_m = [{x:?}, {y:?}], spread_m = 3, time_s = 15 }}"
        )
        .expect("text takes all");
    }
    text
}

fn flown(kind: &Kind, estimator: &estimate::Config, seed: u64, seconds: f64, more: &str) -> Reviewed {
    let mut story = PixelStory::only(seed, &format!("{}{more}", scene(kind, seed)));
    story.seconds = seconds;
    story.config.estimator = estimator.clone();
    review(&story)
}

/// What the poses of a platform that rests cost a frame, µs: the median of the same frames with and without, in turns.
fn cost_us(estimator: &estimate::Config, seed: u64) -> f64 {
    let mut opened = ["[platform.telemetry]\n", ""].map(|platform| {
        let mut story = PixelStory::only(seed, &format!("{platform}{}", users([0.0; 2])));
        story.config.estimator = estimator.clone();
        story.open()
    });
    let more = (0..COST_FRAMES).map(|k| {
        let [with, without] = opened.each_mut().map(|(plan, pipeline)| {
            let made = plan.frame(k);
            pipeline.claim(made.claims, made.frame.time);
            let began = Instant::now();
            pipeline.receive_poses(made.poses, made.frame.time);
            pipeline.step(&made.frame);
            began.elapsed().as_secs_f64() * 1e6
        });
        with - without
    });
    median(more.collect())
}

/// A stranger in view, clear of the users.
fn stranger(kind: &Kind, seed: u64) -> String {
    let mut rng = ChaCha8Rng::seed_from_u64(seed ^ 0x57a6);
    let [x, y] = loop {
        let at = [0; 2].map(|_| rng.random_range(-70.0..70.0f64));
        if USERS.iter().all(|u| (u[0] - at[0]).hypot(u[1] - at[1]) > CLEAR_M) {
            break at;
        }
    };
    let [x, y] = [x + kind.shift_m[0], y + kind.shift_m[1]];
    format!("[[intruder]]\nname = \"e\"\npresent = {{ from_s = {COMES_S:?} }}\nmotion.still = [{x:?}, {y:?}]\n")
}

/// Errors of users' positions, m, and their squares over the stated variance, per axis.
fn errors(told: &Reviewed) -> (Vec<f64>, Vec<f64>) {
    let (mut metres, mut normalised) = (Vec::new(), Vec::new());
    for (report, truth) in told
        .reports
        .iter()
        .zip(&told.truths)
        .skip((SETTLED_S * RATE_HZ) as usize)
    {
        for seen in &report.emitters {
            let is_theirs = |e: &&crate::scene::EmitterTruth| e.user.is_some() && e.user == seen.user;
            let Some(user) = truth.emitters.iter().find(is_theirs) else {
                continue;
            };
            let (dx, dy) = (seen.x_m - user.x_m, seen.y_m - user.y_m);
            let [[a, b], [_, c]] = seen.cov_m2;
            metres.push(dx.hypot(dy));
            normalised.push(0.5 * (c * dx * dx - 2.0 * b * dx * dy + a * dy * dy) / (a * c - b * b));
        }
    }
    (metres, normalised)
}

fn median(values: Vec<f64>) -> f64 {
    crate::stats::median(values).unwrap_or(f64::NAN)
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

/// Delay of the first alert of this kind after `from_s`, where nothing was raised before; ∞ without one.
fn delay_s(raised: &Raised, wanted: crate::monitor::AlertKind, from_s: f64) -> f64 {
    match raised.first() {
        Some((kind, _, at)) if *kind == wanted && *at >= from_s => at - from_s,
        _ => f64::INFINITY,
    }
}

/// `stories` flights of each kind, honest, with a stranger, and dragged away at 1 m/s.
pub fn flights(stories: u64, seed: u64, estimator: &estimate::Config) -> Measured {
    let mut text = format!(
        "{stories} flights of each kind; honest ones of {HONEST_S} s. Errors are of users' positions after {SETTLED_S} s.\n\n\
         | platform | flights with false alerts | median error m | mean squared error over the stated | delay off after {LEARNED_S} s, ms | \
         stranger alerted within {STRANGER_LIMIT_S} s | dragged at 1 m/s: `pose_inconsistent` within {DRAG_LIMIT_S} s |\n|---|---|---|---|---|---|---|\n"
    );
    let mut holds = true;
    let mut others = Vec::new();
    let mut found_s = Vec::new();
    for kind in KINDS {
        let seeds = || (seed..seed + stories).into_par_iter();
        let honest: Vec<_> = seeds()
            .map(|k| {
                let told = flown(kind, estimator, k, HONEST_S, "");
                let (metres, normalised) = errors(&told);
                let learned = told.delays_s[(LEARNED_S * RATE_HZ) as usize];
                (
                    (k, told.raised()),
                    median(metres),
                    mean(&normalised),
                    1e3 * (learned - LATE_S).abs(),
                )
            })
            .collect();
        let strangers: Vec<_> = seeds()
            .map(|k| {
                (
                    k,
                    flown(kind, estimator, k, COMES_S + STRANGER_S, &stranger(kind, k)).raised(),
                )
            })
            .collect();
        let dragged: Vec<_> = seeds()
            .map(|k| {
                let drag = format!("[platform.telemetry.dragged]\nfrom_s = {DRAGGED_S:?}\nvelocity_m_s = [1, 0]\n");
                (k, flown(kind, estimator, k, DRAGGED_S + 15.0, &drag).raised())
            })
            .collect();
        let within = |stories: &[(u64, Raised)], wanted, from_s, limit_s| {
            let in_time = stories
                .iter()
                .filter(|(_, raised)| delay_s(raised, wanted, from_s) <= limit_s);
            in_time.count()
        };
        let false_alerts: Vec<_> = honest
            .iter()
            .map(|h| h.0.clone())
            .filter(|(_, raised)| !raised.is_empty())
            .collect();
        let seen = within(&strangers, UnclaimedEmitter, COMES_S, STRANGER_LIMIT_S);
        let told = within(&dragged, PoseInconsistent, DRAGGED_S, DRAG_LIMIT_S);
        let delays = dragged
            .iter()
            .map(|(_, raised)| delay_s(raised, PoseInconsistent, DRAGGED_S));
        found_s.extend(delays.filter(|delay| delay.is_finite()));
        writeln!(
            text,
            "| {} | {} | {:.2} | {:.2} | {:.1} | {seen} | {told} |",
            kind.name,
            false_alerts.len(),
            median(honest.iter().map(|h| h.1).collect()),
            mean(&honest.iter().map(|h| h.2).collect::<Vec<_>>()),
            median(honest.iter().map(|h| h.3).collect()),
        )
        .expect("text takes all");
        holds &= false_alerts.is_empty() && seen as f64 >= GOAL * stories as f64 && told as u64 == stories;
        let late = strangers
            .into_iter()
            .filter(|(_, r)| delay_s(r, UnclaimedEmitter, COMES_S) > STRANGER_LIMIT_S || r.len() > 1);
        let unsaid = dragged
            .into_iter()
            .filter(|(_, r)| delay_s(r, PoseInconsistent, DRAGGED_S) > DRAG_LIMIT_S);
        let named = [false_alerts, late.collect(), unsaid.collect()].concat();
        if !named.is_empty() {
            others.push(format!("{}:\n{}", kind.name, exceptions(&named)));
        }
    }
    let slowest = found_s.iter().copied().fold(f64::NAN, f64::max);
    let median_s = median(found_s);
    let cost_us = cost_us(estimator, seed);
    writeln!(
        text,
        "\nDrags are found after {median_s:.1} s in the median, the slowest after {slowest:.1} s. Poses cost a frame {cost_us:.0} µs (the \
         median of {COST_FRAMES}).\n"
    )
    .expect("text takes all");
    text.push_str(&others.concat());
    Measured { text, holds }
}
