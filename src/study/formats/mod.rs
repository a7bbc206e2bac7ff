//! What a camera's pixel format costs: the same light through each format, and what the estimator finds in what arrives.

pub mod jpeg;

use std::fmt::Write;

use ndarray::Array2;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use super::tradeoff::{Answer, Cell, Noise, Scene, bound_ratio};
use crate::estimate;
use crate::frame::Frame;
use crate::frames::v4l2::{Bayer, Decoding, Granted, Layout, PixelFormat, Response, Transfer};
use crate::optics::{Axis, Camera};

/// A way from light to the array.
struct Way {
    name: &'static str,
    format: PixelFormat,
    /// Of the camera.
    response: Response,
    /// What the config says of it.
    undone: Response,
    bayer: Bayer,
    /// Share of the light that passes each colour of a filter: red, the two greens, blue.
    passes: [f64; 4],
    quality: u16,
}

/// All of the light, as without a filter.
const CLEAR: [f64; 4] = [1.0; 4];
/// A red beam behind a common filter: what green and blue let through of 650 nm.
const RED: [f64; 4] = [1.0, 0.2, 0.2, 0.06];
/// Near infrared, from 850 nm on: dyes let it pass alike.
const INFRARED: [f64; 4] = [1.0, 0.98, 0.98, 0.97];

const LINEAR: Response = Response {
    transfer: Transfer::Linear,
    limited_range: false,
};
const TELEVISION: Response = Response {
    transfer: Transfer::Bt709,
    limited_range: true,
};
const SRGB: Response = Response {
    transfer: Transfer::Srgb,
    limited_range: false,
};

const fn grey(name: &'static str, format: PixelFormat) -> Way {
    Way {
        name,
        format,
        response: LINEAR,
        undone: LINEAR,
        bayer: Bayer::Sites,
        passes: CLEAR,
        quality: 0,
    }
}

const fn bayer(name: &'static str, passes: [f64; 4], bayer: Bayer) -> Way {
    Way {
        passes,
        bayer,
        ..grey(name, PixelFormat::RG12)
    }
}

const fn video(name: &'static str, format: PixelFormat, response: Response, quality: u16) -> Way {
    Way {
        response,
        undone: response,
        quality,
        ..grey(name, format)
    }
}

const WAYS: [Way; 12] = [
    grey("Y16", PixelFormat::Y16),
    grey("Y12", PixelFormat::Y12),
    grey("Y10", PixelFormat::Y10),
    grey("GREY (8 bits)", PixelFormat::GREY),
    bayer("Bayer 12, near infrared, sites", INFRARED, Bayer::Sites),
    bayer("Bayer 12, near infrared, binned", INFRARED, Bayer::Binned),
    bayer("Bayer 12, red, sites", RED, Bayer::Sites),
    bayer("Bayer 12, red, binned", RED, Bayer::Binned),
    video("YUYV, curve undone", PixelFormat::YUYV, TELEVISION, 0),
    Way {
        undone: LINEAR,
        ..video("YUYV, curve left", PixelFormat::YUYV, TELEVISION, 0)
    },
    video("MJPG quality 90, curve undone", PixelFormat::MJPG, SRGB, 90),
    video("MJPG quality 50, curve undone", PixelFormat::MJPG, SRGB, 50),
];

/// Full scale over the brightest pixel of all frames.
const HEADROOM: f64 = 1.05;
/// Level without light of raw formats, a share of full scale, so that noise is not cut off.
const BLACK: f64 = 1.0 / 64.0;
/// The estimator that is measured.
const ESTIMATOR: &str = "ml";

/// A table of what each format leaves of the accuracy. `frames` frames a row and scene.
///
/// # Errors
/// An estimator or scene cannot be built.
pub fn table(frames: usize, seed: u64) -> Result<String, super::tradeoff::Error> {
    let cells = [
        ("bright beams, σ 1 mm", Cell::new(Noise::Energy, 1.0, 64)),
        ("faint beams, σ 8 mm", Cell::new(Noise::Paper, 8.0, 64)),
    ];
    let mut text = "| format |".to_owned();
    for (name, _) in &cells {
        let _ = write!(text, " {name}: N right | error/bound |");
    }
    text.push_str("\n|---|---|---|---|---|\n");
    let mut rows: Vec<String> = WAYS.iter().map(|way| format!("| {} |", way.name)).collect();
    for (_, cell) in &cells {
        let scenes = cell.scenes(frames, seed)?;
        let camera = cell.camera()?;
        for (way, row) in WAYS.iter().zip(&mut rows) {
            let (right, ratio) = way.measure(&camera, &scenes, seed)?;
            let ratio = ratio.map_or("–".to_owned(), |r| format!("{r:.2}"));
            let _ = write!(row, " {:.1} % | {ratio} |", 100.0 * right);
        }
    }
    for row in rows {
        let _ = writeln!(text, "{row}");
    }
    Ok(text)
}

