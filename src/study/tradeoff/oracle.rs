//! How much a better search could improve `map`: its result against the more probable of it and of a search that starts from the
//! truth.

use std::fmt;

use super::score::{CUTOFF_M, mean};
use super::{Cell, Error, Noise};
use crate::assign::ospa;
use crate::estimate::stages::Stages;
use crate::estimate::{self, Emitter};

/// Difference of −2 ln probability from which a hypothesis counts as more probable: e times as probable.
const MORE_PROBABLE: f64 = 2.0;

/// One cell of the comparison.
#[derive(Clone, Debug)]
pub struct Oracle {
    pub cell: Cell,
    /// Mean squared error of `map`, m².
    pub found_m2: Option<f64>,
    /// The same of the more probable of the two results, m².
    pub best_m2: Option<f64>,
    /// Frames in which the search from the truth ends at a more probable hypothesis.
    pub missed: usize,
    pub frames: usize,
}

impl Oracle {
    /// Head of the table, Markdown.
    pub const HEAD: &str = "| cell | mean m² | mean m² of the more probable of it and a search from the truth | frames where the latter is more probable |\n|---|---|---|---|";

    /// The cells of the study: the paper's hardest spots on each array, and the same shape with the energy reading.
    pub fn cells() -> Vec<Cell> {
        let paper = [10, 20, 40, 60, 64, 80, 100].map(|n| Cell::new(Noise::Paper, 8.0, n));
        let energy = [10, 20, 40, 64, 100].map(|n| Cell::new(Noise::Energy, 4.0, n));
        paper.into_iter().chain(energy).collect()
    }

    /// Compares the two searches over some frames of a cell.
    ///
    /// # Errors
    /// The cell describes no camera or estimator.
    pub fn measure(cell: Cell, frames: usize, seed: u64) -> Result<Self, Error> {
        let camera = cell.camera()?;
        let known = cell.known_power(&camera);
        let config = estimate::Config {
            name: Some("map".to_owned()),
            known_power: Some(known.clone()),
            ..Default::default()
        };
        let mut map = estimate::build(&config, &camera)?;
        let mut stages = Stages::new(&camera);
        let (mut found_m2, mut best_m2, mut missed) = (Vec::new(), Vec::new(), 0);
        for scene in cell.scenes(frames, seed)? {
            let estimate = map.estimate(&scene.frame);
            let found = estimate.expect("a simulated frame is usable").emitters;
            stages.load(&scene.frame).expect("a simulated frame is usable");
            let mut search_from = |places: &[[f64; 2]]| {
                let on_sensor: Vec<_> = places.iter().map(|p| camera.to_sensor(*p)).collect();
                stages.most_probable(&known, &on_sensor)
            };
            let places: Vec<_> = found.iter().map(|e| [e.x_m, e.y_m]).collect();
            let (score, _) = search_from(&places);
            let (true_score, from_truth) = search_from(&scene.positions);
            missed += usize::from(true_score < score - MORE_PROBABLE);
            let best = match true_score < score {
                true => &from_truth,
                false => &found,
            };
            found_m2.extend(squared(&scene.positions, &found));
            best_m2.extend(squared(&scene.positions, best));
        }
        Ok(Self {
            cell,
            found_m2: mean(&found_m2),
            best_m2: mean(&best_m2),
            missed,
            frames,
        })
    }
}

/// A row of the table.
impl fmt::Display for Oracle {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let number = |v: Option<f64>| v.map_or("–".to_owned(), |v| format!("{v:.3}"));
        let (found, best) = (number(self.found_m2), number(self.best_m2));
        let name = self.cell.name();
        write!(f, "| {name} | {found} | {best} | {} of {} |", self.missed, self.frames)
    }
}

/// Squared errors of the matched pairs, m².
fn squared(truth: &[[f64; 2]], emitters: &[Emitter]) -> Vec<f64> {
    let places: Vec<_> = emitters.iter().map(|e| [e.x_m, e.y_m]).collect();
    let pairs = ospa(truth, &places, CUTOFF_M).matching.pairs;
    let square = |(i, j): (usize, usize)| (0..2).map(|k| (truth[i][k] - places[j][k]).powi(2)).sum();
    pairs.into_iter().map(square).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_search_from_the_truth_is_hardly_ever_more_probable() {
        let oracle = Oracle::measure(Cell::new(Noise::Paper, 8.0, 10), 60, 1).unwrap();
        assert!(oracle.missed <= 2, "{oracle}");
        assert!(oracle.found_m2.is_some() && oracle.best_m2.is_some(), "{oracle}");
    }
}
