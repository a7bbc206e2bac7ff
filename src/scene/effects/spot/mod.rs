//! Spots of real lenses: what `[effects.spot]` puts in the place of the Gaussian.

mod calibrated;
mod density;
mod image_table;
mod pupil;

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use super::table::Table;
use crate::optics::Camera;
use crate::scene::render::Spot;
use crate::toml_file::{Key, OutOfRange};
use image_table::ImageTable;
pub use pupil::{Pupil, Rim, Zernike};

/// The shape of every beam's spot. Lengths are on the sensor.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "lowercase", deny_unknown_fields)]
pub enum SpotEffect {
    /// The diffraction pattern of a round aperture, (2J₁(v)/v)² (Airy, 1835), its first dark ring at `first_zero_m`.
    Airy {
        first_zero_m: f64,
    },
    /// (1 + r²/core²)^−index (Moffat, 1969).
    Moffat {
        core_m: f64,
        index: f64,
    },
    /// A disc of even light, its edge blurred by `blur_m`.
    Defocus {
        radius_m: f64,
        blur_m: f64,
    },
    Zernike(Pupil),
    /// The Gaussian of σ_eff, and a reflection of a share of its light beside it.
    Ghost {
        share: f64,
        offset_m: [f64; 2],
        spread_m: f64,
    },
    /// Measured: a text file of rows of numbers, `pitch_m` apart, bottom row first, its centroid in the middle.
    Template {
        file: PathBuf,
        pitch_m: f64,
    },
    /// What `oapwatch calibrate` learned, over the field, all lengths times `width`.
    Calibration {
        file: PathBuf,
        #[serde(default = "as_learned")]
        width: f64,
    },
}

fn as_learned() -> f64 {
    1.0
}

/// A compiled [`SpotEffect`].
#[derive(Debug)]
pub(in crate::scene) struct SpotImages {
    /// One for the whole field, or one for each of [`NODES`]² places of it.
    tables: Vec<ImageTable>,
}

/// Places of the field along an axis at which a changing spot is computed; between them images are mixed.
const NODES: usize = 7;

impl SpotEffect {
    pub fn kind(&self) -> &'static str {
        match self {
            Self::Airy { .. } => "airy",
            Self::Moffat { .. } => "moffat",
            Self::Defocus { .. } => "defocus",
            Self::Zernike(_) => "zernike",
            Self::Ghost { .. } => "ghost",
            Self::Template { .. } => "template",
            Self::Calibration { .. } => "calibration",
        }
    }

    /// The file beside the scene that it is read from.
    pub fn file_mut(&mut self) -> Option<&mut PathBuf> {
        match self {
            Self::Template { file, .. } | Self::Calibration { file, .. } => Some(file),
            _ => None,
        }
    }

    /// Computes the images. Only a file can fail.
    pub(in crate::scene) fn images(&self, camera: &Camera, field: &Key) -> Result<SpotImages, OutOfRange> {
        let one = |finest: f64, radius: f64, density: &dyn Fn(f64, f64) -> f64| SpotImages {
            tables: vec![ImageTable::of_density(camera, finest, radius, density)],
        };
        Ok(match self {
            Self::Airy { first_zero_m } => one(*first_zero_m, density::AIRY_REACH * first_zero_m, &|x, y| {
                density::airy(x.hypot(y) / first_zero_m)
            }),
            Self::Moffat { core_m, index } => one(*core_m, density::moffat_reach(*index) * core_m, &|x, y| {
                density::moffat((x * x + y * y) / (core_m * core_m), *index)
            }),
            Self::Defocus { radius_m, blur_m } => one(2.0 * blur_m, radius_m + 8.0 * blur_m, &|x, y| {
                density::disc((x.hypot(y) - radius_m) / blur_m)
            }),
            Self::Ghost {
                share,
                offset_m: [dx, dy],
                spread_m,
            } => {
                let sigma = camera.spot_sigma_m;
                let radius = (8.0 * sigma).max(dx.abs().max(dy.abs()) + 6.0 * spread_m);
                one(2.0 * sigma.min(*spread_m), radius, &|x, y| {
                    let first = density::gaussian(x * x + y * y, sigma);
                    (1.0 - share) * first + share * density::gaussian((x - dx).powi(2) + (y - dy).powi(2), *spread_m)
                })
            }
            Self::Zernike(pupil) => over_the_field(pupil.is_uniform(), |at| pupil.table(camera, at)),
            Self::Template { file, pitch_m } => {
                let samples = density::read_template(file, &field.at("file"))?;
                let radius = 0.5 * samples.dim().0.max(samples.dim().1) as f64 * pitch_m;
                one(4.0 * pitch_m, radius, &|x, y| {
                    density::sampled(&samples, *pitch_m, x, y)
                })
            }
            Self::Calibration { file, width } => {
                let shape = calibrated::read(file, &field.at("file"))?;
                let half = [camera.x.half_width(), camera.y.half_width()];
                let knot_m = shape.x_profile(0).knot_m();
                over_the_field(shape.is_uniform(), |[u, v]| {
                    let place = [u * half[0], v * half[1]];
                    ImageTable::of_density(camera, 4.0 * width * knot_m, width * shape.radius_m(), &|x, y| {
                        shape.density(place, [x / width, y / width])
                    })
                })
            }
        })
    }
}

