//! Frames of the same emitters one after another, and the bound of all of them together.

use nalgebra::{DMatrix, DVector, SymmetricEigen};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, Gamma, Normal};

use super::scene::{AREA_HALF_M, energy};
use crate::frame::Frame;
use crate::optics::psf::pixel_response;
use crate::optics::{Axis, Camera, add_spot};

/// Eigenvalues of a scaled information matrix are taken for at least this share of the largest: rounding.
const LEAST_EIGENVALUE: f64 = 1e-15;
/// Share of the half width of the area in which walkers start, so that they stay in view.
const INNER: f64 = 0.88;

/// How emitters move and fade from frame to frame.
#[derive(Clone, Copy, Debug)]
pub(in crate::study) struct Walk {
    /// Five to nine without.
    pub emitters: Option<usize>,
    pub frames: usize,
    pub rate_hz: f64,
    /// Largest speed, m/s; 0 for users who stand still.
    pub speed_m_s: f64,
    /// Relative standard deviation of a frame's energy.
    pub relative_std: f64,
}

/// The truth of frames one after another: emitters that walk straight on, with energies of their own in each frame.
pub(in crate::study) struct Snapshots {
    pub starts_m: Vec<[f64; 2]>,
    pub velocities_m_s: Vec<[f64; 2]>,
    pub times_s: Vec<f64>,
    /// By frame and emitter, J.
    pub energies_j: Vec<Vec<f64>>,
}

impl Snapshots {
    pub fn draw(camera: &Camera, walk: &Walk, rng: &mut ChaCha8Rng) -> Self {
        let is_moving = walk.speed_m_s > 0.0;
        let half = AREA_HALF_M * if is_moving { INNER } else { 1.0 };
        let n = walk.emitters.unwrap_or_else(|| rng.random_range(5..=9));
        let starts_m: Vec<[f64; 2]> = (0..n)
            .map(|_| std::array::from_fn(|_| rng.random_range(-half..half)))
            .collect();
        let velocity = |rng: &mut ChaCha8Rng| {
            let (speed, angle) = (
                rng.random::<f64>() * walk.speed_m_s,
                rng.random_range(0.0..std::f64::consts::TAU),
            );
            [speed * angle.cos(), speed * angle.sin()]
        };
        let velocities_m_s = (0..n).map(|_| velocity(rng)).collect();
        let means: Vec<f64> = starts_m.iter().map(|&p| energy(camera, p, rng)).collect();
        let variance = walk.relative_std.powi(2);
        let fading = Gamma::new(1.0 / variance, variance).expect("a positive deviation");
        let energies_j = (0..walk.frames)
            .map(|_| means.iter().map(|mean| mean * fading.sample(rng)).collect())
            .collect();
        Self {
            starts_m,
            velocities_m_s,
            times_s: (0..walk.frames).map(|k| k as f64 / walk.rate_hz).collect(),
            energies_j,
        }
    }

    pub fn positions(&self, frame: usize) -> Vec<[f64; 2]> {
        let t = self.times_s[frame];
        let at = |(p, v): (&[f64; 2], &[f64; 2])| [p[0] + t * v[0], p[1] + t * v[1]];
        self.starts_m.iter().zip(&self.velocities_m_s).map(at).collect()
    }

    pub fn frame(&self, camera: &Camera, frame: usize, rng: &mut ChaCha8Rng) -> Frame {
        let noise = Normal::new(0.0, camera.noise_std_j).expect("a camera's noise is positive and finite");
        let mut pixels = ndarray::Array2::from_shape_simple_fn(camera.shape(), || noise.sample(rng));
        let buffer = pixels.as_slice_mut().expect("a fresh array is contiguous");
        for (position, energy) in self.positions(frame).into_iter().zip(&self.energies_j[frame]) {
            add_spot(camera, camera.to_sensor(position), *energy, buffer);
        }
        let nanoseconds = (self.times_s[frame] * 1e9).round() as i128;
        Frame {
            index: frame as u64,
            time: jiff::Timestamp::from_nanosecond(nanoseconds).expect("minutes after 1970"),
            pixels,
            masked: None,
            exposure_s: None,
            energy_scale: 1.0,
        }
    }

    /// The Cramér–Rao bounds of the positions at the last of the first `frames` frames, m² with both axes summed, from all of them:
    /// positions, velocities (where `is_moving`) and each frame's energies unknown. One list for each number of frames, which rise.
    pub fn bounds_m2(&self, camera: &Camera, frames: &[usize], is_moving: bool) -> Vec<Vec<f64>> {
        let n = 2 * self.starts_m.len();
        let mut moments: [DMatrix<f64>; 3] = std::array::from_fn(|_| DMatrix::zeros(n, n));
        let mut bounds = Vec::new();
        let mut shapes = None;
        for (k, energies) in self.energies_j.iter().enumerate() {
            if is_moving || shapes.is_none() {
                shapes = Some(information_per_joule2(camera, &self.positions(k)));
            }
            let Some(shapes) = &shapes else { continue };
            let t = self.times_s[k];
            let own = DMatrix::from_fn(n, n, |r, c| shapes[(r, c)] * energies[r / 2] * energies[c / 2]);
            for (power, moment) in moments.iter_mut().enumerate() {
                *moment += t.powi(power as i32) * &own;
            }
            for _ in frames.iter().filter(|f| **f == k + 1) {
                bounds.push(bound_m2(&moments, t, is_moving && k > 0));
            }
        }
        bounds
    }
}

