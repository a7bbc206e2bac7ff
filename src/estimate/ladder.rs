//! The ladder of estimators: what each rung does, and building one from a config.

use std::time::{Duration, Instant};

use super::basis::Basis;
use super::corrected::Corrected;
use super::fit::Fitter;
use super::learned::{Learned, LearnedEstimator};
use super::model::{Model, Nuisances, Spot};
use super::network::NetworkError;
use super::noise::Inspection;
use super::pencil::Pencil;
use super::reading::Reading;
use super::screen::Screened;
use super::search::Search;
use super::weigh::Weighing;
use super::{Config, Error, Estimate, Estimator, Flags, ground};
use crate::frame::Frame;
use crate::optics::Camera;

/// A rung of the ladder.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Rung {
    /// What `[estimator] name` selects it by.
    pub name: &'static str,
    pub summary: &'static str,
    method: Method,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Method {
    Peak { is_subpixel: bool },
    Greedy,
    Pencil { steps: usize },
    MaximumLikelihood,
}

/// Every rung offered, cheapest first.
pub const LADDER: &[Rung] = &[
    Rung {
        name: "peak",
        summary: "maxima of the matched filter on its grid, after non-maximum suppression",
        method: Method::Peak { is_subpixel: false },
    },
    Rung {
        name: "subpixel-peak",
        summary: "the same with a parabola through each maximum",
        method: Method::Peak { is_subpixel: true },
    },
    Rung {
        name: "greedy-fit",
        summary: "residual peaks added one round at a time, all emitters refitted jointly",
        method: Method::Greedy,
    },
    Rung {
        name: "pencil",
        summary: "half-kernel matrix pencil where spots overlap, amplitudes by least squares",
        method: Method::Pencil { steps: 0 },
    },
    Rung {
        name: "pencil-fit",
        summary: "the pencil's seeds and five steps of the joint fit",
        method: Method::Pencil { steps: 5 },
    },
    Rung {
        name: "ml",
        summary: "maximum likelihood: pencil or greedy seeds, moves, the number of emitters by a false-alarm test",
        method: Method::MaximumLikelihood,
    },
];

/// The rung used when none is named.
pub const DEFAULT: &str = "ml";

/// Reach of a spot in σ and share of it outside the basis by which a camera is judged.
const REACH: f64 = 5.3;
const TYPICAL: f64 = 1e-5;

/// Times that a frame is looked over for pixels that are lit alone.
const LOOKS: usize = 3;

/// Why an `[estimator]` table describes no estimator.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ConfigError {
    #[error(
        "estimator.name: no estimator {found:?}; did you mean {nearest:?}? There are {}",
        names()
    )]
    UnknownName { found: String, nearest: &'static str },
    #[error("estimator.{field}: expected {expected}, found {found}")]
    OutOfRange {
        field: &'static str,
        expected: &'static str,
        found: f64,
    },
    #[error(transparent)]
    Network(#[from] NetworkError),
}

fn names() -> String {
    let learned = Learned::ALL.iter().map(|l| l.name());
    LADDER
        .iter()
        .map(|r| r.name)
        .chain(learned)
        .collect::<Vec<_>>()
        .join(", ")
}

/// The rung of that name.
pub fn rung(name: &str) -> Result<&'static Rung, ConfigError> {
    LADDER
        .iter()
        .find(|r| r.name == name)
        .ok_or_else(|| ConfigError::UnknownName {
            found: name.to_owned(),
            nearest: LADDER
                .iter()
                .map(|r| r.name)
                .max_by(|a, b| strsim::jaro_winkler(name, a).total_cmp(&strsim::jaro_winkler(name, b)))
                .unwrap_or(DEFAULT),
        })
}

/// Builds the configured estimator for a camera.
pub fn build(config: &Config, camera: &Camera) -> Result<Box<dyn Estimator>, ConfigError> {
    let name = config.name.as_deref().unwrap_or(DEFAULT);
    if let Some(budget) = config.budget_ms
        && !(budget.is_finite() && budget > 0.0)
    {
        return Err(ConfigError::OutOfRange {
            field: "budget_ms",
            expected: "a positive finite number",
            found: budget,
        });
    }
    let budget = config.budget_ms.map(|ms| Duration::from_secs_f64(ms * 1e-3));
    let estimator: Box<dyn Estimator> = match Learned::ALL.into_iter().find(|l| l.name() == name) {
        Some(learned) => Box::new(LearnedEstimator::new(learned, config.network.as_deref(), camera)?),
        None => Box::new(Analytic::new(rung(name)?, camera, budget)),
    };
    Ok(match &camera.pixels {
        Some(maps) => Box::new(Corrected::new(estimator, maps.clone(), camera.saturation_j)),
        None => estimator,
    })
}

