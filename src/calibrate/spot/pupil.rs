//! The spot of an aperture whose wavefront departs from a sphere by a few Zernike polynomials that change over the field. The aperture is
//! round, or cut: its middle covered, as by a secondary mirror, and its edge by a second round one, the rim of another lens, which moves
//! over the pupil with the place in the field (vignetting; Born and Wolf, 1999, section 4.8).

use std::sync::LazyLock;

use faer::{Mat, c64};
use ndarray::Array2;

use crate::optics::Camera;
use crate::optics::spot::{FieldPolynomial, Template};

/// Noll's polynomials 4 to 11: defocus, astigmatism, coma, trefoil, spherical (Noll, 1976). Tilt is the spot's place.
pub const ZERNIKES: usize = 8;
/// Coefficients of 1, u, v, u², uv, v², u and v over half the sensor.
pub const FIELD: usize = 6;
/// How a cut aperture's image changes beside: by the radius of what covers its middle, the rim's centre along x and y, and the rim's
/// radius less 1, all in radii of the aperture. A smaller rim would be the aperture itself: the sign of its parameter tells nothing, nor
/// does that of the cover's.
const CUTS: usize = 4;
const OBSCURATION: usize = 1 + ZERNIKES;
const RIM_X: usize = OBSCURATION + 1;
const RIM_Y: usize = OBSCURATION + 2;
const RIM_RADIUS: usize = OBSCURATION + 3;
/// A rim that nothing shows of.
const NO_RIM: f64 = 1.0;
/// Where the cuts start: a rim that has not moved, or is much wider than the aperture, does not change the image with them.
const START_OBSCURATION: f64 = 0.2;
const START_RIM: f64 = 0.05;
const START_RIM_MOVES: f64 = 0.2;
/// Samples across the pupil: the image repeats after as many λF.
const SAMPLES: usize = 64;
/// Parts of a sample along an axis by which the aperture's edge is told.
const EDGE_PARTS: usize = 8;
/// First zero of J₁ (Abramowitz and Stegun, 1964, table 9.5).
const AIRY_ZERO: f64 = 3.831_705_970_207_512;
/// An Airy disc's first dark ring over the σ of the Gaussian nearest to its core.
const ZERO_PER_SIGMA: f64 = 2.7;
/// Even polynomials at the start, waves: at zero the image does not change to first order with them.
const START_WAVES: f64 = 0.03;

/// For each of the ways in which the image at a place changes, a quadratic of the field: ln of the first dark ring's radius, m; the
/// root mean square of each polynomial, waves; the cuts.
#[derive(Clone, Copy, Debug)]
pub struct Pupil {
    pub parameters: [f64; Self::PARAMETERS],
    /// Whether it may change over the field.
    pub varies: bool,
    /// Whether the aperture may be cut.
    pub is_cut: bool,
}

/// What a lens does to a plane wave, in an optical engineer's terms.
#[derive(Clone, Copy, Debug, serde::Serialize)]
pub struct Wavefront {
    /// Radius of the first dark ring without aberrations, 1.22 λF, m.
    pub first_zero_m: f64,
    /// Root mean squares over pupil and sensor, waves.
    pub defocus: f64,
    pub astigmatism: f64,
    pub coma: f64,
    pub trefoil: f64,
    pub spherical: f64,
    /// Radius of what covers the aperture's middle, in its own.
    pub obscuration: f64,
    /// None where nothing shows of one.
    pub rim: Option<Rim>,
}

/// The rim of another lens that cuts the aperture off towards the sensor's edge (vignetting), in radii of the aperture.
#[derive(Clone, Copy, Debug, serde::Serialize)]
pub struct Rim {
    /// How far its centre moves over half the sensor.
    pub moves: f64,
    pub radius: f64,
}

impl Pupil {
    pub const PARAMETERS: usize = Self::CHANGES * FIELD;
    /// Ways in which the image at one place changes: its width, each polynomial there, and the cuts.
    pub const CHANGES: usize = 1 + ZERNIKES + CUTS;
    /// The change that is astigmatism along the diagonals, Noll's fifth polynomial.
    pub const OBLIQUE_ASTIGMATISM: usize = 2;

    /// Nearly the Airy disc whose core is the camera's Gaussian, the same everywhere.
    pub fn of_camera(camera: &Camera) -> Self {
        let mut parameters = [0.0; Self::PARAMETERS];
        parameters[0] = (ZERO_PER_SIGMA * camera.spot_sigma_m).ln();
        for even in [1, 2, 3] {
            parameters[FIELD * even] = START_WAVES;
        }
        parameters[FIELD * RIM_RADIUS] = NO_RIM;
        Self {
            parameters,
            varies: false,
            is_cut: false,
        }
    }

