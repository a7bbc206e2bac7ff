//! Frames together: the error of `sequence` against the bound of all frames so far, and of `ml` on the newest one.

use std::fmt::Write;
use std::time::Instant;

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use super::measured::Measured;
use crate::assign::ospa;
use crate::estimate::{self, Estimate, Estimator, Rules};
use crate::optics::Camera;
use crate::study::tradeoff::{CUTOFF_M, Cell, Noise, Snapshots, Walk, is_apart};

/// Numbers of frames after which answers are scored.
const AFTER: [usize; 4] = [10, 30, 100, 300];
const RATES_HZ: [f64; 2] = [10.0, 100.0];
const RELATIVE_STDS: [f64; 3] = [0.09, 0.29, 0.9];
const CELLS: [(Noise, f64); 6] = [
    (Noise::Energy, 1.0),
    (Noise::Energy, 2.0),
    (Noise::Energy, 4.0),
    (Noise::Energy, 6.0),
    (Noise::Energy, 8.0),
    (Noise::Paper, 8.0),
];
/// Emitters of the cells that hold many, and the strength of their fading.
const MANY: [usize; 2] = [20, 40];
const STD_OF_MANY: f64 = 0.29;
/// A walk of these for so many of any other cell.
const OF_MANY: u64 = 4;
/// Times as many walks of the paper's scene as of any other cell.
const OF_PAPER: u64 = 5;
/// Largest error over the bound, smallest share of numbers right, and largest error in the paper's scene, m².
const MOST_OVER_BOUND: f64 = 1.2;
const RIGHT: f64 = 0.99;
const PAPER_RIGHT: f64 = 0.95;
const PAPER_M2: f64 = 1.0;

const HEADER: &str = "| cell | rate, Hz | std of energy | frames | bound (median), m² | `sequence` over bound | `ml` over bound | number \
                      right: `sequence` | `ml` | median, µs | 99th, µs |\n|---|---|---|---|---|---|---|---|---|---|---|\n";

/// What came of an estimator's answers after so many frames.
#[derive(Default)]
struct Tally {
    /// Squared errors of all emitters, m², and over the bound of those that can be resolved; ∞ for a missed one.
    errors: Vec<f64>,
    ratios: Vec<f64>,
    /// Walks, those with all emitters resolvable, and of each those with their number right.
    walks: usize,
    clear: usize,
    right: usize,
    clear_right: usize,
}

impl Tally {
    fn add(&mut self, truth: &[[f64; 2]], bounds: &[f64], estimate: Option<&Estimate>) {
        let emitters = estimate.map_or(&[][..], |e| &e.emitters);
        let found: Vec<[f64; 2]> = emitters.iter().map(|e| [e.x_m, e.y_m]).collect();
        let mut errors = vec![f64::INFINITY; truth.len()];
        for (i, j) in ospa(truth, &found, CUTOFF_M).matching.pairs {
            errors[i] = (truth[i][0] - found[j][0]).powi(2) + (truth[i][1] - found[j][1]).powi(2);
        }
        let is_apart: Vec<bool> = (0..truth.len()).map(|i| is_apart(truth, bounds, i)).collect();
        let resolvable = (0..truth.len()).filter(|i| is_apart[*i]);
        self.ratios.extend(resolvable.map(|i| errors[i] / bounds[i]));
        self.errors.extend(errors);
        let is_right = found.len() == truth.len();
        let is_clear = is_apart.iter().all(|a| *a);
        self.walks += 1;
        self.right += usize::from(is_right);
        self.clear += usize::from(is_clear);
        self.clear_right += usize::from(is_clear && is_right);
    }

    /// Median of the squared error over the bound; 1 is at the bound: that of a χ² variate of two degrees of freedom is divided out.
    fn over_bound(&self) -> Option<f64> {
        median(&self.ratios).map(|r| r / std::f64::consts::LN_2)
    }
}

/// `sequence`, and `ml` on the newest frame, after so many frames.
#[derive(Default)]
struct Row {
    bounds: Vec<f64>,
    together: Tally,
    alone: Tally,
    /// Of `sequence`, for frames since the row before.
    times_us: Vec<f64>,
}