/// A rung without a learned part.
struct Analytic {
    rung: &'static Rung,
    camera: Camera,
    frame: Screened,
    reading: Reading,
    inspection: Inspection,
    budget: Option<Duration>,
    search: Search,
    /// Where spots are small against the array, pixels are fewer to touch than a basis has numbers.
    has_small_spots: bool,
    weighing: Weighing,
}

impl Analytic {
    fn new(rung: &'static Rung, camera: &Camera, budget: Option<Duration>) -> Self {
        let bx = Basis::new(&camera.x, camera.spot_sigma_m);
        let by = Basis::new(&camera.y, camera.spot_sigma_m);
        let window = (2.0 * REACH / bx.pitch()).min(bx.n as f64) * (2.0 * REACH / by.pitch()).min(by.n as f64);
        let has_small_spots = window < 2.0 * (bx.rank(TYPICAL) * by.rank(TYPICAL)) as f64;
        Self {
            rung,
            has_small_spots: has_small_spots && !Pencil::suits(&bx, &by),
            weighing: Weighing::new(camera),
            camera: camera.clone(),
            frame: Screened::default(),
            reading: Reading::default(),
            inspection: Inspection::default(),
            budget,
            search: Search::new(Fitter::new(bx, by)),
        }
    }
}

impl Estimator for Analytic {
    fn name(&self) -> &'static str {
        self.rung.name
    }

    fn estimate(&mut self, frame: &Frame) -> Result<Estimate, Error> {
        let deadline = self.budget.map(|b| Instant::now() + b);
        self.frame.load(frame, &self.camera)?;
        let is_ml = self.rung.method == Method::MaximumLikelihood;
        let mut scale = 1.0;
        if is_ml || !self.has_small_spots {
            let (bx, by) = (&self.search.fitter.bx, &self.search.fitter.by);
            self.reading.load(&self.frame, bx, by);
            if is_ml {
                scale = self.inspection.run(&mut self.frame, &mut self.reading, bx, by);
            }
        }
        let growth = self.reading.growth;
        let Self { search, reading, .. } = self;
        search.restart(deadline);
        self.weighing.search.restart(deadline);
        if is_ml {
            for _ in 0..LOOKS {
                let Some(mut model) = search.first_look(reading, &self.frame) else {
                    break;
                };
                let residual = search.fitter.residual_of(reading, &mut model).to_vec();
                let (bx, by) = (&search.fitter.bx, &search.fitter.by);
                if !self.inspection.reject_lone(&mut self.frame, reading, &residual, bx, by) {
                    break;
                }
            }
        }
        let (search, reading) = if self.has_small_spots {
            let Weighing { search, reading } = &mut self.weighing;
            reading.load(&self.frame, &search.fitter.bx, &search.fitter.by);
            (reading.growth, reading.mean_variance, reading.lit_variance) =
                (growth, self.reading.mean_variance, self.reading.lit_variance);
            (search, reading)
        } else {
            (&mut self.search, &mut self.reading)
        };
        let nuisances = Nuisances::default();
        let mut model = match self.rung.method {
            Method::Peak { is_subpixel } => search.peaks(reading, is_subpixel),
            Method::Greedy => {
                let mut model = search.greedy(reading, &self.frame, nuisances);
                search.shrink(reading, &mut model);
                model
            }
            Method::Pencil { steps } => search.seeded(reading, &self.frame, steps),
            Method::MaximumLikelihood => search.maximum_likelihood(reading, &self.frame),
        };
        let is_exhausted = search.is_exhausted();
        let known = search.suspected.or((!growth.is_flat()).then_some(growth));
        let is_weighted = is_ml
            && (known.is_some() || !reading.is_explained(&model))
            && self.weighing.run(&self.frame, known, &mut model);
        let (search, reading) = match (self.has_small_spots, is_weighted) {
            (_, true) => (&mut self.weighing.search, &mut self.weighing.reading),
            (false, false) => (&mut self.search, &mut self.reading),
            (true, false) => {
                let Weighing { search, reading } = &mut self.weighing;
                reading.load(&self.frame, &search.fitter.bx, &search.fitter.by);
                (search, reading)
            }
        };
        let noise_j = scale * self.camera.noise_std_j;
        let mut estimate = ground::locate(search, reading, &mut model, &self.frame, &self.camera, noise_j);
        estimate.rung = self.rung.name;
        if is_exhausted {
            for emitter in &mut estimate.emitters {
                emitter.flags |= Flags::OUT_OF_TIME;
            }
        }
        Ok(estimate)
    }
}

impl Search {
    fn peaks(&mut self, reading: &Reading, is_subpixel: bool) -> Model {
        let mut model = Model::empty(Nuisances::default());
        let peaks = self
            .heatmap
            .peaks(&reading.z, reading.mx, reading.my, self.price.sqrt(), 1.0);
        model.spots.extend(peaks.iter().map(|p| Spot {
            u: if is_subpixel { p.u } else { p.grid },
            a: p.a,
        }));
        model
    }
}
