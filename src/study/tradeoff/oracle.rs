//! How much better `map` would be if it began at the truth: what its search leaves on the table.

use super::score::{CUTOFF_M, mean};
use super::{Cell, Noise};
use crate::assign::ospa;
use crate::estimate::stages::Stages;
use crate::estimate::{self, Emitter};

/// Mean squared errors, m², of `map` and of the more probable of it and of what it makes of the truth; frames in which the
/// truth leads to what is more probable by more than e, and of how many.
struct Oracle {
    found_m2: f64,
    best_m2: f64,
    missed: usize,
    of: usize,
}

fn squared(truth: &[[f64; 2]], emitters: &[Emitter]) -> Vec<f64> {
    let places: Vec<_> = emitters.iter().map(|e| [e.x_m, e.y_m]).collect();
    let pairs = ospa(truth, &places, CUTOFF_M).matching.pairs;
    let square = |(i, j): (usize, usize)| (0..2).map(|k| (truth[i][k] - places[j][k]).powi(2)).sum();
    pairs.into_iter().map(square).collect()
}

fn ask(cell: Cell, frames: usize, seed: u64) -> Oracle {
    let camera = cell.camera().unwrap();
    let known = cell.known_power(&camera);
    let config = estimate::Config {
        name: Some("map".to_owned()),
        known_power: Some(known.clone()),
        ..Default::default()
    };
    let mut map = estimate::build(&config, &camera).unwrap();
    let mut stages = Stages::new(&camera);
    let (mut found_m2, mut best_m2, mut missed) = (Vec::new(), Vec::new(), 0);
    for scene in cell.scenes(frames, seed).unwrap() {
        let found = map.estimate(&scene.frame).unwrap().emitters;
        stages.load(&scene.frame).unwrap();
        let mut from = |places: &[[f64; 2]]| {
            let on_sensor: Vec<_> = places.iter().map(|p| camera.to_sensor(*p)).collect();
            stages.most_probable(&known, &on_sensor)
        };
        let places: Vec<_> = found.iter().map(|e| [e.x_m, e.y_m]).collect();
        let (score, _) = from(&places);
        let (true_score, from_truth) = from(&scene.positions);
        missed += usize::from(true_score < score - 2.0);
        let best = if true_score < score { &from_truth } else { &found };
        found_m2.extend(squared(&scene.positions, &found));
        best_m2.extend(squared(&scene.positions, best));
    }
    Oracle {
        found_m2: mean(&found_m2).unwrap(),
        best_m2: mean(&best_m2).unwrap(),
        missed,
        of: frames,
    }
}

#[test]
fn the_truth_is_hardly_ever_likelier_than_what_is_found() {
    let Oracle { missed, of, .. } = ask(Cell::new(Noise::Paper, 8.0, 10), 60, 1);
    assert!(missed <= 2, "{missed} of {of}");
}

/// `cargo test --release --lib oracle -- --ignored --nocapture`
#[test]
#[ignore = "minutes; a measurement"]
fn what_no_search_could_better() {
    println!(
        "| cell | mean m² | begun at the truth as well, the likelier taken | frames where that is likelier |\n|---|---|---|---|"
    );
    let paper = [10, 20, 40, 60, 64, 80, 100].map(|n| Cell::new(Noise::Paper, 8.0, n));
    let energy = [10, 20, 40, 64, 100].map(|n| Cell::new(Noise::Energy, 4.0, n));
    for cell in paper.into_iter().chain(energy) {
        let o = ask(cell, 1000, 2);
        println!(
            "| {} | {:.3} | {:.3} | {} of {} |",
            cell.name(),
            o.found_m2,
            o.best_m2,
            o.missed,
            o.of
        );
    }
}