/// So many walks of each cell, frame rate and strength of the fading.
pub fn frames_together(walks: u64, seed: u64, estimator: &estimate::Config) -> Measured {
    let mut text = format!(
        "Squared error over the bound of all frames so far (1 is at the bound), median over resolvable emitters, a missed one counting as \
         ∞; number right: of the walks where all emitters are resolvable.\n\n{HEADER}"
    );
    let (mut cells, mut at_bound, mut clear, mut right) = (0, 0, 0, 0);
    for (noise, sigma_mm) in CELLS {
        let cell = Cell::new(noise, sigma_mm, 64);
        for rate_hz in RATES_HZ {
            for relative_std in RELATIVE_STDS {
                let walk = Walk {
                    emitters: None,
                    frames: AFTER[AFTER.len() - 1],
                    rate_hz,
                    speed_m_s: 1.0,
                    relative_std,
                };
                let rows = measure(&cell, &walk, &AFTER, walks, seed, estimator.rules);
                for (frames, row) in AFTER.into_iter().zip(&rows) {
                    let setting = format!("{} | {rate_hz} | {relative_std} | {frames}", cell.name());
                    writeln!(text, "| {setting} | {} |", row.cells()).expect("text takes all");
                    clear += row.together.clear;
                    right += row.together.clear_right;
                    if let Some(ratio) = row.together.over_bound() {
                        cells += 1;
                        at_bound += usize::from(ratio <= MOST_OVER_BOUND);
                    }
                }
            }
        }
    }
    let many = many(walks.div_ceil(OF_MANY), seed, estimator.rules);
    let (paper, paper_holds) = paper(OF_PAPER * walks, seed, estimator.rules);
    let share = right as f64 / clear.max(1) as f64;
    write!(
        text,
        "\n{at_bound} of {cells} rows with resolvable emitters within {MOST_OVER_BOUND} of the bound; number right in {right} of {clear} \
         answers where all are resolvable\n\n{many}\n{paper}"
    )
    .expect("text takes all");
    Measured {
        text,
        holds: at_bound == cells && share >= RIGHT && paper_holds,
    }
}

/// Many emitters at 10 Hz.
fn many(walks: u64, seed: u64, rules: Rules) -> String {
    let mut text = HEADER.to_owned();
    for emitters in MANY {
        let cell = Cell::new(Noise::Energy, 1.0, 64).holding(emitters);
        let walk = Walk {
            emitters: Some(emitters),
            frames: AFTER[AFTER.len() - 1],
            rate_hz: 10.0,
            speed_m_s: 1.0,
            relative_std: STD_OF_MANY,
        };
        for (frames, row) in AFTER.into_iter().zip(measure(&cell, &walk, &AFTER, walks, seed, rules)) {
            let setting = format!("{} | 10 | {STD_OF_MANY} | {frames}", cell.name());
            writeln!(text, "| {setting} | {} |", row.cells()).expect("text takes all");
        }
    }
    text
}

/// The paper's scene to the letter: σ_eff 8 mm, N₀ 10⁻¹², users who stand still, strong fading.
fn paper(walks: u64, seed: u64, rules: Rules) -> (String, bool) {
    let walk = Walk {
        emitters: None,
        frames: 100,
        rate_hz: 10.0,
        speed_m_s: 0.0,
        relative_std: 0.9,
    };
    let rows = measure(&Cell::new(Noise::Energy, 8.0, 64), &walk, &[1, 100], walks, seed, rules);
    let mut text = "The paper's scene, users still, std .9:\n\n| frames | bound (median), m² | median error, m² | number right | `ml`: median \
                    error, m² | number right |\n|---|---|---|---|---|---|\n"
        .to_owned();
    for (frames, row) in [1, 100].into_iter().zip(&rows) {
        let of = |tally: &Tally| {
            let error = number(median(&tally.errors));
            format!("{error} | {} of {}", tally.right, tally.walks)
        };
        let bound = number(median(&row.bounds));
        writeln!(
            text,
            "| {frames} | {bound} | {} | {} |",
            of(&row.together),
            of(&row.alone)
        )
        .expect("text takes all");
    }
    let last = &rows[1].together;
    let is_near = median(&last.errors).is_some_and(|e| e <= PAPER_M2);
    (text, is_near && last.right as f64 >= PAPER_RIGHT * last.walks as f64)
}

