//! Networks for the study, by the cards that `training/` writes: each is held only to frames like those it was trained on.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::{Cell, Error};
use crate::estimate::Learned;

/// A network with its card.
#[derive(Clone, Debug)]
pub struct Trained {
    pub path: PathBuf,
    card: Card,
}

#[derive(Clone, Debug, Deserialize)]
struct Card {
    network: String,
    /// Ny, Nx.
    shape: [usize; 2],
    spot_sigma_px: f64,
    noise_std_j: f64,
    samples: u64,
    training_seconds: f64,
    #[serde(default = "one_core")]
    trained_on: String,
}

fn one_core() -> String {
    "one processor core".to_owned()
}

/// What a network cost to train.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Training {
    pub samples: u64,
    /// Of the machine.
    pub seconds: f64,
    #[serde(default = "one_core")]
    pub machine: String,
}

/// One estimator as it is run in one cell.
#[derive(Clone, Debug)]
pub(in crate::study) struct Candidate {
    /// What `[estimator] name` selects it by.
    pub estimator: &'static str,
    /// The network in front of it; the embedded one where a learned estimator has none.
    pub network: Option<Trained>,
}

/// Cards agree with a cell to this share.
const TOLERANCE: f64 = 0.01;

impl Trained {
    /// Every network of a folder with its card, by file name.
    pub fn in_folder(folder: &Path) -> Result<Vec<Self>, Error> {
        let io = |path: &Path| {
            let path = path.to_owned();
            move |source| Error::Io { path, source }
        };
        let mut paths = Vec::new();
        for entry in std::fs::read_dir(folder).map_err(io(folder))? {
            let path = entry.map_err(io(folder))?.path();
            if path.extension().is_some_and(|e| e == "onnx") {
                paths.push(path);
            }
        }
        paths.sort();
        paths.into_iter().map(Self::load).collect()
    }

    fn load(path: PathBuf) -> Result<Self, Error> {
        let card = path.with_extension("toml");
        let text = std::fs::read_to_string(&card).map_err(|source| Error::Io {
            path: card.clone(),
            source,
        })?;
        match toml::from_str(&text) {
            Ok(card) => Ok(Self { path, card }),
            Err(source) => Err(Error::Card { path: card, source }),
        }
    }

    pub fn training(&self) -> Training {
        Training {
            samples: self.card.samples,
            seconds: self.card.training_seconds,
            machine: self.card.trained_on.clone(),
        }
    }

    fn is_for(&self, cell: &Cell) -> bool {
        let Ok(camera) = cell.camera() else { return false };
        let close = |a: f64, b: f64| (a / b - 1.0).abs() < TOLERANCE;
        cell.is_plain()
            && self.card.shape == [cell.pixels; 2]
            && close(self.card.spot_sigma_px, camera.spot_sigma_m / camera.x.pitch_m)
            && close(self.card.noise_std_j, camera.noise_std_j)
    }
}

impl Candidate {
    /// The estimator in `cell`: once, or once for each network trained for it.
    pub fn of(estimator: &'static str, cell: &Cell, networks: &[Trained]) -> Vec<Self> {
        let alone = Self {
            estimator,
            network: None,
        };
        if Learned::ALL.iter().all(|l| l.name() != estimator) {
            return vec![alone];
        }
        let trained: Vec<Self> = networks
            .iter()
            .filter(|n| n.is_for(cell))
            .map(|n| Self {
                estimator,
                network: Some(n.clone()),
            })
            .collect();
        let is_embedded = *cell == Cell::new(super::Noise::Energy, 1.0, 64);
        if trained.is_empty() && is_embedded {
            vec![alone]
        } else {
            trained
        }
    }

    pub fn training(&self) -> Option<Training> {
        self.network.as_ref().map(Trained::training)
    }

    /// The name of the estimator in tables.
    pub fn label(&self) -> String {
        match &self.network {
            Some(network) => format!("{} {}", self.estimator, network.card.network),
            None => self.estimator.to_owned(),
        }
    }
}
