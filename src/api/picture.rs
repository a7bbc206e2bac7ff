//! A frame as a picture: the pixels in a perceptually even colour map, marks by shape and by colours that
//! colour-blind readers can tell apart (Okabe and Ito, 2008).

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
    width: usize,
    height: usize,
    pixels: Vec<Rgb>,
}

impl Picture {
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
        AlertKind::UnclaimedEmitter => PositionStatus::Unclaimed,
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

/// PNG of a frame, `scale` picture pixels a sensor pixel; row 0 (y_min) is at the bottom.
pub fn png(frame: &Frame, camera: &Camera, marks: &[Mark], scale: usize) -> Result<Vec<u8>, png::EncodingError> {
    let (ny, nx) = frame.pixels.dim();
    let (low, high) = range(frame);
    let (width, height) = (nx * scale, ny * scale);
    let shade = |index: usize| {
        let column = index % width / scale;
        let row = ny - 1 - index / width / scale;
        let value = frame.pixels[[row, column]];
        let masked = frame.masked.as_ref().is_some_and(|m| m[[row, column]]);
        if masked || !value.is_finite() {
            UNUSABLE
        } else {
            colour((value - low) / (high - low))
        }
    };
    let mut picture = Picture {
        width,
        height,
        pixels: (0..width * height).map(shade).collect(),
    };
    for Mark { at: [x, y], status } in marks {
        let px = (x - camera.x.min_m) / camera.x.pitch_m * scale as f64;
        let py = (ny as f64 - (y - camera.y.min_m) / camera.y.pitch_m) * scale as f64;
        mark(&mut picture, [px, py], *status);
    }
    picture.encode()
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

fn mark(picture: &mut Picture, [cx, cy]: [f64; 2], status: PositionStatus) {
    let black = [0, 0, 0];
    let (ink, halo) = match status {
        PositionStatus::Verified => ([86, 180, 233], black),
        PositionStatus::Pending => ([255, 255, 255], black),
        PositionStatus::Mismatch => ([240, 228, 66], black),
        PositionStatus::Unclaimed => ([255, 255, 255], [225, 40, 20]),
    };
    let reach = 24;
    for py in (cy as i64 - reach)..=(cy as i64 + reach) {
        for px in (cx as i64 - reach)..=(cx as i64 + reach) {
            let (Ok(x), Ok(y)) = (usize::try_from(px), usize::try_from(py)) else {
                continue;
            };
            if x >= picture.width || y >= picture.height {
                continue;
            }
            let distance = outline(status, px as f64 + 0.5 - cx, py as f64 + 0.5 - cy);
            if distance < 1.5 {
                picture.pixels[y * picture.width + x] = ink;
            } else if distance < 3.0 {
                picture.pixels[y * picture.width + x] = halo;
            }
        }
    }
}