    /// The same with an aperture that may be cut, its middle covered as at the start.
    pub fn cut(mut self) -> Self {
        self.is_cut = true;
        self.parameters[FIELD * OBSCURATION] = START_OBSCURATION;
        self
    }

    /// The same with a rim that cuts off the side of the aperture towards which the field's place lies, or with the opposite `sign`
    /// the other side.
    pub fn with_rim(mut self, sign: f64) -> Self {
        self.parameters[FIELD * RIM_X + 1] = sign * START_RIM_MOVES;
        self.parameters[FIELD * RIM_Y + 2] = sign * START_RIM_MOVES;
        self.parameters[FIELD * RIM_RADIUS] = START_RIM;
        self
    }

    /// Whether change `k` is an even polynomial.
    pub fn is_even(k: usize) -> bool {
        matches!(k, 1..=3 | 8)
    }

    /// Derivatives of a change at a field place by its parameters.
    pub fn factors([u, v]: [f64; 2]) -> [f64; FIELD] {
        [1.0, u, v, u * u, u * v, v * v]
    }

    /// The parameters of change `k`.
    pub fn range(k: usize) -> std::ops::Range<usize> {
        FIELD * k..FIELD * (k + 1)
    }

    /// Whether parameter `p` is learned.
    pub fn is_free(&self, p: usize) -> bool {
        let factor = p % FIELD;
        match p / FIELD {
            0 => factor == 0,
            OBSCURATION => self.is_cut && factor == 0,
            RIM_X => self.is_cut && self.varies && matches!(factor, 0 | 1),
            RIM_Y => self.is_cut && self.varies && matches!(factor, 0 | 2),
            RIM_RADIUS => self.is_cut && self.varies && factor == 0,
            _ => self.varies || factor == 0,
        }
    }

    /// Whether change `k` is learned, anywhere.
    pub fn may_change(&self, k: usize) -> bool {
        Self::range(k).any(|p| self.is_free(p))
    }

    /// Each change at a field place.
    pub fn local(&self, place: [f64; 2]) -> [f64; Self::CHANGES] {
        std::array::from_fn(|k| {
            let parameters = &self.parameters[Self::range(k)];
            parameters.iter().zip(Self::factors(place)).map(|(p, f)| p * f).sum()
        })
    }

    /// The rim, where it cuts anything off at the sensor's corners.
    fn rim(&self) -> Option<Rim> {
        let rim = Rim {
            moves: 0.5 * (self.parameters[FIELD * RIM_X + 1] + self.parameters[FIELD * RIM_Y + 2]),
            radius: 1.0 + self.parameters[FIELD * RIM_RADIUS].abs(),
        };
        let corners = [[-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0], [1.0, 1.0]];
        let off = corners.map(|place| self.local(place));
        let farthest = off.iter().map(|l| l[RIM_X].hypot(l[RIM_Y])).fold(0.0, f64::max);
        (rim.radius - farthest < 1.0).then_some(rim)
    }

    pub fn wavefront(&self) -> Wavefront {
        let rms = |changes: std::ops::Range<usize>| {
            let of = |k: usize| FieldPolynomial(self.parameters[Self::range(k)].to_vec()).rms().powi(2);
            changes.map(of).sum::<f64>().sqrt()
        };
        Wavefront {
            first_zero_m: self.parameters[0].exp(),
            defocus: rms(1..2),
            astigmatism: rms(2..4),
            coma: rms(4..6),
            trefoil: rms(6..8),
            spherical: rms(8..9),
            obscuration: self.parameters[FIELD * OBSCURATION].abs(),
            rim: self.rim(),
        }
    }
}

/// Samples of the unit pupil that lie inside, at least in part.
pub struct Aperture(Vec<Sample>);

struct Sample {
    row: usize,
    column: usize,
    /// Share that lies inside.
    open: f64,
    polynomials: [f64; ZERNIKES],
}

fn sample(k: usize) -> f64 {
    (2.0 * k as f64 + 1.0) / SAMPLES as f64 - 1.0
}

