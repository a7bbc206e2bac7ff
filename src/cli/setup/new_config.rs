//! What the config will say, from what was seen and told.

use std::fmt::Write;
use std::sync::Arc;

use ndarray::{Array2, s};

use super::questions::{Geometry, Lens};
use super::view::{View, Viewed};
use crate::frames::v4l2::{Light, Transfer};
use crate::optics::{self, Calibration, CalibrationError, Camera, PixelMaps};

/// Widest array that is chosen, pixels a side: a frame of it takes some 15 ms.
const MOST_SIDE: usize = 512;
/// Camera pixels are summed until a spot's σ is below so many pixels of the array: sums up to there cost a few per cent of accuracy.
const WIDEST_SPOT: f64 = 2.0;
/// Share of a quantisation step that noise counts as at least (Widrow and Kollár, 2008): 1/√12.
const ROUNDING: f64 = 0.288_675_134_594_812_9;

/// The numbers of the config.
#[derive(Clone, Debug)]
pub struct NewConfig {
    /// Pixels looked at, a side, that make one of the array.
    block: usize,
    /// Nx, Ny of the array.
    pixels: [usize; 2],
    /// x, y, width, height in camera pixels, where the array does not take all of the image.
    roi: Option<[usize; 4]>,
    plane_distance_m: f64,
    /// Of the array's pixels.
    pitch_m: f64,
    pub spot_sigma_m: f64,
    /// Of one pixel of the array, counts.
    noise: f64,
    saturation: Option<f64>,
    /// Of a camera pixel.
    black_counts: f64,
}

impl NewConfig {
    pub fn new(view: &View, geometry: &Geometry) -> Self {
        let [plane_distance_m, camera_pitch_m] = geometry.plane_and_pitch_m(view.width);
        let looked_at = [view.width / view.cell, view.height / view.cell];
        let sigma = view.look.spot_sigma();
        let block = match view.source {
            Viewed::Device { .. } => {
                let side = looked_at[0].max(looked_at[1]);
                let of_spot = sigma.map_or(1, |s| (s / WIDEST_SPOT).ceil() as usize);
                // As far as there are many pixels: a coarse array saves nothing.
                side.div_ceil(MOST_SIDE).max(of_spot.min(side / 64)).max(1)
            }
            Viewed::Recording { .. } => 1,
        };
        let step = block * view.cell;
        let pixels = looked_at.map(|n| (n / block).max(1));
        let [width, height] = pixels.map(|n| n * step);
        // Centred; of even corners, so that a Bayer cell is not a matter of chance.
        let corner = |whole: usize, part: usize| (whole - part) / 4 * 2;
        let roi = [corner(view.width, width), corner(view.height, height), width, height];
        let pitch_m = camera_pitch_m * step as f64;
        let noise = view.look.noise.as_ref().map_or(0.0, |n| n.read_variance.sqrt());
        Self {
            block,
            pixels,
            roi: ([width, height] != [view.width, view.height]).then_some(roi),
            plane_distance_m,
            pitch_m,
            spot_sigma_m: sigma.map_or(pitch_m, |s| s * camera_pitch_m * view.cell as f64),
            noise: noise.max(ROUNDING * view.source.step()).max(f64::MIN_POSITIVE) * block as f64,
            saturation: view
                .saturation_counts
                .is_finite()
                .then_some(view.saturation_counts * (block * block) as f64),
            black_counts: black(view),
        }
    }

    /// Pixel maps, where there is what a config cannot hold: dark levels that differ, or bad pixels.
    pub fn calibration(&self, view: &View, camera: &Camera) -> Result<Option<Calibration>, CalibrationError> {
        let area = (self.block * self.block) as f64;
        let [nx, ny] = self.pixels;
        let black = self.black_counts * (view.cell * view.cell) as f64;
        // A device's is taken off before.
        let offset = if matches!(view.source, Viewed::Device { .. }) {
            black
        } else {
            0.0
        };
        // Without dark frames a recording's level is the only one known.
        let level = view
            .dark
            .clone()
            .unwrap_or_else(|| Array2::from_elem(view.look.bad.dim(), black));
        let blocks = |y: usize, x: usize| {
            let block = self.block;
            (0..block * block).map(move |k| (y * block + k / block, x * block + k % block))
        };
        let maps = PixelMaps {
            gain: Array2::ones((ny, nx)),
            dark_j: Array2::from_shape_fn((ny, nx), |(y, x)| {
                let sum: f64 = blocks(y, x).map(|at| level[at] - offset).sum();
                // Four digits of the noise are enough for any dark frame.
                let digit = 1e-4 * self.noise;
                (sum / digit).round() * digit
            }),
            bad: Array2::from_shape_fn((ny, nx), |(y, x)| blocks(y, x).any(|at| view.look.bad[at])),
        };
        let noise = self.noise;
        let needs_dark = maps.dark_j.iter().any(|d| d.abs() > 0.3 * noise / area.sqrt());
        let is_needed = maps.bad.iter().any(|b| *b) || (needs_dark && (view.dark.is_some() || offset == 0.0));
        if !is_needed {
            return Ok(None);
        }
        let calibration = Calibration {
            pixels: Some(Arc::new(maps)),
            ..Calibration::of(camera)
        };
        calibration.applied_to(camera).map(|_| Some(calibration))
    }

