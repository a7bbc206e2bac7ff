//! How often an attack is found in time, and how often peace is broken. Long runs are ignored by default:
//! `cargo test --release --test review -- --ignored --nocapture`.

use oapwatch::monitor::AlertKind::UnclaimedEmitter;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::stage::{CROWD, Story, review};

/// Of `n` shadows: how many go unseen, how often something else is alerted first, and the delays of the rest, s, rising.
fn delays(n: u64, beside_m: f64, power_w: f64, history_s: f64) -> (usize, usize, Vec<f64>) {
    let (mut other, mut silent, mut delays) = (0, 0, Vec::new());
    for seed in 0..n {
        let angle = 2.4 * seed as f64;
        let (x, y) = (beside_m * angle.cos(), beside_m * angle.sin());
        let mut story = Story::with(
            seed,
            &format!(
                "[[intruder]]\nname = \"shadow\"\npower_w = {power_w}\npresent = {{ from_s = {history_s} }}\n\
                 motion.beside = {{ user = \"u-2\", offset_m = [{x}, {y}] }}"
            ),
        );
        story.seconds = history_s + 20.0;
        let raised = review(&story).raised();
        match raised.first() {
            Some((UnclaimedEmitter, None, at)) if *at >= history_s => delays.push(at - history_s),
            Some(_) => other += 1,
            None => silent += 1,
        }
    }
    delays.sort_by(f64::total_cmp);
    (silent, other, delays)
}

#[test]
#[ignore = "minutes; see the file's head"]
fn a_shadow_by_distance_and_power() {
    println!("beside m, power of the user's: found, median and longest delay s; something else first");
    // From how far away all are found: docs/verdicts.md, "Measured".
    for (power_w, found_from_m) in [(1.0, 0.0), (0.5, 2.0), (0.25, 3.0)] {
        for beside_m in [0.0, 0.5, 1.0, 2.0, 3.0, 4.0, 6.0] {
            let n = 10;
            let (silent, other, delays) = delays(n, beside_m, power_w, 60.0);
            let found = n as usize - silent - other;
            let median = delays.get(delays.len() / 2).copied().unwrap_or(f64::NAN);
            let longest = delays.last().copied().unwrap_or(f64::NAN);
            println!("{beside_m:4} {power_w:5}: {found:2} of {n}, {median:.1}, {longest:.1}; {other}");
            assert_eq!(other, 0, "nothing else is raised");
            assert!(beside_m < found_from_m || found == n as usize, "{found} of {n}");
        }
    }
}

/// Honest users on the simulator's own pixels, half an hour of them in stories of two minutes: two roam near each other, one
/// drives sharp corners.
#[test]
#[ignore = "minutes; see the file's head"]
fn honest_pixels_raise_nothing() {
    peace(
        "[[user]]\nname = \"r-1\"\nmotion.roam = { home_m = [0, 0], spread_m = 15, time_s = 12 }\n\
             [[user]]\nname = \"r-2\"\nmotion.roam = { home_m = [10, 5], spread_m = 15, time_s = 12 }\n\
             [[user]]\nname = \"d-1\"\nmotion.walk = { through_m = [[-110, -110], [-110, 100], [-90, 110], [-90, -90], [100, -110]], \
             speed_m_s = 8 }",
    );
}

/// Users who stand so near each other that a frame hardly ever tells them all apart, half an hour of them.
#[test]
#[ignore = "minutes; see the file's head"]
fn an_honest_crowd_raises_nothing() {
    peace(CROWD);
}

/// Fifteen stories of two minutes of the four users and whom `toml` names.
fn peace(toml: &str) {
    let first = number("OAPWATCH_SEED", 1000);
    let (mut frames, mut raised) = (0, Vec::new());
    for seed in first..first + 15 {
        let mut story = Story::with(seed, toml);
        story.seconds = 120.0;
        let told = review(&story);
        frames += told.reports.len();
        raised.extend(told.raised().into_iter().map(|alert| (seed, alert)));
    }
    println!("{frames} honest frames, {} alerts", raised.len());
    assert!(raised.is_empty(), "{raised:?}");
}

fn number(name: &str, or: u64) -> u64 {
    std::env::var(name).map_or(or, |s| s.parse().expect("a number"))
}

