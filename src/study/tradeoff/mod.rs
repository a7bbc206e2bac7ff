//! The trade-off study: accuracy and time of every estimator on the same frames, against the Cramér–Rao bound.

mod condition;
mod error;
mod exposure;
mod networks;
mod oracle;
mod picture;
mod report;
mod scene;
mod score;
mod snapshots;

use std::path::Path;

use crate::estimate::Learned;
pub(in crate::study) use networks::Candidate;
pub(in crate::study) use scene::Scene;
pub(in crate::study) use score::{Answer, CUTOFF_M, bound_ratio, is_apart};
pub(in crate::study) use snapshots::{Snapshots, Walk};

pub use condition::Condition;
pub use error::{Error, PictureError};
pub use exposure::CELLS as EXPOSURE_CELLS;
pub use networks::{Trained, Training};
pub use oracle::Oracle;
pub use scene::{Cell, Noise};
pub(super) use score::of_single_frames;
pub use score::{Row, Study};

/// Cells, estimators and frames to measure.
#[derive(Clone, Debug)]
pub struct Plan {
    pub cells: Vec<Cell>,
    /// Names of estimators.
    pub estimators: Vec<&'static str>,
    /// Networks for the learned estimators besides the embedded one, each in the cell that it was trained for.
    pub networks: Vec<Trained>,
    /// Frames per cell.
    pub frames: usize,
    pub seed: u64,
}

impl Plan {
    /// Both readings of the noise, σ_eff 0.5 to 10 mm, arrays of 10 to 100, and emitters from 1 to 40.
    pub fn full() -> Self {
        let mut cells = Vec::new();
        for sigma_mm in [0.5, 1.0, 2.0, 4.0, 6.0, 8.0] {
            cells.push(Cell::new(Noise::Energy, sigma_mm, 64));
        }
        for sigma_mm in [1.0, 2.0, 4.0, 8.0, 10.0] {
            cells.push(Cell::new(Noise::Paper, sigma_mm, 64));
        }
        for pixels in [10, 20, 40, 60, 80, 100] {
            cells.push(Cell::new(Noise::Paper, 8.0, pixels));
            cells.push(Cell::new(Noise::Energy, 1.0, pixels));
        }
        for emitters in [1, 5, 9, 20, 40] {
            cells.push(Cell::new(Noise::Energy, 1.0, 100).holding(emitters));
        }
        for condition in Condition::ALL {
            cells.extend(cells_under(condition));
        }
        Self {
            cells,
            estimators: names(),
            networks: Vec::new(),
            frames: 250,
            seed: 1,
        }
    }

    /// [`Plan::full`], and what some of the estimators' rules are for: cells whose noise grows with the light, and crowds before the embedded
    /// network.
    pub fn ablation() -> Self {
        let mut plan = Self::full();
        plan.cells.extend(cells_under(Condition::Gains));
        plan.cells
            .extend([20, 40].map(|emitters| Cell::new(Noise::Energy, 1.0, 64).holding(emitters)));
        plan
    }

    /// Few cells and frames, under a minute.
    pub fn quick() -> Self {
        let mut cells = vec![
            Cell::new(Noise::Energy, 1.0, 64),
            Cell::new(Noise::Energy, 2.0, 64),
            Cell::new(Noise::Energy, 4.0, 20),
        ];
        cells.extend([10, 20, 40, 60, 100].map(|pixels| Cell::new(Noise::Paper, 8.0, pixels)));
        cells.extend([1, 20].map(|emitters| Cell::new(Noise::Energy, 1.0, 100).holding(emitters)));
        Self {
            cells,
            estimators: names(),
            networks: Vec::new(),
            frames: 12,
            seed: 1,
        }
    }

    /// Measurements that the plan asks for.
    pub fn len(&self) -> usize {
        self.pairs().count()
    }

