//! Spots smeared by a camera that moves within an exposure: what it gains that the estimator knows the motion, and what that costs.

use std::fmt::Write;
use std::time::Instant;

use super::measured::Measured;
use crate::estimate;
use crate::optics::Smear;
use crate::study::tradeoff::{Answer, Cell, Noise, Scene, bound_ratio};

const CELLS: [(Noise, f64); 4] = [
    (Noise::Energy, 1.0),
    (Noise::Energy, 2.0),
    (Noise::Energy, 4.0),
    (Noise::Paper, 4.0),
];
/// Standard deviations of the smear, σ.
const SMEARS: [f64; 5] = [0.0, 0.2, 0.5, 1.0, 2.0];
/// Direction of the motion against the array, rad: no term of the model is aligned with it.
const DIRECTION: f64 = 0.6;
/// Of the frames whose emitters can be resolved, those with the number right, and the error over the bound, that must be reached.
const RIGHT: f64 = 0.97;
const OVER_BOUND: f64 = 1.2;

/// An estimator's answers to the frames of a cell.
struct Row {
    right: f64,
    over_bound: Option<f64>,
    /// Median of the time, µs.
    time_us: f64,
}

impl Row {
    fn measure(cell: &Cell, scenes: &[Scene], smear: Option<&Smear>) -> Self {
        let camera = cell.camera().expect("a cell of the study");
        let mut estimator = estimate::build(&estimate::Config::default(), &camera).expect("the default estimator");
        estimator.set_smear(smear);
        let (mut right, mut clear, mut ratios, mut times) = (0, 0, Vec::new(), Vec::new());
        for scene in scenes {
            let clock = Instant::now();
            let found = estimator.estimate(&scene.frame);
            times.push(1e6 * clock.elapsed().as_secs_f64());
            let positions: Vec<[f64; 2]> = found
                .map(|e| e.emitters.iter().map(|m| [m.x_m, m.y_m]).collect())
                .unwrap_or_default();
            let answer = Answer::new(scene, &positions);
            if scene.is_clear() {
                clear += 1;
                right += usize::from(answer.is_right);
            }
            ratios.extend(answer.ratios);
        }
        times.sort_by(f64::total_cmp);
        Self {
            right: right as f64 / f64::from(clear.max(1)),
            over_bound: bound_ratio(ratios),
            time_us: times[times.len() / 2],
        }
    }

    fn cells(&self) -> String {
        let ratio = self.over_bound.map_or("–".to_owned(), |r| format!("{r:.2}"));
        format!("{:.1} % | {ratio} | {:.0}", 100.0 * self.right, self.time_us)
    }
}

/// So many frames of each cell and smear.
pub fn smears(frames: u64, seed: u64) -> Measured {
    let mut text = "Number right of the frames whose emitters can be resolved; error over the bound of the smeared spots; median time, \
                    µs. Smear: standard deviation over the spot's σ, its length over √12.\n\n\
                    | cell | smear | not known: right | over bound | µs | known: right | over bound | µs |\n\
                    |---|---|---|---|---|---|---|---|\n"
        .to_owned();
    let mut holds = true;
    for (noise, sigma_mm) in CELLS {
        let cell = Cell::new(noise, sigma_mm, 64);
        for std in SMEARS {
            let length_m = 12f64.sqrt() * std * 1e-3 * sigma_mm;
            let smear = (std > 0.0).then_some(Smear {
                at_centre_m: [length_m * DIRECTION.cos(), length_m * DIRECTION.sin()],
                ..Smear::default()
            });
            let scenes = cell
                .smeared_scenes(frames as usize, seed, smear.as_ref())
                .expect("a cell of the study");
            let known = Row::measure(&cell, &scenes, smear.as_ref());
            let unknown = Row::measure(&cell, &scenes, None);
            let setting = format!("{} | {std}", cell.name());
            writeln!(text, "| {setting} | {} | {} |", unknown.cells(), known.cells()).expect("text takes all");
            holds &= known.right >= RIGHT && known.over_bound.is_none_or(|r| r <= OVER_BOUND);
        }
    }
    Measured { text, holds }
}
