//! The learned heatmap: an ONNX network run by tract, and its maxima.
//!
//! A network comes with a card, a TOML file of the same name, which says what its bytes must be and how its input is
//! scaled. `training/` makes both.

use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use serde::Deserialize;
use sha2::{Digest, Sha256};
use tract_onnx::prelude::*;

/// What the program carries with it: 64 × 64 pixels, σ_eff 1 mm.
const EMBEDDED: (&str, &[u8], &str) = (
    "the embedded network",
    include_bytes!("../../../config/models/cnn16-separable-energy-1mm-64.onnx"),
    include_str!("../../../config/models/cnn16-separable-energy-1mm-64.toml"),
);
/// Least height of a maximum that counts.
const THRESHOLD: f32 = 0.3;
/// Heights below this say nothing of where a maximum is.
const FLOOR: f32 = 1e-6;
/// Non-maximum suppression within this many pixels.
const RADIUS: usize = 1;

/// Why a network cannot be used.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum NetworkError {
    #[error("estimator.network: {path}: {kind}")]
    Unreadable { path: PathBuf, kind: ErrorKind },
    #[error("estimator.network: {path}: the card is malformed: {reason}")]
    Card { path: PathBuf, reason: String },
    #[error("estimator.network: {path}: sha256 is {found}, its card says {expected}")]
    Changed {
        path: PathBuf,
        expected: String,
        found: String,
    },
    #[error(
        "estimator.network: {path} takes frames of {network_x} × {network_y} pixels, the config says \
         {camera_x} × {camera_y}"
    )]
    WrongShape {
        path: PathBuf,
        network_x: usize,
        network_y: usize,
        camera_x: usize,
        camera_y: usize,
    },
    #[error("estimator.network: {path} cannot be run: {reason}")]
    NotRunnable { path: PathBuf, reason: String },
}

/// What of the card matters for running the network; the rest is for people.
#[derive(Deserialize)]
pub(crate) struct Card {
    sha256: String,
    /// Ny, Nx.
    shape: [usize; 2],
    floor_sigma: f32,
    /// Width of the spots that it was trained on, pixels.
    pub spot_sigma_px: Option<f64>,
}

impl Card {
    /// Of the embedded network.
    pub fn embedded() -> Result<Self, NetworkError> {
        let (name, _, card) = EMBEDDED;
        Self::parse(Path::new(name), card)
    }

    fn parse(path: &Path, text: &str) -> Result<Self, NetworkError> {
        toml::from_str(text).map_err(|e| NetworkError::Card {
            path: path.with_extension("toml"),
            reason: e.message().to_owned(),
        })
    }

    /// Whether the network takes frames of (Ny, Nx).
    pub fn takes(&self, (ny, nx): (usize, usize)) -> bool {
        self.shape == [ny, nx]
    }
}

/// A maximum of the heatmap: column and row in pixels, a pixel's centre at its integer.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct NetworkPeak {
    pub column: f64,
    pub row: f64,
    pub pixel: (usize, usize),
}

/// A network, ready to run.
pub struct Network {
    plan: Arc<TypedRunnableModel>,
    ny: usize,
    nx: usize,
    floor_sigma: f32,
    path: PathBuf,
    input: Vec<f32>,
    heatmap: Vec<f32>,
    /// Offsets to the nearest emitter in pixels, all in x and then all in y; empty without a coordinate head.
    offsets: Vec<f32>,
    peaks: Vec<NetworkPeak>,
}

impl Network {
    /// Reads the network at `path`, or the embedded one, and holds it to its card and to frames of (Ny, Nx).
    pub fn load(path: Option<&Path>, shape: (usize, usize)) -> Result<Self, NetworkError> {
        let Some(path) = path else {
            let (name, bytes, card) = EMBEDDED;
            return Self::from_parts(Path::new(name), bytes, card, shape);
        };
        let unreadable = |path: &Path, e: std::io::Error| NetworkError::Unreadable {
            path: path.to_owned(),
            kind: e.kind(),
        };
        let card_path = path.with_extension("toml");
        let bytes = std::fs::read(path).map_err(|e| unreadable(path, e))?;
        let card = std::fs::read_to_string(&card_path).map_err(|e| unreadable(&card_path, e))?;
        Self::from_parts(path, &bytes, &card, shape)
    }