    /// The frames that were looked at as the array would have them.
    pub fn array_frames(&self, view: &View) -> Vec<Array2<f64>> {
        let [nx, ny] = self.pixels;
        let [x0, y0] = self
            .roi
            .map_or([0, 0], |roi| [roi[0], roi[1]].map(|corner| corner / view.cell));
        let block = self.block;
        let of_array = |frame: &Array2<f64>| {
            Array2::from_shape_fn((ny, nx), |(y, x)| {
                let corner = (y0 + y * block, x0 + x * block);
                let all = frame.slice(s![corner.0..corner.0 + block, corner.1..corner.1 + block]);
                let is_saturated = all.iter().any(|v| *v >= view.saturation_counts);
                self.saturation.filter(|_| is_saturated).unwrap_or_else(|| all.sum())
            })
        };
        view.images.iter().map(of_array).collect()
    }

    /// As the config will describe it, without a calibration.
    pub fn camera(&self) -> Result<Camera, optics::Error> {
        self.optics().camera()
    }

    fn optics(&self) -> optics::Config {
        optics::Config {
            plane_distance_m: self.plane_distance_m,
            pixels: self.pixels,
            sensor_size_m: self.pixels.map(|n| n as f64 * self.pitch_m),
            spot_sigma_m: Some(self.spot_sigma_m),
            noise_std_j: self.noise,
            joules_per_count: Some(1.0),
            saturation_j: self.saturation,
            ..optics::Config::default()
        }
    }

    /// The config, `calibration` being the name of the file beside it.
    pub fn text(&self, head: &str, view: &View, geometry: &Geometry, calibration: Option<&str>) -> String {
        let mut text = String::new();
        let is_counts = view.source.step() > 0.0;
        let unit = if is_counts { "counts" } else { "joules" };
        let [sx, sy] = self.pixels.map(|n| n as f64 * self.pitch_m);
        let lens = match geometry.lens {
            Lens::Measures { .. } => "the focal length, for a lens focused far away",
            Lens::FieldOfView { .. } => "from the field of view, for pixels of 3 µm: only the ratio matters",
        };
        let spot = match view.look.spots.len() {
            0 => "a guess, one pixel: no spot was seen. Run setup again with a beam in view".to_owned(),
            n => format!("of {n} spots"),
        };
        let _ = write!(
            text,
            "{head} from {} frames. Energies (…_j) are in {unit}{}.\n\
             # All keys: config/default.toml, `oapwatch check` validates this file.\n\n[optics]\n\
             altitude_m = {:?}\n\
             plane_distance_m = {:e}   # lens to sensor: {lens}\n\
             pixels = [{}, {}]\n\
             sensor_size_m = [{sx:e}, {sy:e}]\n\
             spot_sigma_m = {:e}   # {spot}\n\
             noise_std_j = {:e}   # {}\n",
            view.images.len(),
            if is_counts { ": there is no scale to joules" } else { "" },
            geometry.altitude_m,
            self.plane_distance_m,
            self.pixels[0],
            self.pixels[1],
            self.spot_sigma_m,
            self.noise,
            self.noise_text(view),
        );
        if is_counts {
            text.push_str("joules_per_count = 1.0\n");
        }
        if let Some(saturation) = self.saturation {
            let _ = writeln!(text, "saturation_j = {saturation:?}");
        }
        if let Some(name) = calibration {
            let _ = writeln!(
                text,
                "calibration = {name:?}   # dark levels, bad pixels, the spot's shape"
            );
        }
        self.source(&mut text, view);
        text.push_str(
            "\n[claims]\n# log = \"claims.ndjson\"   # the access network's log; POST /v1/claims works beside it\n\n\
             [journal]\n# path = \"oapwatch.db\"   # alerts survive a restart; in memory when left out\n",
        );
        text
    }