/// A table for the whole field, or one for each of its places in units of half the sensor.
fn over_the_field(is_uniform: bool, table: impl Fn([f64; 2]) -> ImageTable) -> SpotImages {
    let node = |k: usize| 2.0 * k as f64 / (NODES - 1) as f64 - 1.0;
    SpotImages {
        tables: match is_uniform {
            true => vec![table([0.0; 2])],
            false => (0..NODES * NODES)
                .map(|k| table([node(k % NODES), node(k / NODES)]))
                .collect(),
        },
    }
}

impl SpotImages {
    /// Adds a spot to `pixels`, row-major (Ny, Nx), J. `spot.sigma_m` is not used.
    pub fn add(&self, camera: &Camera, spot: &Spot, pixels: &mut [f64]) {
        if let [only] = &self.tables[..] {
            return only.add(camera, spot.centre, spot.energy_j, pixels);
        }
        let place = |k: usize| {
            let half = [camera.x.half_width(), camera.y.half_width()][k];
            let t = ((spot.centre[k] / half + 1.0) * 0.5 * (NODES - 1) as f64).clamp(0.0, (NODES - 1) as f64);
            let first = (t as usize).min(NODES - 2);
            (first, t - first as f64)
        };
        let ((i, a), (j, b)) = (place(0), place(1));
        for (dj, wy) in [(0, 1.0 - b), (1, b)] {
            for (di, wx) in [(0, 1.0 - a), (1, a)] {
                if wx * wy > 0.0 {
                    let table = &self.tables[(j + dj) * NODES + i + di];
                    table.add(camera, spot.centre, spot.energy_j * wx * wy, pixels);
                }
            }
        }
    }

    /// Tables, and numbers of each.
    pub fn size(&self) -> (usize, usize) {
        (self.tables.len(), self.tables[0].len())
    }
}

impl Table for SpotEffect {
    fn validate(&self, field: &Key) -> Result<(), OutOfRange> {
        let length = |name: &str, value: f64| field.at(name).positive(value);
        match self {
            Self::Airy { first_zero_m } => length("first_zero_m", *first_zero_m).map(drop),
            Self::Moffat { core_m, index } => {
                length("core_m", *core_m)?;
                let reason = "at 1 the light is infinite, beyond 20 it is a Gaussian";
                field.at("index").within(*index, 1.5..=20.0, reason).map(drop)
            }
            Self::Defocus { radius_m, blur_m } => {
                length("radius_m", *radius_m)?;
                length("blur_m", *blur_m).map(drop)
            }
            Self::Zernike(pupil) => pupil.validate(field),
            Self::Ghost {
                share,
                offset_m,
                spread_m,
            } => {
                field
                    .at("share")
                    .within(*share, 0.0..=0.5, "a reflection is fainter than the spot")?;
                field.at("offset_m").finite_pair(*offset_m)?;
                length("spread_m", *spread_m).map(drop)
            }
            Self::Template { file, pitch_m } => {
                length("pitch_m", *pitch_m)?;
                density::read_template(file, &field.at("file")).map(drop)
            }
            Self::Calibration { file, width } => {
                let reason = "beyond, the spot is another lens's";
                field.at("width").within(*width, 0.5..=2.0, reason)?;
                calibrated::read(file, &field.at("file")).map(drop)
            }
        }
    }
}

#[cfg(test)]
mod tests;
