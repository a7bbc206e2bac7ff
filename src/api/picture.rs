//! A frame as a picture: the pixels in a perceptually even colour map, marks by shape and by colours that
//! colour-blind readers can tell apart (Okabe and Ito, 2008).

use super::evidence_fit::Fit;
use super::snapshot::Snapshot;
use crate::frame::Frame;
use crate::monitor::{Alert, AlertKind, PositionStatus};
use crate::optics::Camera;

/// Dark blue through magenta to light yellow, evenly spaced; lightness rises evenly.
const COLOURS: [[f64; 3]; 6] = [
    [4.0, 5.0, 20.0],
    [51.0, 18.0, 93.0],
    [129.0, 37.0, 108.0],
    [206.0, 68.0, 76.0],
    [247.0, 143.0, 40.0],
    [250.0, 251.0, 170.0],
];
const UNUSABLE: Rgb = [0, 110, 110];

type Rgb = [u8; 3];

/// Pixels, row by row from the top.
struct Picture {
    /// Of one panel.
    panel: usize,
    width: usize,
    height: usize,
    pixels: Vec<Rgb>,
}

impl Picture {
    /// Panels of (Ny, Nx) sensor pixels beside each other.
    fn blank((ny, nx): (usize, usize), scale: usize, panels: usize) -> Self {
        let width = panels * nx * scale + (panels - 1) * GAP;
        let height = ny * scale;
        Self {
            panel: nx * scale,
            width,
            height,
            pixels: vec![[255; 3]; width * height],
        }
    }

    fn left(&self, panel: usize) -> usize {
        panel * (self.panel + GAP)
    }

    /// Fills a panel; `shade` gets row and column of a sensor pixel. Row 0 (y_min) is at the bottom.
    fn panel(&mut self, panel: usize, scale: usize, shade: impl Fn([usize; 2]) -> Rgb) {
        let left = self.left(panel);
        let rows = self.height / scale;
        for py in 0..self.height {
            let row = rows - 1 - py / scale;
            let line = &mut self.pixels[py * self.width + left..][..self.panel];
            for (pixels, column) in line.chunks_mut(scale).zip(0..) {
                pixels.fill(shade([row, column]));
            }
        }
    }

    fn mark(&mut self, panel: usize, camera: &Camera, marks: &[Mark], scale: usize) {
        let left = self.left(panel);
        for Mark { at: [x, y], status } in marks {
            let px = (x - camera.x.min_m) / camera.x.pitch_m * scale as f64;
            let py = self.height as f64 - (y - camera.y.min_m) / camera.y.pitch_m * scale as f64;
            mark(self, left, [px, py], *status);
        }
    }

    fn encode(&self) -> Result<Vec<u8>, png::EncodingError> {
        let mut out = Vec::new();
        let mut encoder = png::Encoder::new(&mut out, self.width as u32, self.height as u32);
        encoder.set_color(png::ColorType::Rgb);
        encoder.set_compression(png::Compression::Fast);
        encoder.write_header()?.write_image_data(self.pixels.as_flattened())?;
        Ok(out)
    }
}

/// A place to be marked in a picture.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Mark {
    /// On the sensor, m.
    at: [f64; 2],
    status: PositionStatus,
}

/// Marks of everything that a snapshot's report holds.
pub fn marks_of(snapshot: &Snapshot) -> Vec<Mark> {
    let emitters = snapshot.report.emitters.iter();
    let mark = |e: &crate::monitor::TrackedPosition| Mark {
        at: snapshot.camera.to_sensor([e.x_m, e.y_m]),
        status: e.status,
    };
    emitters.map(mark).collect()
}

/// Marks of one alert: the place that was claimed, and where the light came from.
pub fn marks_of_alert(alert: &Alert, camera: &Camera) -> Vec<Mark> {
    let claimed = alert
        .claimed
        .as_ref()
        .and_then(|c| Some([c["x_m"].as_f64()?, c["y_m"].as_f64()?]));
    let seen = alert.x_m.zip(alert.y_m).map(|(x, y)| [x, y]);
    let status = match alert.kind {
        AlertKind::UnclaimedEmitter | AlertKind::KnownLightChanged => PositionStatus::Unclaimed,
        _ => PositionStatus::Mismatch,
    };
    let claimed = claimed.map(|place| (place, PositionStatus::Pending));
    let seen = seen.map(|place| (place, status));
    let mark = |(place, status)| Mark {
        at: camera.to_sensor(place),
        status,
    };
    claimed.into_iter().chain(seen).map(mark).collect()
}

/// Picture pixels a sensor pixel at which a frame's longer side is at least `side` picture pixels.
pub fn scale_for(frame: &Frame, side: usize) -> usize {
    let (ny, nx) = frame.pixels.dim();
    side.div_ceil(nx.max(ny).max(1)).clamp(1, 64)
}

/// Residuals are shown up to so many standard deviations.
const RESIDUAL_SIGMA: f64 = 5.0;
/// Picture pixels between two panels.
pub const GAP: usize = 8;

/// PNG of a frame, `scale` picture pixels a sensor pixel; row 0 (y_min) is at the bottom.
pub fn png(frame: &Frame, camera: &Camera, marks: &[Mark], scale: usize) -> Result<Vec<u8>, png::EncodingError> {
    let (low, high) = range(frame);
    let mut picture = Picture::blank(frame.pixels.dim(), scale, 1);
    picture.panel(0, scale, |at| light(frame, at, low, high));
    picture.mark(0, camera, marks, scale);
    picture.encode()
}