impl Sample {
    /// None where nothing of it lies inside.
    fn of(row: usize, column: usize) -> Option<Self> {
        let part = |k: usize, a: usize| sample(k) + ((2.0 * a as f64 + 1.0) / EDGE_PARTS as f64 - 1.0) / SAMPLES as f64;
        let parts = (0..EDGE_PARTS * EDGE_PARTS).map(|p| (part(column, p % EDGE_PARTS), part(row, p / EDGE_PARTS)));
        let inside: Vec<(f64, f64)> = parts.filter(|(x, y)| x * x + y * y < 1.0).collect();
        let mean = |k: usize| inside.iter().map(|(x, y)| zernike(k, *x, *y)).sum::<f64>() / inside.len() as f64;
        (!inside.is_empty()).then(|| Self {
            row,
            column,
            open: inside.len() as f64 / (EDGE_PARTS * EDGE_PARTS) as f64,
            polynomials: std::array::from_fn(mean),
        })
    }

    /// The wave that leaves it.
    fn wave(&self, local: &[f64; Pupil::CHANGES]) -> c64 {
        let waves = local[1..=ZERNIKES].iter().zip(&self.polynomials);
        let phase: f64 = waves.map(|(w, z)| w * z).sum();
        let (sin, cos) = (std::f64::consts::TAU * phase).sin_cos();
        c64::new(cos, sin) * self.open * uncut(local, sample(self.column), sample(self.row))
    }
}

impl Aperture {
    /// The only one there is.
    pub fn unit() -> &'static Self {
        static UNIT: LazyLock<Aperture> = LazyLock::new(|| {
            let samples = (0..SAMPLES * SAMPLES).filter_map(|k| Sample::of(k / SAMPLES, k % SAMPLES));
            Aperture(samples.collect())
        });
        &UNIT
    }

    /// Spline coefficients of unit light of the spot on `n` × `n` knots, `knot_m` apart, by a Fourier transform that is sampled at them
    /// (Soummer et al., 2007).
    pub fn coefficients(&self, local: &[f64; Pupil::CHANGES], n: usize, knot_m: f64) -> Vec<f64> {
        let waves = self.0.iter().map(|sample| sample.wave(local));
        self.image(waves, &kernel(local, n, knot_m))
    }

    /// Derivatives of [`Self::coefficients`] at a place of the field by each of the pupil's changes; zero by those that it may not have.
    pub fn derivatives(&self, pupil: &Pupil, place: [f64; 2], n: usize, knot_m: f64) -> Vec<Vec<f64>> {
        const STEP: f64 = 1e-5;
        let local = pupil.local(place);
        let (waves, kernel): (Vec<c64>, _) = (
            self.0.iter().map(|sample| sample.wave(&local)).collect(),
            kernel(&local, n, knot_m),
        );
        let here = self.image(waves.iter().copied(), &kernel);
        let stepped = |k: usize| match k {
            // A wave that is a little later is turned.
            1..=ZERNIKES => {
                let turn = |sample: &Sample| c64::new(1.0, std::f64::consts::TAU * STEP * sample.polynomials[k - 1]);
                self.image(waves.iter().zip(&self.0).map(|(w, sample)| w * turn(sample)), &kernel)
            }
            _ => {
                let mut there = local;
                there[k] += STEP;
                self.coefficients(&there, n, knot_m)
            }
        };
        let derivative = |k: usize| {
            if !pupil.may_change(k) {
                return vec![0.0; here.len()];
            }
            let mut change = stepped(k);
            change.iter_mut().zip(&here).for_each(|(t, h)| *t = (*t - h) / STEP);
            change
        };
        (0..Pupil::CHANGES).map(derivative).collect()
    }

    /// Spline coefficients of unit light of the spot that the samples' waves make.
    fn image(&self, waves: impl Iterator<Item = c64>, kernel: &Mat<c64>) -> Vec<f64> {
        let mut pupil = Mat::zeros(SAMPLES, SAMPLES);
        for (sample, wave) in self.0.iter().zip(waves) {
            pupil[(sample.row, sample.column)] = wave;
        }
        let field = kernel * &pupil * kernel.transpose();
        let n = kernel.nrows();
        let density = Array2::from_shape_fn((n, n), |(j, i)| field[(j, i)].norm_sqr());
        let mut coefficients = Template::interpolated(density).into_raw_vec_and_offset().0;
        let total: f64 = coefficients.iter().sum();
        coefficients.iter_mut().for_each(|c| *c /= total);
        coefficients
    }
}

/// The Fourier transform of the samples along one axis at `n` knots about the middle.
fn kernel(local: &[f64; Pupil::CHANGES], n: usize, knot_m: f64) -> Mat<c64> {
    let per_knot = AIRY_ZERO * knot_m / local[0].exp();
    let mut kernel = Mat::zeros(n, SAMPLES);
    for q in 0..SAMPLES {
        let turn = c64::cis(-per_knot * sample(q));
        let mut wave = c64::cis(0.5 * (n - 1) as f64 * per_knot * sample(q));
        for value in kernel.col_as_slice_mut(q) {
            *value = wave;
            wave *= turn;
        }
    }
    kernel
}

