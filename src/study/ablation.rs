//! What each rule of the estimator gains and costs: the same frames with every rule and without each one in turn.

use std::fmt::Write;
use std::time::Instant;

use super::tradeoff::{Answer, CUTOFF_M, Cell, Error, Scene, bound_ratio};
use crate::estimate::{self, Estimator, Rules};

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
    /// Trimmed ratio of squared error to the bound, and mean squared error over matched pairs, m²: with the rule and without it.
    pub bound_ratio: [Option<f64>; 2],
    pub mean_m2: [Option<f64>; 2],
    /// OSPA without the rule minus OSPA with it, m: mean over all frames and its standard error.
    pub ospa_more_m: f64,
    pub ospa_error_m: f64,
    /// Cell in which the mean OSPA rises most without the rule, and by how much, m.
    pub needed_most: Option<(String, f64)>,
    /// Steps of fits without the rule over steps with it, the same of times, and of the times' 99th percentiles.
    pub steps_ratio: f64,
    pub time_ratio: f64,
    pub p99_ratio: f64,
}

/// What an estimator said of a frame, and what that cost.
struct Said {
    answer: Answer,
    positions: Vec<[f64; 2]>,
    steps: u64,
    seconds: f64,
}

/// All frames of one cell: what was said with every rule, then without each.
struct OfCell {
    name: String,
    said: Vec<Vec<Said>>,
}

/// Measures every rule with every estimator. `progress` is told of each cell.
pub fn run(plan: &Plan, progress: &mut dyn FnMut(&Cell)) -> Result<Vec<Effect>, Error> {
    let all = std::iter::once(Rules::default());
    let rules: Vec<Rules> = (all.chain(
        plan.without
            .iter()
            .map(|rule| Rules::without(rule).expect("a plan names rules that there are")),
    ))
    .collect();
    let mut measured: Vec<Vec<OfCell>> = plan.estimators.iter().map(|_| Vec::new()).collect();
    for cell in &plan.cells {
        let scenes = cell.scenes(plan.frames, plan.seed)?;
        for (estimator, of_cells) in plan.estimators.iter().zip(&mut measured) {
            of_cells.push(OfCell {
                name: cell.name(),
                said: ask(cell, estimator, &rules, &scenes)?,
            });
        }
        progress(cell);
    }
    let effects = (plan.estimators.iter().zip(&measured)).flat_map(|(estimator, of_cells)| {
        let each = plan.without.iter().zip(1..);
        each.map(|(rule, index)| Effect::of(rule, estimator, index, of_cells))
    });
    Ok(effects.collect())
}

/// What an estimator says of every scene under each set of rules. Each frame is given to all of them in a row, to another one first from
/// frame to frame, so that a slow moment and cold caches hit all alike.
fn ask(cell: &Cell, estimator: &str, rules: &[Rules], scenes: &[Scene]) -> Result<Vec<Vec<Said>>, Error> {
    let camera = cell.camera()?;
    let mut estimators = Vec::new();
    for rules in rules {
        let config = estimate::Config {
            name: Some(estimator.to_owned()),
            known_power: Some(cell.known_power(&camera)),
            rules: *rules,
            ..Default::default()
        };
        let mut estimator = estimate::build(&config, &camera)?;
        if let Some(first) = scenes.first() {
            // Scratch memory grows with the first frame.
            let _ = estimator.estimate(&first.frame);
        }
        estimators.push(estimator);
    }
    let mut said: Vec<Vec<Said>> = rules.iter().map(|_| Vec::new()).collect();
    for (turn, scene) in scenes.iter().enumerate() {
        for k in 0..rules.len() {
            let which = (k + turn) % rules.len();
            said[which].push(Said::new(estimators[which].as_mut(), scene));
        }
    }
    Ok(said)
}

impl Said {
    fn new(estimator: &mut dyn Estimator, scene: &Scene) -> Self {
        let clock = Instant::now();
        let found = estimator.estimate(&scene.frame);
        let seconds = clock.elapsed().as_secs_f64();
        let (emitters, steps) = found.map(|e| (e.emitters, e.steps)).unwrap_or_default();
        let positions: Vec<[f64; 2]> = emitters.iter().map(|m| [m.x_m, m.y_m]).collect();
        Self {
            answer: Answer::new(scene, &positions),
            positions,
            steps,
            seconds,
        }
    }
}

