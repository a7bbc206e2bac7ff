//! What each rule of the estimator gains and costs: the same frames with every rule and without one, in turns.

use std::fmt::Write;
use std::time::Instant;

use super::tradeoff::{CUTOFF_M, Cell, Error, Scene};
use crate::assign::ospa;
use crate::estimate::{self, Emitter, Estimator, Rules};

/// What to measure.
#[derive(Clone, Debug)]
pub struct Plan {
    pub cells: Vec<Cell>,
    pub estimators: Vec<&'static str>,
    /// Rules to leave out, one at a time.
    pub without: Vec<&'static str>,
    /// Frames a cell.
    pub frames: usize,
    pub seed: u64,
}

/// What leaving out one rule does to one estimator, over all frames of all cells.
#[derive(Clone, Debug)]
pub struct Effect {
    pub rule: &'static str,
    pub estimator: &'static str,
    pub frames: usize,
    /// Frames whose answer is not the same to the bit.
    pub changed: usize,
    /// Frames whose number of emitters is right only with the rule, and only without it.
    pub right_only_with: usize,
    pub right_only_without: usize,
    pub missed_more: i64,
    pub invented_more: i64,
    /// OSPA without the rule minus OSPA with it, m: mean over all frames and its standard error.
    pub ospa_more_m: f64,
    pub ospa_error_m: f64,
    /// Cell in which the mean OSPA rises most without the rule, and by how much, m.
    pub needed_most: Option<(String, f64)>,
    /// Time without the rule over time with it: of the sums, and of the 99th percentiles.
    pub time_ratio: f64,
    pub p99_ratio: f64,
}

/// One estimator with and without a rule in one cell.
struct Pair {
    estimators: [Box<dyn Estimator>; 2],
}

/// What the two said of one frame, first with the rule.
struct Compared {
    is_changed: bool,
    is_right: [bool; 2],
    missed: [i64; 2],
    invented: [i64; 2],
    ospa_m: [f64; 2],
    seconds: [f64; 2],
}

/// Measures every rule with every estimator. `progress` is told of each cell.
pub fn run(plan: &Plan, progress: &mut dyn FnMut(&Cell)) -> Result<Vec<Effect>, Error> {
    let mut effects = Vec::new();
    let mut compared: Vec<Vec<Vec<Compared>>> = Vec::new();
    let questions: Vec<_> = (plan.without.iter())
        .flat_map(|rule| plan.estimators.iter().map(move |estimator| (*rule, *estimator)))
        .collect();
    for cell in &plan.cells {
        let scenes = cell.scenes(plan.frames, plan.seed)?;
        let mut of_cell = Vec::new();
        for (rule, estimator) in &questions {
            let mut pair = Pair::new(cell, estimator, rule)?;
            if let Some(first) = scenes.first() {
                // Scratch memory grows with the first frame.
                pair.compare(first, 0);
            }
            of_cell.push(scenes.iter().enumerate().map(|(k, s)| pair.compare(s, k)).collect());
        }
        compared.push(of_cell);
        progress(cell);
    }
    for (k, (rule, estimator)) in questions.into_iter().enumerate() {
        let cells = plan
            .cells
            .iter()
            .zip(&compared)
            .map(|(cell, of_cell)| (cell, &of_cell[k]));
        effects.push(Effect::of(rule, estimator, &cells.collect::<Vec<_>>()));
    }
    Ok(effects)
}

impl Pair {
    fn new(cell: &Cell, estimator: &str, rule: &str) -> Result<Self, Error> {
        let camera = cell.camera()?;
        let build = |rules| {
            let config = estimate::Config {
                name: Some(estimator.to_owned()),
                known_power: Some(cell.known_power(&camera)),
                rules,
                ..Default::default()
            };
            estimate::build(&config, &camera)
        };
        let without = Rules::without(rule).expect("a plan names rules that there are");
        Ok(Self {
            estimators: [build(Rules::default())?, build(without)?],
        })
    }

