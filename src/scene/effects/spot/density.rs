//! Light per area of the shapes that have a formula, and of measured ones; on any scale.

use std::path::Path;

use ndarray::Array2;

use crate::toml_file::{Key, OutOfRange};

/// Radii of the first dark ring out to which an Airy pattern is computed: beyond lies 0.9 % of its light.
pub const AIRY_REACH: f64 = 12.0;
/// First zero of J₁ (Abramowitz and Stegun, 1964, table 9.5).
pub const FIRST_ZERO: f64 = 3.831_705_970_207_512;

/// (2J₁(v)/v)², `r` in radii of the first dark ring.
pub fn airy(r: f64) -> f64 {
    let v = FIRST_ZERO * r;
    match v < 1e-6 {
        true => 1.0,
        false => (2.0 * libm::j1(v) / v).powi(2),
    }
}

/// (1 + t)^−index, `t` the squared radius over that of the core.
pub fn moffat(t: f64, index: f64) -> f64 {
    (1.0 + t).powf(-index)
}

/// Cores out to which a Moffat profile is computed: beyond lies 10⁻⁴ of its light, or they are 40.
pub fn moffat_reach(index: f64) -> f64 {
    // The light beyond r is (1 + r²)^(1 − index).
    (1e4_f64.powf(1.0 / (index - 1.0)) - 1.0).max(16.0).sqrt().min(40.0)
}

/// A disc's edge: 1 inside, 0 outside; `t` blurs beyond it.
pub fn disc(t: f64) -> f64 {
    0.5 * libm::erfc(t * std::f64::consts::FRAC_1_SQRT_2)
}

pub fn gaussian(r2: f64, sigma: f64) -> f64 {
    (-0.5 * r2 / (sigma * sigma)).exp() / (std::f64::consts::TAU * sigma * sigma)
}

/// Reads rows of numbers, at least 4 × 4.
pub fn read_template(file: &Path, key: &Key) -> Result<Array2<f64>, OutOfRange> {
    let refuse = |found: String| key.refuse("a text file of rows of numbers, 4 × 4 to 1000 × 1000", found);
    let text = std::fs::read_to_string(file).map_err(|e| refuse(format!("{}: {e}", file.display())))?;
    let mut rows: Vec<Vec<f64>> = Vec::new();
    for (k, line) in text.lines().enumerate().filter(|(_, l)| !l.trim().is_empty()) {
        let words = line
            .split(|c: char| c == ',' || c.is_whitespace())
            .filter(|w| !w.is_empty());
        let row: Option<Vec<f64>> = words.map(|w| w.parse().ok().filter(|v: &f64| v.is_finite())).collect();
        match row {
            Some(row) if rows.first().is_none_or(|first| first.len() == row.len()) => rows.push(row),
            _ => {
                return Err(refuse(format!(
                    "{}, line {}: {}",
                    file.display(),
                    k + 1,
                    line.chars().take(40).collect::<String>()
                )));
            }
        }
    }
    let (ny, nx) = (rows.len(), rows.first().map_or(0, Vec::len));
    if !(4..=1000).contains(&ny) || !(4..=1000).contains(&nx) {
        return Err(refuse(format!("{}: {nx} × {ny}", file.display())));
    }
    let samples = Array2::from_shape_vec((ny, nx), rows.concat()).expect("rows are of one length");
    match samples.sum() > 0.0 {
        true => Ok(samples),
        false => Err(refuse(format!("{}: no light", file.display()))),
    }
}

/// Samples between their places, by cubic convolution (Keys, 1981); their centroid lies at zero.
pub fn sampled(samples: &Array2<f64>, pitch: f64, x: f64, y: f64) -> f64 {
    let (ny, nx) = samples.dim();
    let total = samples.sum();
    let mean = |f: &dyn Fn((usize, usize)) -> usize| {
        samples.indexed_iter().map(|(at, v)| f(at) as f64 * v).sum::<f64>() / total
    };
    let place = |t: f64, centre: f64| t / pitch + centre;
    let (cx, cy) = (place(x, mean(&|(_, i)| i)), place(y, mean(&|(j, _)| j)));
    let (i0, j0) = (cx.floor(), cy.floor());
    let mut sum = 0.0;
    for dj in -1..3 {
        for di in -1..3 {
            let (i, j) = (i0 + f64::from(di), j0 + f64::from(dj));
            if i >= 0.0 && j >= 0.0 && (i as usize) < nx && (j as usize) < ny {
                sum += keys(cx - i) * keys(cy - j) * samples[(j as usize, i as usize)];
            }
        }
    }
    sum
}

fn keys(t: f64) -> f64 {
    let t = t.abs();
    if t < 1.0 {
        (1.5 * t - 2.5) * t * t + 1.0
    } else if t < 2.0 {
        ((-0.5 * t + 2.5) * t - 4.0) * t + 2.0
    } else {
        0.0
    }
}