/// PNG of a frame on its own, at least `side` picture pixels along its longer side.
///
/// # Errors
/// The frame is too large for a PNG.
pub fn frame_png(frame: &Frame, camera: &Camera, side: usize) -> Result<Vec<u8>, png::EncodingError> {
    png(frame, camera, &[], scale_for(frame, side))
}

/// PNG of a fit: the data, the model on the same scale of colours, and the residual, from -5 σ (blue) over black to +5 σ (orange).
/// The place and the claim of the alert are marked in the data and in the residual.
pub fn fit_png(fit: &Fit, camera: &Camera, marks: &[Mark], scale: usize) -> Result<Vec<u8>, png::EncodingError> {
    let (low, high) = range(&fit.data);
    let mut picture = Picture::blank(fit.data.pixels.dim(), scale, 3);
    picture.panel(0, scale, |at| light(&fit.data, at, low, high));
    picture.panel(1, scale, |at| colour((fit.model[at] - low) / (high - low)));
    picture.panel(2, scale, |at| difference(fit.residual[at]));
    picture.mark(0, camera, marks, scale);
    picture.mark(2, camera, marks, scale);
    picture.encode()
}

fn light(frame: &Frame, at: [usize; 2], low: f64, high: f64) -> Rgb {
    let value = frame.pixels[at];
    let masked = frame.masked.as_ref().is_some_and(|m| m[at]);
    if masked || !value.is_finite() {
        UNUSABLE
    } else {
        colour((value - low) / (high - low))
    }
}

/// Colour of a residual in σ.
fn difference(sigma: f64) -> Rgb {
    if !sigma.is_finite() {
        return UNUSABLE;
    }
    let full = if sigma < 0.0 {
        [86.0, 180.0, 233.0]
    } else {
        [255.0, 150.0, 30.0]
    };
    let share = (sigma.abs() / RESIDUAL_SIGMA).min(1.0);
    full.map(|c| (c * share).round() as u8)
}

/// Values shown darkest and lightest: the median, so that noise is dark, and the brightest pixel.
fn range(frame: &Frame) -> (f64, f64) {
    let mut values: Vec<f64> = frame.pixels.iter().copied().filter(|v| v.is_finite()).collect();
    if values.is_empty() {
        return (0.0, 1.0);
    }
    let middle = values.len() / 2;
    let high = values.iter().copied().fold(f64::MIN, f64::max);
    let (_, low, _) = values.select_nth_unstable_by(middle, f64::total_cmp);
    (*low, if high > *low { high } else { *low + 1.0 })
}

/// Square-root stretch: weak beams beside strong ones stay visible.
fn colour(share: f64) -> Rgb {
    let place = share.clamp(0.0, 1.0).sqrt() * (COLOURS.len() - 1) as f64;
    let k = (place as usize).min(COLOURS.len() - 2);
    let t = place - k as f64;
    std::array::from_fn(|c| (COLOURS[k][c] * (1.0 - t) + COLOURS[k + 1][c] * t).round() as u8)
}

/// Distance, in picture pixels, of a point from the outline of a mark.
fn outline(status: PositionStatus, dx: f64, dy: f64) -> f64 {
    let radius = 13.0;
    let circle = (dx.hypot(dy) - radius).abs();
    match status {
        PositionStatus::Verified => circle,
        // A triangle.
        PositionStatus::Known | PositionStatus::Ignored => (dy - 0.6 * radius)
            .max(0.866 * dx.abs() - 0.5 * dy - 0.6 * radius)
            .abs(),
        PositionStatus::Pending if (dy.atan2(dx) * 4.0 / std::f64::consts::PI).rem_euclid(2.0) < 1.0 => circle,
        PositionStatus::Pending => f64::INFINITY,
        PositionStatus::Mismatch => (dx.abs() + dy.abs() - 1.3 * radius).abs() * std::f64::consts::FRAC_1_SQRT_2,
        PositionStatus::Unclaimed => {
            let square = (dx.abs().max(dy.abs()) - radius).abs();
            let inside = dx.abs().max(dy.abs()) < radius + 6.0 && dx.abs().max(dy.abs()) > radius - 5.0;
            let diagonal = (dx.abs() - dy.abs()).abs() * std::f64::consts::FRAC_1_SQRT_2;
            if inside { square.min(diagonal) } else { square }
        }
    }
}

/// Draws a mark into the panel that begins at column `left`.
fn mark(picture: &mut Picture, left: usize, [cx, cy]: [f64; 2], status: PositionStatus) {
    let black = [0, 0, 0];
    let (ink, halo) = match status {
        PositionStatus::Verified => ([86, 180, 233], black),
        PositionStatus::Pending => ([255, 255, 255], black),
        PositionStatus::Mismatch => ([240, 228, 66], black),
        PositionStatus::Unclaimed => ([255, 255, 255], [225, 40, 20]),
        PositionStatus::Known | PositionStatus::Ignored => ([170, 170, 170], black),
    };
    let reach = 24;
    for py in (cy as i64 - reach)..=(cy as i64 + reach) {
        for px in (cx as i64 - reach)..=(cx as i64 + reach) {
            let (Ok(x), Ok(y)) = (usize::try_from(px), usize::try_from(py)) else {
                continue;
            };
            if x >= picture.panel || y >= picture.height {
                continue;
            }
            let distance = outline(status, px as f64 + 0.5 - cx, py as f64 + 0.5 - cy);
            if distance < 1.5 {
                picture.pixels[y * picture.width + left + x] = ink;
            } else if distance < 3.0 {
                picture.pixels[y * picture.width + left + x] = halo;
            }
        }
    }
}