    fn source(&self, text: &mut String, view: &View) {
        match &view.source {
            Viewed::Recording { path, .. } => {
                let path = std::path::absolute(path).unwrap_or_else(|_| path.clone());
                let _ = write!(
                    text,
                    "\n[source]\nkind = \"replay\"\nframes = {:?}\n",
                    path.display().to_string()
                );
                if let Some(rate) = view.rate_hz {
                    let _ = writeln!(text, "rate_hz = {rate:.3}");
                }
            }
            Viewed::Device { path, settings } => {
                let image = settings.image;
                let rate = settings
                    .rate_hz
                    .or(view.rate_hz)
                    .unwrap_or(crate::frames::Config::DEFAULT_RATE_HZ);
                let rate = rate.clamp(1e-3, 1e5);
                let _ = write!(
                    text,
                    "\n[source]\nkind = \"v4l2\"\ndevice = {:?}\nrate_hz = {rate:.3}\n\n\
                     [source.v4l2]   # {} ({})\n\
                     pixel_format = {:?}   # {}\n\
                     size = [{}, {}]\n",
                    path.display().to_string(),
                    settings.card,
                    settings.driver,
                    image.format.name(),
                    image.format.says(),
                    image.width,
                    image.height,
                );
                if let Some(roi) = self.roi {
                    let _ = writeln!(text, "roi = {roi:?}   # a whole multiple of optics.pixels");
                }
                if image.format.light() == Light::Bayer {
                    text.push_str("bayer = \"binned\"\n");
                }
                if view.response.transfer != Transfer::Linear || view.response.limited_range {
                    let seen = if view.response_seen {
                        "seen in the noise"
                    } else {
                        "by the driver's word; the noise did not show it"
                    };
                    let (name, limited) = (view.response.transfer.name(), view.response.limited_range);
                    let _ = write!(text, "transfer = {name:?}   # {seen}\nlimited_range = {limited}\n");
                }
                if self.black_counts > 0.0 {
                    let _ = writeln!(text, "black_counts = {:.2}", self.black_counts);
                }
                if let Some(exposure) = settings.exposure {
                    let _ = writeln!(text, "exposure_us = {:?}", 1e6 * exposure.as_secs_f64());
                }
                if let Some(gain) = settings.gain {
                    let _ = writeln!(text, "gain = {gain}");
                }
                text.push_str(
                    "# flip_x = true   # where a beam that moves east moves to smaller x on the page\n\
                     # flip_y = true   # where a beam that moves north moves to smaller y\n",
                );
            }
        }
    }

    fn noise_text(&self, view: &View) -> String {
        match &view.look.noise {
            Err(_) => "a guess: it could not be measured".to_owned(),
            Ok(noise) if noise.gain.is_some() => "without light, from photon transfer".to_owned(),
            Ok(_) => "from differences of frames".to_owned(),
        }
    }

    /// What was found, a line each.
    pub fn report(&self, view: &View) -> Vec<String> {
        let mut lines = Vec::new();
        if let Viewed::Device { settings, .. } = &view.source {
            let image = settings.image;
            let (name, width, height) = (image.format.name(), image.width, image.height);
            lines.push(format!(
                "{}: {name} {width} × {height}, {}",
                settings.card,
                image.format.says()
            ));
            if let Some(exposure) = settings.exposure {
                lines.push(format!("exposure {:.0} µs", 1e6 * exposure.as_secs_f64()));
            }
        }
        let [nx, ny] = self.pixels;
        let each = self.block * view.cell;
        lines.push(format!(
            "array of {nx} × {ny} pixels, {each} × {each} camera pixels each"
        ));
        if let Ok(noise) = &view.look.noise {
            let (read, dark) = (noise.read_variance.sqrt(), noise.dark_counts);
            lines.push(format!("read noise {read:.3} counts, dark level {dark:.2} counts"));
            if let Some(gain) = noise.gain {
                let k = gain.counts_per_electron;
                let well = (view.saturation_counts - dark) / k;
                lines.push(format!(
                    "gain {k:.4} ± {:.1} % counts an electron, read noise {:.2} electrons, full scale {well:.0} electrons; variance \
                     departs {:.1} % from a line up to {:.0} counts",
                    100.0 * gain.relative_std,
                    read / k,
                    100.0 * gain.misfit,
                    gain.up_to_counts
                ));
            }
        }
        lines.push(format!("bad pixels: {}", view.look.bad.iter().filter(|b| **b).count()));
        if let Some(sigma) = view.look.spot_sigma() {
            let (sigma, n) = (sigma * view.cell as f64, view.look.spots.len());
            lines.push(format!("spots: {n}, σ {sigma:.2} camera pixels"));
        }
        lines
    }
}

/// Level of a camera pixel without light.
fn black(view: &View) -> f64 {
    let counts = view.look.noise.as_ref().map_or(0.0, |n| n.dark_counts);
    (counts / (view.cell * view.cell) as f64).max(0.0)
}