/// A stranger who comes on anywhere in view, as strong as the users, after a quarter of a minute of peace.
#[test]
#[ignore = "minutes; see the file's head"]
fn a_stranger_anywhere_in_view() {
    const N: u64 = 1500;
    let first = number("OAPWATCH_SEED", 0);
    let mut delays = Vec::new();
    for seed in first..first + N {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let [x, y] = [0; 2].map(|_| rng.random_range(-120.0..120.0f64));
        let intruder = format!("[[intruder]]\nname = \"e\"\npresent = {{ from_s = 15 }}\nmotion.still = [{x}, {y}]");
        let mut story = Story::with(seed, &intruder);
        story.seconds = 20.0;
        let raised = review(&story).raised();
        let delay = match raised.first() {
            Some((UnclaimedEmitter, None, at)) if *at >= 15.0 => at - 15.0,
            _ => f64::INFINITY,
        };
        if delay > 1.0 || raised.len() > 1 {
            println!("({x:.1}, {y:.1}): {raised:?}");
        }
        delays.push(delay);
    }
    let within = |s: f64| delays.iter().filter(|d| **d <= s).count();
    println!(
        "of {N}: {} within 1 s, {} within 2 s, {} within 5 s",
        within(1.0),
        within(2.0),
        within(5.0)
    );
    assert!(within(1.0) as f64 >= 0.998 * N as f64);
}

/// The same within 5 m of one of the users, uniformly over that ground.
#[test]
#[ignore = "minutes; see the file's head"]
fn a_stranger_near_a_user() {
    let (first, n) = (number("OAPWATCH_SEED", 0), number("OAPWATCH_PLACES", 300));
    let mut late = [[0; 2]; 5];
    for seed in first..first + n {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let (r, angle) = (
            5.0 * rng.random::<f64>().sqrt(),
            rng.random_range(0.0..std::f64::consts::TAU),
        );
        let user = rng.random_range(1..=4);
        let (x, y) = (r * angle.cos(), r * angle.sin());
        let intruder = format!(
            "[[intruder]]\nname = \"e\"\npresent = {{ from_s = 15 }}\n\
             motion.beside = {{ user = \"u-{user}\", offset_m = [{x}, {y}] }}"
        );
        let mut story = Story::with(seed, &intruder);
        story.seconds = 20.0;
        let raised = review(&story).raised();
        let in_time = matches!(raised.first(), Some((UnclaimedEmitter, None, at)) if (15.0..=16.0).contains(at));
        if !in_time || raised.len() > 1 {
            println!("u-{user} {r:.1} m: {raised:?}");
        }
        late[r as usize][usize::from(in_time)] += 1;
    }
    for (m, [late, in_time]) in late.iter().enumerate() {
        println!("{m} to {} m: {in_time} within 1 s, {late} later", m + 1);
    }
    let far = late[3..]
        .iter()
        .fold([0, 0], |[a, b], [late, in_time]| [a + late, b + in_time]);
    assert!(50 * far[0] <= far[1], "late and in time from 3 m on: {far:?}");
}

/// A stranger within 20 m of the middle of the crowd, after forty seconds of peace.
#[test]
#[ignore = "minutes; see the file's head"]
fn a_stranger_in_a_crowd() {
    const N: u64 = 200;
    let first = number("OAPWATCH_SEED", 0);
    let (mut delays, mut before) = (Vec::new(), 0);
    for seed in first..first + N {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let (r, angle) = (
            20.0 * rng.random::<f64>().sqrt(),
            rng.random_range(0.0..std::f64::consts::TAU),
        );
        let (x, y) = (3.0 + r * angle.cos(), 3.0 + r * angle.sin());
        let intruder = format!("[[intruder]]\nname = \"e\"\npresent = {{ from_s = 40 }}\nmotion.still = [{x}, {y}]");
        let mut story = Story::with(seed, &format!("{CROWD}{intruder}"));
        story.seconds = 60.0;
        let raised = review(&story).raised();
        before += raised.iter().filter(|(.., at)| *at < 40.0).count();
        let found = raised
            .iter()
            .find(|(kind, _, at)| *kind == UnclaimedEmitter && *at >= 40.0);
        delays.push(found.map_or(f64::INFINITY, |(.., at)| at - 40.0));
    }
    delays.sort_by(f64::total_cmp);
    let within = |s: f64| delays.iter().filter(|d| **d <= s).count();
    println!(
        "of {N}: {} within 1 s, {} within 5 s, {} within 20 s; {before} alerts before",
        within(1.0),
        within(5.0),
        within(20.0)
    );
    assert_eq!(before, 0);
}