fn measure(cell: &Cell, walk: &Walk, after: &[usize], walks: u64, seed: u64, rules: Rules) -> Vec<Row> {
    let camera = cell.camera().expect("a camera");
    let mut rows: Vec<Row> = after.iter().map(|_| Row::default()).collect();
    for k in seed..seed + walks {
        let mut rng = ChaCha8Rng::seed_from_u64(k);
        let snapshots = Snapshots::draw(&camera, walk, &mut rng);
        let bounds = snapshots.bounds_m2(&camera, after, walk.speed_m_s > 0.0);
        let mut together = named("sequence", rules, &camera);
        for frame in 0..walk.frames {
            let shown = snapshots.frame(&camera, frame, &mut rng);
            let at = after
                .iter()
                .position(|last| frame < *last)
                .expect("scored after the last frame");
            let clock = Instant::now();
            let answer = together.estimate(&shown).ok();
            rows[at].times_us.push(1e6 * clock.elapsed().as_secs_f64());
            if frame + 1 == after[at] {
                let truth = snapshots.positions(frame);
                rows[at].together.add(&truth, &bounds[at], answer.as_ref());
                let alone = named("ml", rules, &camera).estimate(&shown).ok();
                rows[at].alone.add(&truth, &bounds[at], alone.as_ref());
                rows[at].bounds.extend_from_slice(&bounds[at]);
            }
        }
    }
    rows
}

fn named(name: &str, rules: Rules, camera: &Camera) -> Box<dyn Estimator> {
    let config = estimate::Config {
        name: Some(name.to_owned()),
        rules,
        ..Default::default()
    };
    estimate::build(&config, camera).expect("an estimator")
}

impl Row {
    fn cells(&self) -> String {
        let ratio = |tally: &Tally| match tally.over_bound() {
            Some(r) if r.is_finite() => format!("{r:.2}"),
            Some(_) => "∞".to_owned(),
            None => "–".to_owned(),
        };
        let right = |tally: &Tally| format!("{} of {}", tally.clear_right, tally.clear);
        let [median_us, p99_us] = [0.5, 0.99].map(|q| quantile(&self.times_us, q).unwrap_or(f64::NAN));
        format!(
            "{} | {} | {} | {} | {} | {median_us:.0} | {p99_us:.0}",
            number(median(&self.bounds)),
            ratio(&self.together),
            ratio(&self.alone),
            right(&self.together),
            right(&self.alone)
        )
    }
}

fn number(v: Option<f64>) -> String {
    match v {
        Some(v) if v.is_finite() => format!("{v:.2e}"),
        _ => "–".to_owned(),
    }
}

fn median(values: &[f64]) -> Option<f64> {
    quantile(values, 0.5)
}

fn quantile(values: &[f64], share: f64) -> Option<f64> {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    sorted
        .get(((sorted.len().max(1) - 1) as f64 * share).round() as usize)
        .copied()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_together_are_nearer_than_the_newest_alone() {
        let walk = Walk {
            emitters: None,
            frames: 10,
            rate_hz: 10.0,
            speed_m_s: 1.0,
            relative_std: 0.29,
        };
        let rows = measure(&Cell::new(Noise::Energy, 2.0, 64), &walk, &[10], 4, 1, Rules::default());
        let [together, alone] = [&rows[0].together, &rows[0].alone].map(|t| t.over_bound().unwrap());
        assert!(together < 1.6 && alone > 1.5 * together, "{together} {alone}");
    }

    #[test]
    fn a_missed_emitter_counts_as_infinitely_far() {
        let mut tally = Tally::default();
        tally.add(&[[0.0, 0.0], [50.0, 0.0]], &[1.0, 1.0], None);
        assert!(tally.ratios == [f64::INFINITY; 2] && tally.clear == 1 && tally.clear_right == 0);
    }
}