    fn from_parts(path: &Path, bytes: &[u8], card: &str, (ny, nx): (usize, usize)) -> Result<Self, NetworkError> {
        let path = path.to_owned();
        let card = Card::parse(&path, card)?;
        let found: String = Sha256::digest(bytes).iter().map(|b| format!("{b:02x}")).collect();
        if found != card.sha256.to_ascii_lowercase() {
            return Err(NetworkError::Changed {
                path,
                expected: card.sha256,
                found,
            });
        }
        if !card.takes((ny, nx)) {
            return Err(NetworkError::WrongShape {
                path,
                network_x: card.shape[1],
                network_y: card.shape[0],
                camera_x: nx,
                camera_y: ny,
            });
        }
        let plan = onnx()
            .model_for_read(&mut std::io::Cursor::new(bytes))
            .and_then(|model| model.into_optimized())
            .and_then(|model| model.into_runnable())
            .map_err(|e| NetworkError::NotRunnable {
                path: path.clone(),
                reason: format!("{e:#}"),
            })?;
        let mut network = Self {
            plan,
            ny,
            nx,
            floor_sigma: card.floor_sigma,
            path: path.clone(),
            input: vec![0.0; ny * nx],
            heatmap: Vec::new(),
            offsets: Vec::new(),
            peaks: Vec::new(),
        };
        // A model whose own input differs from its card shows itself here, before the daemon says that it is ready.
        network.infer()?;
        Ok(network)
    }

    /// Runs the network on pixels in units of the noise, (Ny, Nx) row by row.
    pub(crate) fn run(&mut self, pixels: &[f64]) -> Result<&[NetworkPeak], NetworkError> {
        let brightest = pixels.iter().fold(f64::from(self.floor_sigma), |m, v| m.max(*v));
        for (input, pixel) in self.input.iter_mut().zip(pixels) {
            *input = (pixel / brightest) as f32;
        }
        self.infer()?;
        self.find();
        Ok(&self.peaks)
    }

    /// From `input` to `heatmap`, whose values are held to [0, 1]: some sigmoids overshoot by a rounding. A second output,
    /// where there is one, is the coordinate head's.
    fn infer(&mut self) -> Result<(), NetworkError> {
        let not_runnable = |reason: String| NetworkError::NotRunnable {
            path: self.path.clone(),
            reason,
        };
        let failed = |e: TractError| not_runnable(format!("{e:#}"));
        let input = Tensor::from_shape(&[1, 1, self.ny, self.nx], &self.input).map_err(failed)?;
        let output = self.plan.run(tvec!(input.into())).map_err(failed)?;
        let values = output[0].to_plain_array_view::<f32>().map_err(failed)?;
        if values.len() != self.ny * self.nx {
            let found = values.len();
            return Err(not_runnable(format!("it gives {found} values, not one a pixel")));
        }
        self.heatmap.clear();
        self.heatmap.extend(values.iter().map(|v| v.clamp(0.0, 1.0)));
        self.offsets.clear();
        if let Some(offsets) = output.get(1) {
            let values = offsets.to_plain_array_view::<f32>().map_err(failed)?;
            if values.len() != 2 * self.ny * self.nx {
                let found = values.len();
                return Err(not_runnable(format!(
                    "its second output gives {found} values, not two a pixel"
                )));
            }
            self.offsets.extend(values.iter());
        }
        Ok(())
    }