impl Way {
    /// Share of frames with the right number, and squared error over the bound of the light before the format.
    fn measure(
        &self,
        camera: &Camera,
        scenes: &[Scene],
        seed: u64,
    ) -> Result<(f64, Option<f64>), super::tradeoff::Error> {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let brightest = scenes
            .iter()
            .flat_map(|s| &s.frame.pixels)
            .fold(0.0, |a: f64, b| a.max(*b));
        let full_j = HEADROOM * brightest;
        let (mut taken, mut squares, mut count) = (Vec::new(), 0.0, 0);
        for scene in scenes {
            let arrived = self.behind_filter(&scene.frame.pixels, camera.noise_std_j, &mut random);
            let found = self.decoded(&arrived, full_j);
            squares += (&found - &self.binned(&arrived)).mapv(|d| d * d).sum();
            count += found.len();
            taken.push(found);
        }
        // As photon transfer would show it: the scene's own noise, and what the format adds.
        let own = camera.noise_std_j * self.cell() as f64 / self.mean_passes();
        let added = squares / f64::from(count.max(1) as u32);
        let (ny, nx) = taken.first().map_or(camera.shape(), Array2::dim);
        let seen = Camera {
            noise_std_j: (own * own + added).sqrt(),
            x: Axis::centred(nx, 2.0 * camera.x.half_width()),
            y: Axis::centred(ny, 2.0 * camera.y.half_width()),
            ..camera.clone()
        };
        let config = estimate::Config {
            name: Some(ESTIMATOR.to_owned()),
            ..Default::default()
        };
        let mut estimator = estimate::build(&config, &seen)?;
        let (mut right, mut ratios) = (0, Vec::new());
        for (scene, pixels) in scenes.iter().zip(taken) {
            let frame = Frame {
                pixels,
                ..scene.frame.clone()
            };
            let found = estimator.estimate(&frame);
            let positions: Vec<[f64; 2]> = found
                .map(|e| e.emitters.iter().map(|m| [m.x_m, m.y_m]).collect())
                .unwrap_or_default();
            let answer = Answer::new(scene, &positions);
            right += usize::from(answer.is_right);
            ratios.extend(answer.ratios);
        }
        Ok((right as f64 / scenes.len().max(1) as f64, bound_ratio(ratios)))
    }

    /// Camera pixels a side that make one of the array.
    fn cell(&self) -> usize {
        if self.bayer == Bayer::Binned { 2 } else { 1 }
    }

    fn mean_passes(&self) -> f64 {
        self.passes.iter().sum::<f64>() / 4.0
    }

    /// Light behind the filter, J. `noise` is that of a frame's pixel, of which the filter does not take its share.
    fn behind_filter(&self, light: &Array2<f64>, noise: f64, random: &mut ChaCha8Rng) -> Array2<f64> {
        Array2::from_shape_fn(light.dim(), |(y, x)| {
            let passes = self.passes[2 * (y % 2) + x % 2];
            let fresh: f64 = StandardNormal.sample(random);
            passes * light[[y, x]] + (1.0 - passes * passes).max(0.0).sqrt() * noise * fresh
        })
    }

    /// The array that a format without loss would give, J.
    fn binned(&self, arrived: &Array2<f64>) -> Array2<f64> {
        let (ny, nx) = arrived.dim();
        let cell = self.cell();
        Array2::from_shape_fn((ny / cell, nx / cell), |(y, x)| {
            let sum: f64 = (0..cell * cell)
                .map(|k| arrived[[y * cell + k / cell, x * cell + k % cell]])
                .sum();
            sum / self.mean_passes()
        })
    }

    /// The array that the program reads from what the camera delivers, J.
    fn decoded(&self, arrived: &Array2<f64>, full_j: f64) -> Array2<f64> {
        let (ny, nx) = arrived.dim();
        let full = f64::from(self.format.full_scale());
        let is_raw = self.response == LINEAR;
        let (dark, white) = self.response.range(self.format.full_scale());
        let pedestal = if is_raw { BLACK } else { 0.0 };
        let counts = arrived.mapv(|j| {
            let signal = signal_of(self.response.transfer, j / full_j * (1.0 - pedestal) + pedestal);
            (dark + signal * (white - dark)).round().clamp(0.0, full) as u16
        });
        let granted = Granted {
            format: self.format,
            width: nx,
            height: ny,
            stride: 0,
        };
        let decoding = Decoding {
            shape: (ny / self.cell(), nx / self.cell()),
            response: self.undone,
            black: if self.undone == LINEAR {
                dark + pedestal * full
            } else {
                0.0
            },
            bayer: self.bayer,
            ..Decoding::default()
        };
        let layout = Layout::new(granted, &decoding).expect("the array divides into cells");
        let found = layout
            .decode(&self.image(&counts))
            .expect("an image of the granted size");
        found.counts * (full_j / (full * (1.0 - pedestal) * self.mean_passes()))
    }

    /// The bytes that a camera would deliver.
    fn image(&self, counts: &Array2<u16>) -> Vec<u8> {
        let (ny, nx) = counts.dim();
        let bytes = || counts.iter().map(|c| *c as u8);
        match self.format {
            PixelFormat::GREY => bytes().collect(),
            PixelFormat::YUYV => bytes().flat_map(|b| [b, 128]).collect(),
            PixelFormat::MJPG => jpeg::compress(&bytes().collect::<Vec<_>>(), nx, ny, self.quality),
            _ => counts.iter().flat_map(|c| c.to_le_bytes()).collect(),
        }
    }
}

/// Signal of light, black 0 and white 1: the inverse of [`Transfer::light_of`], by bisection.
fn signal_of(transfer: Transfer, light: f64) -> f64 {
    if transfer == Transfer::Linear {
        return light;
    }
    let (mut low, mut high) = (-2.0, 2.0);
    for _ in 0..40 {
        let middle = 0.5 * (low + high);
        match transfer.light_of(middle) < light {
            true => low = middle,
            false => high = middle,
        }
    }
    0.5 * (low + high)
}
