//! Fourier optics: the image of a point through an aperture whose wavefront is aberrated.

use ndarray::Array2;
use serde::{Deserialize, Serialize};

use super::density::FIRST_ZERO;
use super::image_table::ImageTable;
use crate::optics::Camera;
use crate::toml_file::{Key, OutOfRange};

/// One Zernike polynomial of the wavefront, normalised to unit variance over the pupil (Noll, 1976, eq. 1–4).
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Zernike {
    /// Noll's index: 4 defocus, 5 and 6 astigmatism, 7 and 8 coma, 9 and 10 trefoil, 11 spherical.
    pub noll: usize,
    /// Root mean square in waves, as coefficients of 1, u, v, u², uv, v² of the place on the sensor over half its size.
    pub waves: Vec<f64>,
}

/// A round aperture whose wavefront departs from a sphere by Zernike polynomials that change over the field.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Pupil {
    pub first_zero_m: f64,
    #[serde(default)]
    pub term: Vec<Zernike>,
    /// Radius of what covers the aperture's middle, in its own.
    #[serde(default)]
    pub obscuration: f64,
    #[serde(default)]
    pub rim: Option<Rim>,
}

/// The rim of another lens, through which no more light comes than through the aperture (vignetting): its centre moves over the aperture with
/// the place in the field.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Rim {
    /// How far over half the sensor, in radii of the aperture.
    pub moves: f64,
    /// Its radius, in radii of the aperture.
    pub radius: f64,
}

impl Pupil {
    pub(super) fn validate(&self, key: &Key) -> Result<(), OutOfRange> {
        key.at("first_zero_m").positive(self.first_zero_m)?;
        let reason = "radii of the aperture, of which some must stay open";
        key.at("obscuration").within(self.obscuration, 0.0..=0.9, reason)?;
        if let Some(rim) = self.rim {
            key.at("rim").at("moves").within(rim.moves, -0.7..=0.7, reason)?;
            key.at("rim").at("radius").within(rim.radius, 0.7..=10.0, reason)?;
        }
        let mut terms = self.term.iter().enumerate();
        terms.try_for_each(|(k, term)| term.validate(&key.item("term", k)))
    }

    /// Whether the image is the same all over the field.
    pub(super) fn is_uniform(&self) -> bool {
        self.term.iter().all(|t| t.waves.len() == 1) && self.rim.is_none()
    }

    /// The image at a place of the field, (u, v) over half the sensor, by a matrix Fourier transform (Soummer et al., 2007). Its
    /// centroid is that of the wavefront's tilt: zero but for what the terms bring.
    pub(super) fn table(&self, camera: &Camera, field: [f64; 2]) -> ImageTable {
        let (first_zero_m, terms) = (self.first_zero_m, &self.term);
        // First dark ring: v = π r/(λF).
        let scale = FIRST_ZERO / first_zero_m;
        let axes = [&camera.x, &camera.y];
        let per_pixel = axes.map(|a| {
            ((10.0 * a.pitch_m / first_zero_m).ceil() as usize)
                .clamp(8, 48)
                .next_multiple_of(2)
        });
        let step: [f64; 2] = std::array::from_fn(|k| axes[k].pitch_m / per_pixel[k] as f64);
        let half = |k: usize| ((REACH * first_zero_m).min(2.0 * axes[k].half_width()) / step[k]).ceil() as usize + 1;
        let (hx, hy) = (half(0), half(1));

        let place = |k: usize| (2 * k + 1) as f64 / SAMPLES as f64 - 1.0;
        let waves: Vec<f64> = terms.iter().map(|t| t.waves_at(field)).collect();
        let pupil: Vec<[f64; 2]> = (0..SAMPLES * SAMPLES)
            .map(|k| {
                let (x, y) = (place(k % SAMPLES), place(k / SAMPLES));
                let open = self.open(field, x, y);
                let phase: f64 = terms.iter().zip(&waves).map(|(t, w)| w * t.value(x, y)).sum();
                let (sin, cos) = (std::f64::consts::TAU * phase).sin_cos();
                [open * cos, open * sin]
            })
            .collect();
        let kernel = |half: usize, step: f64| -> Vec<[f64; 2]> {
            let at = |i: usize| (i as f64 - half as f64) * step * scale;
            let pairs = (0..=2 * half).flat_map(|i| (0..SAMPLES).map(move |k| (i, k)));
            pairs
                .map(|(i, k)| {
                    let (sin, cos) = (at(i) * place(k)).sin_cos();
                    [cos, -sin]
                })
                .collect()
        };
        let (kx, ky) = (kernel(hx, step[0]), kernel(hy, step[1]));
        let (nx, ny) = (2 * hx + 1, 2 * hy + 1);
        let dot = |a: &[[f64; 2]], b: &[[f64; 2]]| {
            a.iter().zip(b).fold([0.0; 2], |[re, im], ([a, b], [c, d])| {
                [re + a * c - b * d, im + a * d + b * c]
            })
        };
        // Along x for each row of the pupil, then along y.
        let along: Vec<[f64; 2]> = kx
            .chunks_exact(SAMPLES)
            .flat_map(|k| pupil.chunks_exact(SAMPLES).map(|row| dot(row, k)))
            .collect();
        let mut image = Array2::from_shape_fn((ny, nx), |(j, i)| {
            let [re, im] = dot(
                &along[i * SAMPLES..(i + 1) * SAMPLES],
                &ky[j * SAMPLES..(j + 1) * SAMPLES],
            );
            re * re + im * im
        });
        let total = image.sum();
        image.mapv_inplace(|v| v / total);
        ImageTable::of_samples(image, per_pixel)
    }