    /// Every cell with its estimators: a network only in the cell that it was trained for.
    fn pairs(&self) -> impl Iterator<Item = (Cell, Candidate)> {
        let had = |cell: &Cell| -> Vec<(Cell, Candidate)> {
            let names = self.estimators.iter();
            let candidates = names.flat_map(|name| Candidate::of(name, cell, &self.networks));
            candidates.map(|c| (*cell, c)).collect()
        };
        self.cells.iter().flat_map(had)
    }

    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

fn cells_under(condition: Condition) -> [Cell; 3] {
    let cells = [
        Cell::new(Noise::Energy, 2.0, 64),
        Cell::new(Noise::Energy, 4.0, 20),
        Cell::new(Noise::Paper, 8.0, 60),
    ];
    cells.map(|c| c.under(condition))
}

fn names() -> Vec<&'static str> {
    let learned = Learned::ALL.into_iter().map(Learned::name);
    of_single_frames().map(|r| r.name).chain(learned).collect()
}

/// Runs what `out` does not hold yet and writes tradeoff.json after each row, tradeoff.md and the pictures at the end.
/// `progress` is called after each row.
pub fn run(plan: &Plan, out: &Path, progress: &mut dyn FnMut(&Row)) -> Result<Study, Error> {
    let io = |path: &Path| {
        let path = path.to_owned();
        move |source| Error::Io { path, source }
    };
    std::fs::create_dir_all(out).map_err(io(out))?;
    let file = out.join("tradeoff.json");
    let mut study = match std::fs::read(&file) {
        Ok(bytes) => serde_json::from_slice(&bytes).map_err(|source| Error::Malformed {
            path: file.clone(),
            source,
        })?,
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => Study::default(),
        Err(e) => return Err(io(&file)(e)),
    };
    let mut kept = Vec::new();
    let mut drawn: Option<(Cell, Vec<scene::Scene>)> = None;
    for (cell, candidate) in plan.pairs() {
        let label = candidate.label();
        let known = study.rows.iter().find(|r| {
            r.cell == cell
                && r.estimator == label
                && r.frames == plan.frames
                && r.seed == plan.seed
                && r.training == candidate.training()
        });
        let row = match known {
            Some(row) => row.clone(),
            None => {
                let scenes = match drawn.take() {
                    Some((of, scenes)) if of == cell => scenes,
                    _ => cell.scenes(plan.frames, plan.seed)?,
                };
                let row = score::measure(&cell, &candidate, &scenes, plan.seed)?;
                drawn = Some((cell, scenes));
                study.rows.push(row.clone());
                let bytes = serde_json::to_vec_pretty(&study).expect("rows are plain numbers and names");
                let partial = out.join("tradeoff.json.part");
                std::fs::write(&partial, bytes).map_err(io(&partial))?;
                std::fs::rename(&partial, &file).map_err(io(&file))?;
                row
            }
        };
        progress(&row);
        kept.push(row);
    }
    let study = Study { rows: kept };
    let table = out.join("tradeoff.md");
    std::fs::write(&table, report::markdown(&study)).map_err(io(&table))?;
    picture::draw(&study, out)?;
    Ok(study)
}

/// Measures accuracy against observation time on `scenes` scenes of each cell and writes exposure.md and exposure.svg to `out`.
/// `progress` is called after each cell, of which there are [`EXPOSURE_CELLS`]. Returns the table.
///
/// # Errors
/// A file cannot be written.
pub fn run_exposures(scenes: usize, seed: u64, out: &Path, progress: &mut dyn FnMut(&Cell)) -> Result<String, Error> {
    let io = |path: &Path| {
        let path = path.to_owned();
        move |source| Error::Io { path, source }
    };
    std::fs::create_dir_all(out).map_err(io(out))?;
    let rows = exposure::measure_all(scenes, seed, progress)?;
    let table = exposure::markdown(&rows, scenes, seed);
    let file = out.join("exposure.md");
    std::fs::write(&file, &table).map_err(io(&file))?;
    picture::draw_exposures(&rows, &out.join("exposure.svg"))?;
    Ok(table)
}