/// Bounds from Σ tᵏM over the frames' information matrices M, of the positions at `last_s`.
fn bound_m2(moments: &[DMatrix<f64>; 3], last_s: f64, is_moving: bool) -> Vec<f64> {
    let [zeroth, first, second] = moments;
    let n = zeroth.nrows();
    let information = match is_moving {
        false => zeroth.clone(),
        true => {
            let cross = (first - last_s * zeroth) / last_s;
            let square = (second - 2.0 * last_s * first + last_s * last_s * zeroth) / (last_s * last_s);
            DMatrix::from_fn(2 * n, 2 * n, |r, c| match (r < n, c < n) {
                (true, true) => zeroth[(r, c)],
                (false, false) => square[(r - n, c - n)],
                (true, false) => cross[(r, c - n)],
                (false, true) => cross[(r - n, c)],
            })
        }
    };
    let scale = information.diagonal().map(|d| 1.0 / d.max(f64::MIN_POSITIVE).sqrt());
    let scaled = DMatrix::from_fn(scale.len(), scale.len(), |r, c| {
        information[(r, c)] * scale[r] * scale[c]
    });
    let eigen = SymmetricEigen::new(scaled);
    let least = LEAST_EIGENVALUE * eigen.eigenvalues.max();
    let variance = |i: usize| -> f64 {
        let share = |k: usize| eigen.eigenvectors[(i, k)].powi(2) / eigen.eigenvalues[k].max(least);
        scale[i] * scale[i] * (0..scale.len()).map(share).sum::<f64>()
    };
    (0..n / 2).map(|e| variance(2 * e) + variance(2 * e + 1)).collect()
}

/// Information on positions, 1/(m² J²), emitter by emitter (x, y), of a frame in which each emitter's energy is unknown and 1 J.
fn information_per_joule2(camera: &Camera, positions: &[[f64; 2]]) -> DMatrix<f64> {
    let n = positions.len();
    let places: Vec<[f64; 2]> = positions.iter().map(|p| camera.to_sensor(*p)).collect();
    let coordinates = |axis: &Axis, k: usize| compressed(axis, camera, places.iter().map(|p| p[k]));
    let (x, y) = (coordinates(&camera.x, 0), coordinates(&camera.y, 1));
    let outer = |a: usize, b: usize| -> DVector<f64> { y.column(b).kronecker(&x.column(a)) };
    let light: Vec<_> = (0..n).map(|i| outer(2 * i, 2 * i)).collect();
    let slopes: Vec<_> = (0..n)
        .flat_map(|i| [outer(2 * i + 1, 2 * i), outer(2 * i, 2 * i + 1)])
        .collect();
    let basis = DMatrix::from_columns(&light).qr().q();
    let mut slopes = DMatrix::from_columns(&slopes);
    for _ in 0..2 {
        slopes -= &basis * (basis.transpose() * &slopes);
    }
    let per_metre = 1.0 / (camera.ground_scale() * camera.noise_std_j);
    slopes.tr_mul(&slopes) * per_metre.powi(2)
}

/// Spots' profiles and their derivatives along an axis, alternating, in an orthonormal basis of what they span.
fn compressed(axis: &Axis, camera: &Camera, centres: impl Iterator<Item = f64>) -> DMatrix<f64> {
    let mut columns = Vec::new();
    for centre in centres {
        let response = |k: usize| pixel_response(axis.edge(k), axis.edge(k + 1), centre, camera.spot_sigma_m);
        columns.push(DVector::from_fn(axis.n, |k, _| response(k).fraction));
        columns.push(DVector::from_fn(axis.n, |k, _| response(k).d_centre));
    }
    DMatrix::from_columns(&columns).qr().r()
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;

    use super::*;
    use crate::estimate::position_bound;
    use crate::study::tradeoff::{Cell, Noise};

    fn drawn(speed_m_s: f64) -> (Camera, Snapshots) {
        let camera = Cell::new(Noise::Energy, 4.0, 64).camera().unwrap();
        let walk = Walk {
            emitters: None,
            frames: 40,
            rate_hz: 10.0,
            speed_m_s,
            relative_std: 0.3,
        };
        let snapshots = Snapshots::draw(&camera, &walk, &mut ChaCha8Rng::seed_from_u64(7));
        (camera, snapshots)
    }

    #[test]
    fn the_bound_of_one_frame_is_that_of_a_single_frame() {
        let (camera, snapshots) = drawn(0.0);
        let expected = position_bound(&camera, &snapshots.starts_m, &snapshots.energies_j[0]);
        let bounds = snapshots.bounds_m2(&camera, &[1], false);
        for (bound, expected) in bounds[0].iter().zip(&expected) {
            assert!((bound / expected - 1.0).abs() < 1e-6, "{bound} {expected}");
        }
    }

    #[test]
    fn velocities_that_are_unknown_cost_up_to_four_times_the_variance() {
        let (camera, snapshots) = drawn(0.0);
        let still = snapshots.bounds_m2(&camera, &[40], false);
        let moving = snapshots.bounds_m2(&camera, &[40], true);
        // The end of a straight line through even measurements: 4 of 1 with many frames.
        let ratio: f64 = moving[0].iter().sum::<f64>() / still[0].iter().sum::<f64>();
        assert!((2.0..6.0).contains(&ratio), "{ratio}");
    }
}