/// Share of the sample at (x, y) that the cuts leave.
fn uncut(local: &[f64; Pupil::CHANGES], x: f64, y: f64) -> f64 {
    // An edge within a sample is taken for a straight one across the direction to its centre.
    let inside = |distance: f64| (0.5 + 0.5 * SAMPLES as f64 * distance).clamp(0.0, 1.0);
    let distance = |x: f64, y: f64| (x * x + y * y).sqrt();
    let of_rim = inside(1.0 + local[RIM_RADIUS].abs() - distance(x - local[RIM_X], y - local[RIM_Y]));
    of_rim * inside(distance(x, y) - local[OBSCURATION].abs())
}

/// Noll's polynomial 4 + `k`, of unit variance over the pupil.
fn zernike(k: usize, x: f64, y: f64) -> f64 {
    let r2 = x * x + y * y;
    match k {
        0 => 3f64.sqrt() * (2.0 * r2 - 1.0),
        1 => 6f64.sqrt() * 2.0 * x * y,
        2 => 6f64.sqrt() * (x * x - y * y),
        3 => 8f64.sqrt() * (3.0 * r2 - 2.0) * y,
        4 => 8f64.sqrt() * (3.0 * r2 - 2.0) * x,
        5 => 8f64.sqrt() * (3.0 * x * x - y * y) * y,
        6 => 8f64.sqrt() * (x * x - 3.0 * y * y) * x,
        _ => 5f64.sqrt() * (6.0 * r2 * r2 - 6.0 * r2 + 1.0),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::optics::spot::Field;

    #[test]
    fn cuts_take_their_share_of_the_aperture() {
        let aperture = Aperture::unit();
        let open = |local: &[f64; Pupil::CHANGES]| {
            let all: f64 = aperture.0.iter().map(|s| s.open).sum();
            aperture.0.iter().map(|s| s.wave(local).norm()).sum::<f64>() / all
        };
        let mut local = [0.0; Pupil::CHANGES];
        local[RIM_RADIUS] = NO_RIM;
        assert!((open(&local) - 1.0).abs() < 1e-9);
        local[OBSCURATION] = 0.4;
        assert!((open(&local) - 0.84).abs() < 2e-3, "{}", open(&local));
        // Two unit discs half a radius apart: their overlap is 2·acos(¼) − ½·√(1 − 1/16) of π.
        local = [0.0; Pupil::CHANGES];
        local[RIM_X] = 0.5;
        let expected = (2.0 * 0.25_f64.acos() - 0.5 * (1.0 - 0.0625_f64).sqrt()) / std::f64::consts::PI;
        assert!((open(&local) - expected).abs() < 5e-3, "{} {expected}", open(&local));
    }

    #[test]
    fn polynomials_are_orthonormal_over_the_aperture() {
        let aperture = Aperture::unit();
        let area: f64 = aperture.0.iter().map(|s| s.open).sum();
        for k in 0..ZERNIKES {
            for l in 0..=k {
                let product = |s: &Sample| s.open * s.polynomials[k] * s.polynomials[l];
                let mean = aperture.0.iter().map(product).sum::<f64>() / area;
                let expected = f64::from(u8::from(k == l));
                assert!((mean - expected).abs() < 0.01, "{k} {l}: {mean}");
            }
        }
    }

    #[test]
    fn without_aberrations_the_spot_is_an_airy_disc() {
        let (zero_m, knot_m) = (2.9e-3_f64, 0.3e-3);
        let airy = |x: f64, y: f64| {
            let v = (AIRY_ZERO * x.hypot(y) / zero_m).max(1e-9);
            (2.0 * libm::j1(v) / v).powi(2)
        };
        let field = Field {
            half_sensor_m: [0.015; 2],
        };
        let template = Template::of_density(field, knot_m, 9e-3, airy);
        let expected = &template.components[0].coefficients;
        let n = expected.nrows();
        let mut local = [0.0; Pupil::CHANGES];
        (local[0], local[RIM_RADIUS]) = (zero_m.ln(), NO_RIM);
        let found = Aperture::unit().coefficients(&local, n, knot_m);
        let (total, peak) = (expected.sum(), expected[(n / 2, n / 2)]);
        for (f, e) in found.iter().zip(expected) {
            assert!((f - e / total).abs() < 1e-3 * peak / total, "{f} {}", e / total);
        }
    }
}
