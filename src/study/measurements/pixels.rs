//! The whole program on the simulator's pixels.

use std::fmt::Write;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

use super::measured::{Measured, Raised, exceptions};
use crate::estimate;
use crate::monitor::AlertKind::UnclaimedEmitter;
use crate::study::stories::pixels::{CROWD, PixelStory, RATE_HZ, review};

/// Two who roam near each other, and one who drives sharp corners.
const BUSY: &str = r#"
[[user]]
name = "r-1"
motion.roam = { home_m = [0, 0], spread_m = 15, time_s = 12 }
[[user]]
name = "r-2"
motion.roam = { home_m = [10, 5], spread_m = 15, time_s = 12 }
[[user]]
name = "d-1"
motion.walk = { through_m = [[-110, -110], [-110, 100], [-90, 110], [-90, -90], [100, -110]], speed_m_s = 8 }
"#;
/// Seconds of a story of honest users.
const HONEST_S: f64 = 120.0;
/// When a stranger comes on, s, and how long the story is: after a quarter of a minute of peace.
const COMES_S: f64 = 15.0;
const STRANGER_S: f64 = 20.0;
/// The same of one in a crowd and of one in a user's spot: later, so that the monitor knows the users' light.
const COMES_IN_CROWD_S: f64 = 40.0;
const SHADOW_COMES_S: f64 = 60.0;
/// Share of strangers as strong as the users who must be alerted within a second.
const GOAL: f64 = 0.998;

/// How fast the light fades.
#[derive(Clone, Copy)]
enum Fading {
    /// Ten draws to an exposure: energies vary by 0.29 of their mean.
    Averaged,
    /// One draw: by 0.93.
    Slow,
}

/// The four users and whom `toml` names, for so long; what was raised, by seed.
fn told(
    stories: u64,
    seed: u64,
    estimator: &estimate::Config,
    seconds: f64,
    toml: impl Fn(u64) -> String + Sync,
) -> Vec<(u64, Raised)> {
    told_with(Fading::Averaged, stories, seed, estimator, seconds, toml)
}

fn told_with(
    fading: Fading,
    stories: u64,
    seed: u64,
    estimator: &estimate::Config,
    seconds: f64,
    toml: impl Fn(u64) -> String + Sync,
) -> Vec<(u64, Raised)> {
    let seeds = (seed..seed + stories).into_par_iter();
    let tell = |k| {
        let mut story = PixelStory::with(k, &toml(k));
        if let Fading::Slow = fading {
            story.change(|scene| scene.link.coherence_time_s = scene.link.integration_time_s);
        }
        story.seconds = seconds;
        story.config.estimator = estimator.clone();
        (k, review(&story).raised())
    };
    seeds.map(tell).collect()
}

/// Users of whom two roam near each other and one drives raise nothing.
pub fn honest_users(stories: u64, seed: u64, estimator: &estimate::Config) -> Measured {
    peace(Fading::Averaged, stories, seed, estimator, BUSY)
}

/// The four users alone raise nothing, however their light fades.
pub fn honest_fading(stories: u64, seed: u64, estimator: &estimate::Config) -> Measured {
    peace(Fading::Slow, stories, seed, estimator, "")
}

/// Users who stand so near each other that a frame hardly ever tells them all apart raise nothing.
pub fn honest_crowd(stories: u64, seed: u64, estimator: &estimate::Config) -> Measured {
    peace(Fading::Averaged, stories, seed, estimator, CROWD)
}

fn peace(fading: Fading, stories: u64, seed: u64, estimator: &estimate::Config, toml: &str) -> Measured {
    let mut raised = told_with(fading, stories, seed, estimator, HONEST_S, |_| toml.to_owned());
    raised.retain(|(_, raised)| !raised.is_empty());
    let frames = stories as f64 * HONEST_S * RATE_HZ;
    Measured {
        text: format!(
            "{frames} honest frames: {} stories with alerts\n{}",
            raised.len(),
            exceptions(&raised)
        ),
        holds: raised.is_empty(),
    }
}

fn intruder(comes_s: f64, power_w: f64, motion: &str) -> String {
    format!("[[intruder]]\nname = \"e\"\npower_w = {power_w}\npresent = {{ from_s = {comes_s} }}\nmotion.{motion}")
}

fn beside(user: &str, [x, y]: [f64; 2]) -> String {
    format!("beside = {{ user = \"{user}\", offset_m = [{x}, {y}] }}")
}

/// Delay of the first alert, where it is of an emitter that comes at `comes_s` and nothing was raised before; ∞ without one.
fn delay_s(raised: &Raised, comes_s: f64) -> f64 {
    match raised.first() {
        Some((UnclaimedEmitter, None, at)) if *at >= comes_s => at - comes_s,
        _ => f64::INFINITY,
    }
}

fn within(delays: &[f64], s: f64) -> usize {
    delays.iter().filter(|delay| **delay <= s).count()
}

/// A stranger anywhere in view, as strong as the users.
pub fn strangers(stories: u64, seed: u64, estimator: &estimate::Config) -> Measured {
    let mut raised = told(stories, seed, estimator, STRANGER_S, |k| {
        let mut rng = ChaCha8Rng::seed_from_u64(k);
        let [x, y] = [0; 2].map(|_| rng.random_range(-120.0..120.0f64));
        intruder(COMES_S, 1.0, &format!("still = [{x}, {y}]"))
    });
    let delays: Vec<f64> = raised.iter().map(|(_, raised)| delay_s(raised, COMES_S)).collect();
    raised.retain(|(_, raised)| delay_s(raised, COMES_S) > 1.0 || raised.len() > 1);
    let in_time = [1.0, 2.0, 5.0].map(|s| within(&delays, s));
    Measured {
        text: format!(
            "of {stories} strangers {} within 1 s, {} within 2 s, {} within 5 s; late ones, and stories with other alerts:\n{}",
            in_time[0],
            in_time[1],
            in_time[2],
            exceptions(&raised)
        ),
        holds: in_time[0] as f64 >= GOAL * stories as f64,
    }
}