    /// Maxima within `RADIUS` pixels, row by row, moved by the coordinate head where there is one and else to the vertex of the
    /// parabola through the logarithms of their neighbours along each axis: exact where the heatmap is the Gaussian that it was
    /// trained to be.
    fn find(&mut self) {
        let (nx, ny, map) = (self.nx, self.ny, &self.heatmap);
        self.peaks.clear();
        for row in 0..ny {
            for column in 0..nx {
                let (here, value) = (row * nx + column, map[row * nx + column]);
                if value <= THRESHOLD {
                    continue;
                }
                let around = |radius: usize| {
                    let rows = row.saturating_sub(radius)..=(row + radius).min(ny - 1);
                    rows.flat_map(move |r| {
                        let columns = column.saturating_sub(radius)..=(column + radius).min(nx - 1);
                        columns.map(move |c| (r, c))
                    })
                };
                // Of equal neighbours the first one counts.
                let beaten = |(r, c): (usize, usize)| {
                    let other = map[r * nx + c];
                    other > value || (other == value && r * nx + c < here)
                };
                if around(RADIUS).any(beaten) {
                    continue;
                }
                let height = |at: Option<usize>| at.map_or(FLOOR, |k| map[k].max(FLOOR)).ln();
                let vertex = |before: Option<usize>, after: Option<usize>| {
                    let (a, b, c) = (height(before), value.ln(), height(after));
                    let curvature = a - 2.0 * b + c;
                    if curvature < 0.0 {
                        (0.5 * (a - c) / curvature).clamp(-0.5, 0.5)
                    } else {
                        0.0
                    }
                };
                let [dx, dy] = if self.offsets.is_empty() {
                    [
                        vertex((column > 0).then(|| here - 1), (column + 1 < nx).then_some(here + 1)),
                        vertex((row > 0).then(|| here - nx), (row + 1 < ny).then_some(here + nx)),
                    ]
                } else {
                    let reach = RADIUS as f32;
                    [here, nx * ny + here].map(|k| self.offsets[k].clamp(-reach, reach))
                };
                self.peaks.push(NetworkPeak {
                    column: column as f64 + f64::from(dx),
                    row: row as f64 + f64::from(dy),
                    pixel: (row, column),
                });
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A validation frame as the network takes it and onnxruntime's heatmap of it, two arrays of (64, 64) f4;
    /// `training/export.py --reference` wrote them.
    const REFERENCE: &[u8] = include_bytes!("../../../tests/reference/cnn16-separable-energy-1mm-64.npy");

    fn reference() -> (Vec<f32>, Vec<f32>) {
        let data = &REFERENCE[REFERENCE.len() - 2 * 4 * 4096..];
        let values: Vec<f32> = data
            .chunks_exact(4)
            .map(|b| f32::from_le_bytes(b.try_into().unwrap()))
            .collect();
        (values[..4096].to_vec(), values[4096..].to_vec())
    }

    #[test]
    fn tract_gives_what_onnxruntime_gives() {
        let (frame, expected) = reference();
        let mut network = Network::load(None, (64, 64)).unwrap();
        network.input = frame;
        network.infer().unwrap();
        let worst = network
            .heatmap
            .iter()
            .zip(&expected)
            .map(|(a, b)| (a - b).abs())
            .fold(0.0, f32::max);
        assert!(worst < 1e-4, "{worst}");
        assert!(
            expected.iter().any(|v| *v > 0.5),
            "a reference without a peak proves nothing"
        );
    }

    #[test]
    fn a_changed_or_misfitting_network_is_refused() {
        let (_, bytes, card) = EMBEDDED;
        let load = |bytes: &[u8], card: &str, shape| Network::from_parts(Path::new("n.onnx"), bytes, card, shape).err();
        assert!(matches!(
            load(&bytes[1..], card, (64, 64)),
            Some(NetworkError::Changed { .. })
        ));
        assert!(matches!(
            load(bytes, card, (20, 20)),
            Some(NetworkError::WrongShape { .. })
        ));
        let relabelled = card.replace("[64, 64]", "[32, 32]");
        assert!(matches!(
            load(bytes, &relabelled, (32, 32)),
            Some(NetworkError::NotRunnable { .. })
        ));
        let missing = Network::load(Some(Path::new("/nonexistent/n.onnx")), (64, 64))
            .err()
            .unwrap();
        assert!(missing.to_string().contains("/nonexistent/n.onnx"), "{missing}");
    }

    #[test]
    fn a_gaussian_maximum_is_found_between_the_pixels() {
        let mut network = Network::load(None, (64, 64)).unwrap();
        let at = [20.3, 41.4];
        let gauss = |d: f64| libm::exp(-0.5 * d * d);
        network.heatmap = (0..4096)
            .map(|k| (gauss((k % 64) as f64 - at[0]) * gauss((k / 64) as f64 - at[1])) as f32)
            .collect();
        network.find();
        let [peak] = network.peaks[..] else {
            panic!("{:?}", network.peaks)
        };
        assert_eq!(peak.pixel, (41, 20));
        assert!((peak.column - at[0]).hypot(peak.row - at[1]) < 1e-5, "{peak:?}");
        // A coordinate head has the last word.
        network.offsets = vec![0.25; 2 * 4096];
        network.find();
        assert_eq!((network.peaks[0].column, network.peaks[0].row), (20.25, 41.25));
    }

    #[test]
    fn darkness_has_no_peaks() {
        let mut network = Network::load(None, (64, 64)).unwrap();
        assert_eq!(network.run(&[0.0; 4096]).unwrap(), []);
    }
}