    /// Which of the two goes first alternates with `turn`, so that neither always finds the caches warm.
    fn compare(&mut self, scene: &Scene, turn: usize) -> Compared {
        let mut seconds = [0.0; 2];
        let mut said: [Vec<Emitter>; 2] = Default::default();
        for which in if turn.is_multiple_of(2) { [0, 1] } else { [1, 0] } {
            let clock = Instant::now();
            let found = self.estimators[which].estimate(&scene.frame);
            seconds[which] = clock.elapsed().as_secs_f64();
            said[which] = found.map(|e| e.emitters).unwrap_or_default();
        }
        let positions = said
            .each_ref()
            .map(|e| e.iter().map(|m| [m.x_m, m.y_m]).collect::<Vec<_>>());
        let scores = positions.each_ref().map(|p| ospa(&scene.positions, p, CUTOFF_M));
        Compared {
            is_changed: positions[0] != positions[1],
            is_right: positions.each_ref().map(|p| p.len() == scene.positions.len()),
            missed: scores.each_ref().map(|s| s.matching.unmatched_rows.len() as i64),
            invented: scores.each_ref().map(|s| s.matching.unmatched_columns.len() as i64),
            ospa_m: scores.each_ref().map(|s| s.distance_m),
            seconds,
        }
    }
}

impl Effect {
    fn of(rule: &'static str, estimator: &'static str, cells: &[(&Cell, &Vec<Compared>)]) -> Self {
        let all: Vec<&Compared> = cells.iter().flat_map(|(_, of_cell)| of_cell.iter()).collect();
        let n = all.len().max(1) as f64;
        let rise = |c: &Compared| c.ospa_m[1] - c.ospa_m[0];
        let mean = all.iter().map(|c| rise(c)).sum::<f64>() / n;
        let variance = all.iter().map(|c| (rise(c) - mean).powi(2)).sum::<f64>() / (n - 1.0).max(1.0);
        let of_cells = cells.iter().map(|(cell, of_cell)| {
            let mean = of_cell.iter().map(rise).sum::<f64>() / of_cell.len().max(1) as f64;
            (cell.name(), mean)
        });
        let needed_most = of_cells
            .max_by(|a, b| a.1.total_cmp(&b.1))
            .filter(|(_, rise)| *rise > 0.0);
        let seconds = |which: usize| all.iter().map(|c| c.seconds[which]).collect::<Vec<f64>>();
        let (with, without) = (seconds(0), seconds(1));
        Self {
            rule,
            estimator,
            frames: all.len(),
            changed: all.iter().filter(|c| c.is_changed).count(),
            right_only_with: all.iter().filter(|c| c.is_right == [true, false]).count(),
            right_only_without: all.iter().filter(|c| c.is_right == [false, true]).count(),
            missed_more: all.iter().map(|c| c.missed[1] - c.missed[0]).sum(),
            invented_more: all.iter().map(|c| c.invented[1] - c.invented[0]).sum(),
            ospa_more_m: mean,
            ospa_error_m: (variance / n).sqrt(),
            needed_most,
            time_ratio: without.iter().sum::<f64>() / with.iter().sum::<f64>(),
            p99_ratio: p99(without) / p99(with),
        }
    }
}

fn p99(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    let last = values.len().saturating_sub(1) as f64;
    values.get((0.99 * last).round() as usize).copied().unwrap_or(f64::NAN)
}

/// The effects as a Markdown table, each of a rule's absence.
pub fn markdown(effects: &[Effect], plan: &Plan) -> String {
    let mut text = format!(
        "{} frames of each of {} cells, seed {}; with and without the rule in turns on the same frames. OSPA (order 2, {CUTOFF_M} m) is \
         without the rule minus with it, ± one standard error: positive means that the rule helps. Ratios are without over with: above 1 \
         the rule saves time.\n\n\
         | without | estimator | answers changed | number right only with | only without | missed | invented | OSPA m | needed most in | time | 99th |\n\
         |---|---|---|---|---|---|---|---|---|---|---|\n",
        plan.frames,
        plan.cells.len(),
        plan.seed
    );
    for e in effects {
        let needed = e.needed_most.as_ref();
        let _ = writeln!(
            text,
            "| {} | {} | {:.2} % | {} | {} | {:+} | {:+} | {:+.4} ± {:.4} | {} | {:.3} | {:.3} |",
            e.rule,
            e.estimator,
            100.0 * e.changed as f64 / e.frames.max(1) as f64,
            e.right_only_with,
            e.right_only_without,
            e.missed_more,
            e.invented_more,
            e.ospa_more_m,
            e.ospa_error_m,
            needed.map_or("–".to_owned(), |(cell, rise)| format!("{cell} ({rise:+.3})")),
            e.time_ratio,
            e.p99_ratio
        );
    }
    text
}