    /// Share of the sample at a place of the aperture that is open; edges are soft by one sample, so that they are no staircases.
    fn open(&self, [u, v]: [f64; 2], x: f64, y: f64) -> f64 {
        let inside = |by: f64| (0.5 + by * 0.5 * SAMPLES as f64).clamp(0.0, 1.0);
        let of_rim = |rim: Rim| inside(rim.radius - (x - rim.moves * u).hypot(y - rim.moves * v));
        let rho = x.hypot(y);
        inside(1.0 - rho) * (1.0 - inside(self.obscuration - rho)) * self.rim.map_or(1.0, of_rim)
    }
}

/// Samples across the pupil: the image repeats after as many λF.
const SAMPLES: usize = 64;
/// Radii of the first dark ring out to which the image is computed.
const REACH: f64 = 7.0;
const MOST_NOLL: usize = 36;

impl Zernike {
    pub(super) fn validate(&self, key: &Key) -> Result<(), OutOfRange> {
        if !(2..=MOST_NOLL).contains(&self.noll) {
            return Err(key.at("noll").refuse(format!("2 to {MOST_NOLL}"), self.noll));
        }
        if !(1..=6).contains(&self.waves.len()) {
            return Err(key.at("waves").refuse("1 to 6 numbers", self.waves.len()));
        }
        for waves in &self.waves {
            let reason = "beyond, the image is wider than what is computed";
            key.at("waves").within(*waves, -2.0..=2.0, reason)?;
        }
        Ok(())
    }

    fn waves_at(&self, [u, v]: [f64; 2]) -> f64 {
        let powers = [1.0, u, v, u * u, u * v, v * v];
        self.waves.iter().zip(powers).map(|(c, p)| c * p).sum()
    }

    /// The polynomial at a place in the unit pupil.
    fn value(&self, x: f64, y: f64) -> f64 {
        let (n, m) = order(self.noll);
        let (rho, theta) = (x.hypot(y), y.atan2(x));
        let norm = (f64::from(n + 1) * if m == 0 { 1.0 } else { 2.0 }).sqrt();
        let angular = match (m, self.noll % 2) {
            (0, _) => 1.0,
            (m, 0) => (f64::from(m) * theta).cos(),
            (m, _) => (f64::from(m) * theta).sin(),
        };
        norm * radial(n, m, rho) * angular
    }
}

/// Radial order n and azimuthal frequency m of Noll's index.
fn order(noll: usize) -> (i32, i32) {
    let mut n = 0;
    let mut before = 0;
    while before + n < noll {
        before += n;
        n += 1;
    }
    // Orders are numbered from 1 here: row n holds n indices.
    let (n, place) = (n as i32 - 1, (noll - before) as i32 - 1);
    // m rises in steps of two; each m > 0 has two indices.
    let m = if n % 2 == 0 {
        (place + 1) / 2 * 2
    } else {
        place / 2 * 2 + 1
    };
    (n, m)
}

/// R_n^m(ρ) (Noll, 1976, eq. 2).
fn radial(n: i32, m: i32, rho: f64) -> f64 {
    let factorial = |k: i32| (1..=k).map(f64::from).product::<f64>();
    (0..=(n - m) / 2)
        .map(|s| {
            let sign = if s % 2 == 0 { 1.0 } else { -1.0 };
            sign * factorial(n - s) / (factorial(s) * factorial((n + m) / 2 - s) * factorial((n - m) / 2 - s))
                * rho.powi(n - 2 * s)
        })
        .sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nolls_polynomials_are_orthonormal() {
        // Noll's table 1.
        let expected = [
            (0, 0),
            (1, 1),
            (1, 1),
            (2, 0),
            (2, 2),
            (2, 2),
            (3, 1),
            (3, 1),
            (3, 3),
            (3, 3),
            (4, 0),
        ];
        for (k, nm) in expected.iter().enumerate() {
            assert_eq!(order(k + 1), *nm, "{}", k + 1);
        }
        let n = 200;
        let place = |k: usize| (2 * k + 1) as f64 / n as f64 - 1.0;
        let inside: Vec<[f64; 2]> = (0..n * n)
            .map(|k| [place(k % n), place(k / n)])
            .filter(|[x, y]| x.hypot(*y) < 1.0)
            .collect();
        let term = |noll: usize| Zernike { noll, waves: vec![1.0] };
        for a in 4..=11 {
            for b in a..=11 {
                let sum: f64 = inside
                    .iter()
                    .map(|[x, y]| term(a).value(*x, *y) * term(b).value(*x, *y))
                    .sum();
                let expected = if a == b { 1.0 } else { 0.0 };
                // The disc's edge is cut in squares of a hundredth of the radius.
                assert!((sum / inside.len() as f64 - expected).abs() < 0.02, "{a} {b}");
            }
        }
    }
}