impl Effect {
    fn of(rule: &'static str, estimator: &'static str, index: usize, cells: &[OfCell]) -> Self {
        let frames: Vec<[&Said; 2]> = (cells.iter())
            .flat_map(|c| {
                c.said[0]
                    .iter()
                    .zip(&c.said[index])
                    .map(|(with, without)| [with, without])
            })
            .collect();
        let n = frames.len().max(1) as f64;
        let rise = |[with, without]: &[&Said; 2]| without.answer.ospa_m - with.answer.ospa_m;
        let mean = frames.iter().map(rise).sum::<f64>() / n;
        let variance = frames.iter().map(|f| (rise(f) - mean).powi(2)).sum::<f64>() / (n - 1.0).max(1.0);
        let of_cells = cells.iter().map(|cell| {
            let rises = cell.said[0].iter().zip(&cell.said[index]).map(|(a, b)| rise(&[a, b]));
            (cell.name.clone(), rises.sum::<f64>() / cell.said[0].len().max(1) as f64)
        });
        let needed_most = (of_cells.max_by(|a, b| a.1.total_cmp(&b.1))).filter(|(_, rise)| *rise > 0.0);
        let count = |is: &dyn Fn(&[&Said; 2]) -> bool| frames.iter().filter(|f| is(f)).count();
        let more = |of: &dyn Fn(&Answer) -> usize| -> i64 {
            frames
                .iter()
                .map(|[a, b]| of(&b.answer) as i64 - of(&a.answer) as i64)
                .sum()
        };
        let seconds = |which: usize| frames.iter().map(|f| f[which].seconds).collect::<Vec<f64>>();
        let steps = |which: usize| frames.iter().map(|f| f[which].steps).sum::<u64>() as f64;
        let (with, without) = (seconds(0), seconds(1));
        Self {
            rule,
            estimator,
            frames: frames.len(),
            changed: count(&|[a, b]| a.positions != b.positions),
            right_only_with: count(&|[a, b]| a.answer.is_right && !b.answer.is_right),
            right_only_without: count(&|[a, b]| !a.answer.is_right && b.answer.is_right),
            missed_more: more(&|a| a.missed),
            invented_more: more(&|a| a.invented),
            bound_ratio: [0, 1].map(|which| bound_ratio(frames.iter().flat_map(|f| f[which].answer.ratios.clone()))),
            mean_m2: [0, 1].map(|which| mean_m2(frames.iter().flat_map(|f| &f[which].answer.squared_m2))),
            ospa_more_m: mean,
            ospa_error_m: (variance / n).sqrt(),
            needed_most,
            steps_ratio: steps(1) / steps(0),
            time_ratio: without.iter().sum::<f64>() / with.iter().sum::<f64>(),
            p99_ratio: p99(without) / p99(with),
        }
    }
}

fn mean_m2<'a>(squared: impl Iterator<Item = &'a f64>) -> Option<f64> {
    let (sum, count) = squared.fold((0.0, 0.0), |(sum, count), s| (sum + s, count + 1.0));
    (count > 0.0).then_some(sum / count)
}

fn p99(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    let last = values.len().saturating_sub(1) as f64;
    values.get((0.99 * last).round() as usize).copied().unwrap_or(f64::NAN)
}

/// The effects as a Markdown table, each of a rule's absence.
pub fn markdown(effects: &[Effect], plan: &Plan) -> String {
    let mut text = format!(
        "{} frames of each of {} cells, seed {}, each with every rule and without each one. r is the trimmed ratio to the bound and m² the \
         mean squared error, with the rule and without it. OSPA (order 2, {CUTOFF_M} m) is without the rule minus with it, ± one standard error: positive means that \
         the rule helps. Steps of fits, time and its 99th percentile are without over with: above 1 the rule saves them.\n\n\
         | without | estimator | answers changed | number right only with | only without | missed | invented | r | m² | OSPA m | needed most in | steps | time | 99th |\n\
         |---|---|---|---|---|---|---|---|---|---|---|---|---|---|\n",
        plan.frames,
        plan.cells.len(),
        plan.seed
    );
    let r = |r: Option<f64>| r.map_or("–".to_owned(), |r| format!("{r:.3}"));
    for e in effects {
        let needed = e.needed_most.as_ref();
        let _ = writeln!(
            text,
            "| {} | {} | {:.1} % | {} | {} | {:+} | {:+} | {}, {} | {}, {} | {:+.4} ± {:.4} | {} | {:.3} | {:.2} | {:.2} |",
            e.rule,
            e.estimator,
            100.0 * e.changed as f64 / e.frames.max(1) as f64,
            e.right_only_with,
            e.right_only_without,
            e.missed_more,
            e.invented_more,
            r(e.bound_ratio[0]),
            r(e.bound_ratio[1]),
            r(e.mean_m2[0]),
            r(e.mean_m2[1]),
            e.ospa_more_m,
            e.ospa_error_m,
            needed.map_or("–".to_owned(), |(cell, rise)| format!("{cell} ({rise:+.3})")),
            e.steps_ratio,
            e.time_ratio,
            e.p99_ratio
        );
    }
    text
}