/// The same within 5 m of one of the users, uniformly over that ground.
pub fn strangers_near(stories: u64, seed: u64, estimator: &estimate::Config) -> Measured {
    let place = |k: u64| {
        let mut rng = ChaCha8Rng::seed_from_u64(k);
        let (r, angle) = (
            5.0 * rng.random::<f64>().sqrt(),
            rng.random_range(0.0..std::f64::consts::TAU),
        );
        (r, angle, rng.random_range(1..=4))
    };
    let raised = told(stories, seed, estimator, STRANGER_S, |k| {
        let (r, angle, user) = place(k);
        let offset_m = [r * angle.cos(), r * angle.sin()];
        intruder(COMES_S, 1.0, &beside(&format!("u-{user}"), offset_m))
    });
    // By metres of distance: late, and in time.
    let mut counts = [[0; 2]; 5];
    for (k, raised) in &raised {
        counts[place(*k).0 as usize][usize::from(delay_s(raised, COMES_S) <= 1.0)] += 1;
    }
    let mut text = "| m from a user | within 1 s | later |\n|---|---|---|\n".to_owned();
    for (m, [late, in_time]) in counts.iter().enumerate() {
        writeln!(text, "| {m} to {} | {in_time} | {late} |", m + 1).expect("text takes all");
    }
    let far = |column: usize| counts[3..].iter().map(|row| row[column]).sum::<u32>();
    Measured {
        text,
        holds: 50 * far(0) <= far(1),
    }
}

/// A stranger within 20 m of the middle of a crowd.
pub fn strangers_in_crowd(stories: u64, seed: u64, estimator: &estimate::Config) -> Measured {
    let raised = told(stories, seed, estimator, COMES_IN_CROWD_S + 20.0, |k| {
        let mut rng = ChaCha8Rng::seed_from_u64(k);
        let (r, angle) = (
            20.0 * rng.random::<f64>().sqrt(),
            rng.random_range(0.0..std::f64::consts::TAU),
        );
        let (x, y) = (3.0 + r * angle.cos(), 3.0 + r * angle.sin());
        format!(
            "{CROWD}{}",
            intruder(COMES_IN_CROWD_S, 1.0, &format!("still = [{x}, {y}]"))
        )
    });
    let first = |raised: &Raised| {
        let found = raised
            .iter()
            .find(|(kind, _, at)| *kind == UnclaimedEmitter && *at >= COMES_IN_CROWD_S);
        found.map_or(f64::INFINITY, |(.., at)| at - COMES_IN_CROWD_S)
    };
    let delays: Vec<f64> = raised.iter().map(|(_, raised)| first(raised)).collect();
    let all = raised.iter().flat_map(|(_, raised)| raised);
    let before = all.filter(|(.., at)| *at < COMES_IN_CROWD_S).count();
    let in_time = [1.0, 5.0, 20.0].map(|s| within(&delays, s));
    Measured {
        text: format!(
            "of {stories} strangers {} within 1 s, {} within 5 s, {} within 20 s; {before} alerts before\n",
            in_time[0], in_time[1], in_time[2]
        ),
        holds: before == 0,
    }
}

/// A stranger who comes on beside a user and stays, by distance and by power as a share of the user's: how many are alerted within
/// 20 s, and the median and longest delay. From how far all are found is a requirement; so is that nothing else is raised.
pub fn shadows(stories: u64, seed: u64, estimator: &estimate::Config) -> Measured {
    shadows_with(Fading::Averaged, stories, seed, estimator)
}

/// The same where energies vary by 0.93 of their mean.
pub fn shadows_fading(stories: u64, seed: u64, estimator: &estimate::Config) -> Measured {
    shadows_with(Fading::Slow, stories, seed, estimator)
}

fn shadows_with(fading: Fading, stories: u64, seed: u64, estimator: &estimate::Config) -> Measured {
    let mut text = "| power | m from the user | found | median s | longest s | something else first |\n".to_owned();
    text += "|---|---|---|---|---|---|\n";
    let mut holds = true;
    for (power_w, found_from_m) in [(1.0, 0.0), (0.5, 2.0), (0.25, 3.0), (0.1, f64::INFINITY)] {
        for beside_m in [0.0, 0.5, 1.0, 2.0, 3.0, 4.0, 6.0] {
            let raised = told_with(fading, stories, seed, estimator, SHADOW_COMES_S + 20.0, |k| {
                let angle = 2.4 * k as f64;
                let offset_m = [beside_m * angle.cos(), beside_m * angle.sin()];
                intruder(SHADOW_COMES_S, power_w, &beside("u-2", offset_m))
            });
            let mut delays: Vec<f64> = raised
                .iter()
                .map(|(_, raised)| delay_s(raised, SHADOW_COMES_S))
                .collect();
            delays.sort_by(f64::total_cmp);
            let silent = raised.iter().filter(|(_, raised)| raised.is_empty()).count();
            let found = within(&delays, f64::MAX);
            let other = raised.len() - silent - found;
            let at = |k: usize| delays.get(k).copied().filter(|_| found > 0).unwrap_or(f64::NAN);
            let (median, longest) = (at(found / 2), at(found.saturating_sub(1)));
            writeln!(
                text,
                "| {power_w} | {beside_m} | {found} of {stories} | {median:.1} | {longest:.1} | {other} |"
            )
            .expect("text takes all");
            holds &= other == 0 && (beside_m < found_from_m || found == raised.len());
        }
    }
    Measured { text, holds }
}
