//! Where learning helps: the pure network, the network in front of the joint fit, and the joint fit alone, on the same frames of
//! a device that is not what its config says. Prints a Markdown table: `cargo bench --bench mismatch -- [FRAMES]`; or of one scene by one
//! config, with its calibration and its network: `cargo bench --bench mismatch -- FRAMES SCENE CONFIG`.

use std::time::Instant;

use oapwatch::assign::ospa;
use oapwatch::estimate::{Config, build};
use oapwatch::optics::Camera;
use oapwatch::scene::{Plan, Scene};

const SCENE: &str = include_str!("../training/scenes/energy-1mm.toml");
const ESTIMATORS: [&str; 3] = ["network", "hybrid", "ml"];
const SEED: u64 = 11;
const CUTOFF_M: f64 = 25.0;

/// What is wrong, by the lines that say so in a scene; the estimators are told of none of it.
struct Mismatch {
    name: &'static str,
    spot_sigma_m: f64,
    effects: &'static str,
}

const fn effect(name: &'static str, effects: &'static str) -> Mismatch {
    Mismatch {
        name,
        spot_sigma_m: 1e-3,
        effects,
    }
}

const fn width(name: &'static str, spot_sigma_m: f64) -> Mismatch {
    Mismatch {
        name,
        spot_sigma_m,
        effects: "",
    }
}

/// A typical spot's brightest pixel holds 280 µJ. A corner is displaced by k1·(tan θ)² of its radius, (tan θ)² = 0.347.
const MISMATCHES: [Mismatch; 13] = [
    effect("none", ""),
    width("spots 10 % narrower", 0.9e-3),
    width("spots 10 % wider", 1.1e-3),
    effect("half of σ² a defocus disc", "aberrations = { defocus_share = 0.5 }"),
    effect(
        "nine tenths of σ² a defocus disc",
        "aberrations = { defocus_share = 0.9 }",
    ),
    effect("coma, 0.3 mm in the corner", "aberrations = { coma_m = 3e-4 }"),
    effect("coma, 1 mm in the corner", "aberrations = { coma_m = 1e-3 }"),
    effect("gain scatter 1 %", "gain = { std = 0.01 }"),
    effect("gain scatter 5 %", "gain = { std = 0.05 }"),
    effect(
        "distortion 0.5 % in the corner",
        "distortion = { radial = [0.0144, 0, 0] }",
    ),
    effect(
        "distortion 2 % in the corner",
        "distortion = { radial = [0.0576, 0, 0] }",
    ),
    effect(
        "background, 60 µJ and a slope of 30 µJ to each edge",
        "background = { uniform_j = 6e-5, gradient_j = [3e-5, -3e-5] }",
    ),
    effect(
        "background, three glows of 30 µJ, 20 to 40 m wide",
        "glint = [{ at_m = [-60, 40], spread_m = 30, peak_j = 3e-5 }, { at_m = [80, 70], spread_m = 20, peak_j = 3e-5 }, \
         { at_m = [30, -80], spread_m = 40, peak_j = 3e-5 }]",
    ),
];

fn main() {
    let args: Vec<String> = std::env::args().skip(1).filter(|a| !a.starts_with("--")).collect();
    let frames = args.first().map_or(200, |a| a.parse().expect("a number of frames"));
    let head = "| mismatch | estimator | median m² | mean m² | missed | invented | N right | OSPA m | median ms |\n|---|---|---|---|---|---|---|---|---|";
    if let [_, scene, config] = &args[..] {
        let config = oapwatch::config::Config::load(config.as_ref()).expect("a config");
        let camera = config.camera().expect("valid optics");
        println!("{frames} frames of {scene}, seed {SEED}.\n\n{head}");
        let scene = Scene::load(scene.as_ref()).expect("a valid scene");
        return measure("the config's", &scene, frames, &camera, &config.estimator);
    }
    let nominal: Scene = toml::from_str(SCENE).expect("the scene is part of the repository");
    let camera = nominal.optics.camera().expect("valid optics");
    println!("{frames} frames of 5 to 9 emitters, σ_eff 1 mm, 1 µJ, 64 × 64 pixels, seed {SEED}.\n\n{head}");
    for mismatch in &MISMATCHES {
        let mut scene: Scene = toml::from_str(&format!("{SCENE}\n{}", mismatch.effects)).expect("a valid scene");
        scene.optics.spot_sigma_m = Some(mismatch.spot_sigma_m);
        measure(mismatch.name, &scene, frames, &camera, &Config::default());
    }
}

/// Prints a row for each estimator.
fn measure(name: &str, scene: &Scene, frames: u64, camera: &Camera, config: &Config) {
    let frames = Plan::compile(scene, SEED).expect("a valid scene").frames(0, frames);
    for estimator in ESTIMATORS {
        let config = Config {
            name: Some(estimator.to_owned()),
            ..config.clone()
        };
        let mut measured = build(&config, camera).expect("an estimator of the list");
        let (mut squared, mut times) = (Vec::new(), Vec::new());
        let (mut missed, mut invented, mut right, mut emitters, mut distance) = (0, 0, 0, 0, 0.0);
        for simulated in &frames {
            let clock = Instant::now();
            let found = measured.estimate(&simulated.frame).expect("a usable frame");
            times.push(clock.elapsed().as_secs_f64() * 1e3);
            let truth: Vec<[f64; 2]> = simulated.truth.emitters.iter().map(|e| [e.x_m, e.y_m]).collect();
            let at: Vec<[f64; 2]> = found.emitters.iter().map(|e| [e.x_m, e.y_m]).collect();
            let score = ospa(&truth, &at, CUTOFF_M);
            distance += score.distance_m;
            missed += score.matching.unmatched_rows.len();
            invented += score.matching.unmatched_columns.len();
            emitters += truth.len();
            right += usize::from(truth.len() == at.len());
            let pairs = score.matching.pairs.iter();
            squared.extend(pairs.map(|&(t, e)| {
                let (t, e) = (truth[t], at[e]);
                (t[0] - e[0]).powi(2) + (t[1] - e[1]).powi(2)
            }));
        }
        squared.sort_by(f64::total_cmp);
        times.sort_by(f64::total_cmp);
        let share = |n: usize, of: usize| 100.0 * n as f64 / of as f64;
        println!(
            "| {name} | {estimator} | {:.2e} | {:.2e} | {:.1} % | {:.1} % | {:.0} % | {:.3} | {:.1} |",
            squared[squared.len() / 2],
            squared.iter().sum::<f64>() / squared.len() as f64,
            share(missed, emitters),
            share(invented, emitters),
            share(right, frames.len()),
            distance / frames.len() as f64,
            times[times.len() / 2],
        );
    }
}
