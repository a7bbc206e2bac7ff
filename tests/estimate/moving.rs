//! The estimator `sequence` on a platform that sways, told poses with errors.

use jiff::{SignedDuration, Timestamp};
use nalgebra::{UnitQuaternion, Vector2, Vector3};
use ndarray::Array2;
use oapwatch::estimate::{Estimate, Estimator};
use oapwatch::frame::Frame;
use oapwatch::geo::Sight;
use oapwatch::optics::{self, Camera, add_spot};
use oapwatch::pose::{Mount, Pose, PoseSigmas};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, Normal, StandardNormal};

use crate::frames::{estimator, frame};

const RATE_HZ: f64 = 10.0;
const MEAN_ENERGY_J: f64 = 5e-4;

/// A camera that sways by 4° over people who walk straight on and whose beams fade, told where it is to half a milliradian; lasting errors
/// of 3 mrad and 1 m come on top.
struct Flight {
    camera: Camera,
    /// Where each is at the beginning, m, and their velocities, m/s.
    walks: Vec<([f64; 2], [f64; 2])>,
    rng: ChaCha8Rng,
    next: u64,
}

/// A frame, the sight that it is told, and where people are.
struct Shot {
    frame: Frame,
    sight: Sight,
    truth: Vec<[f64; 2]>,
}

impl Flight {
    fn new(walks: &[([f64; 2], [f64; 2])]) -> Self {
        let config = optics::Config {
            spot_sigma_m: Some(1e-3),
            pixels: [40; 2],
            noise_std_j: 1e-6,
            ..Default::default()
        };
        Self {
            camera: config.camera().expect("a camera"),
            walks: walks.to_vec(),
            rng: ChaCha8Rng::seed_from_u64(11),
            next: 0,
        }
    }

    fn shot(&mut self) -> Shot {
        let time_s = self.next as f64 / RATE_HZ;
        let time = Timestamp::UNIX_EPOCH + SignedDuration::from_secs_f64(time_s);
        let sway = |period_s: f64| 4f64.to_radians() * (std::f64::consts::TAU * time_s / period_s).sin();
        let attitude = UnitQuaternion::from_euler_angles(sway(8.0), sway(9.0), 0.3);
        let pose = Pose {
            attitude,
            ..Pose::level(time, [5.0, -3.0, 300.0])
        };
        let mut turn = Vector3::new(3e-3, -2e-3, 3e-3);
        for k in 0..3 {
            let noise: f64 = StandardNormal.sample(&mut self.rng);
            turn[k] += 5e-4 * noise;
        }
        let sigmas = PoseSigmas {
            attitude_rad: 5e-3,
            position_m: 1.0,
        };
        let told = Pose {
            attitude: UnitQuaternion::from_scaled_axis(turn) * attitude,
            position_m: [5.8, -3.5, 300.6],
            cov: sigmas.cov(),
            ..pose.clone()
        };
        let truth: Vec<[f64; 2]> = self
            .walks
            .iter()
            .map(|(p, v)| [0, 1].map(|k| p[k] + v[k] * time_s))
            .collect();
        let noise = Normal::new(0.0, self.camera.noise_std_j).expect("noise is positive and finite");
        let mut pixels = Array2::from_shape_simple_fn(self.camera.shape(), || noise.sample(&mut self.rng));
        let buffer = pixels.as_slice_mut().expect("a fresh array is contiguous");
        let sight = Sight::new(&pose, &Mount::default());
        for [x, y] in &truth {
            let energy_j = -MEAN_ENERGY_J * (1.0 - self.rng.random::<f64>()).ln();
            let at = sight
                .sensor(&self.camera, [*x, *y, 0.0])
                .expect("in front of the camera");
            add_spot(&self.camera, at, energy_j, buffer);
        }
        let frame = Frame {
            index: self.next,
            time,
            ..frame(pixels)
        };
        self.next += 1;
        Shot {
            frame,
            sight: Sight::new(&told, &Mount::default()),
            truth,
        }
    }

    fn estimate(&mut self, estimator: &mut dyn Estimator, change: impl Fn(&Sight) -> Sight) -> (Shot, Estimate) {
        let mut shot = self.shot();
        shot.sight = change(&shot.sight);
        estimator.set_sight(Some(&shot.sight));
        let found = estimator.estimate(&shot.frame).expect("a usable frame");
        (shot, found)
    }

    /// Squared errors of places against each other, m², of frames `from` to `to`; where somebody is missed they count as ∞.
    fn errors(&mut self, name: &str, from: u64, to: u64) -> Vec<f64> {
        let mut estimator = estimator(Some(name), &self.camera);
        let mut errors = Vec::new();
        while self.next < to {
            let (shot, found) = self.estimate(&mut *estimator, Clone::clone);
            if self.next > from {
                errors.extend(apart(&self.camera, &shot, &found));
            }
        }
        errors
    }
}

/// Squared errors of places against each other, m².
fn apart(camera: &Camera, shot: &Shot, found: &Estimate) -> Vec<f64> {
    let n = shot.truth.len();
    if found.emitters.len() < n {
        return vec![f64::INFINITY; n];
    }
    let seen: Vec<Vector2<f64>> = (found.emitters.iter())
        .map(|e| {
            shot.sight
                .ground(camera, e.sensor_m)
                .expect("on the ground")
                .horizontal_m()
        })
        .collect();
    let of = |truth: &[f64; 2]| {
        let off = |p: &&Vector2<f64>| (*p - Vector2::from(*truth)).norm();
        let nearest = seen.iter().min_by(|a, b| off(a).total_cmp(&off(b))).expect("somebody");
        nearest - Vector2::from(*truth)
    };
    let errors: Vec<Vector2<f64>> = shot.truth.iter().map(of).collect();
    let common = errors.iter().sum::<Vector2<f64>>() / n as f64;
    errors.iter().map(|e| (e - common).norm_squared()).collect()
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

const WALKERS: [([f64; 2], [f64; 2]); 5] = [
    ([-40.0, -35.0], [0.7, 0.3]),
    ([5.0, -45.0], [0.0, 0.0]),
    ([40.0, -30.0], [-0.4, 0.8]),
    ([-35.0, 40.0], [0.5, -0.6]),
    ([30.0, 38.0], [-0.9, 0.0]),
];

#[test]
fn frames_of_a_platform_that_sways_add_up() {
    let together = median(Flight::new(&WALKERS).errors("sequence", 40, 120));
    let alone = median(Flight::new(&WALKERS).errors("ml", 40, 120));
    // A hundred frames of a straight course know its end five times as well as one, but for what heading and height leave in common.
    assert!(together < 0.2 * alone, "{together} against {alone} m²");
}

#[test]
fn two_whom_no_frame_tells_apart_are_two() {
    let mut walks = WALKERS.to_vec();
    walks.push(([42.8, -30.5], [-0.4, 0.8]));
    let together = Flight::new(&walks).errors("sequence", 60, 120);
    let alone = Flight::new(&walks).errors("ml", 60, 120);
    let right = |errors: &[f64]| errors.iter().filter(|e| e.is_finite()).count() as f64 / errors.len() as f64;
    assert!(right(&together) > 0.95, "{}", right(&together));
    assert!(right(&alone) < 0.6, "{}", right(&alone));
}

#[test]
fn a_pose_that_jumps_invents_nobody_and_moves_nobody_on_the_sensor() {
    let mut flight = Flight::new(&WALKERS);
    let mut estimator = estimator(Some("sequence"), &flight.camera);
    let mut others = 0;
    for k in 0..60 {
        let jump = |sight: &Sight| {
            let by = nalgebra::Vector6::new(0.0, 0.0, 0.0, if k == 50 { 8.0 } else { 0.0 }, 0.0, 0.0);
            sight.corrected(&by, *sight.cov())
        };
        let (shot, found) = flight.estimate(&mut *estimator, jump);
        others += found.emitters.len().saturating_sub(WALKERS.len());
        let errors = apart(&flight.camera, &shot, &found);
        assert!(k < 10 || errors.iter().all(|e| *e < 0.25), "frame {k}: {errors:?}");
    }
    // Noise looks like somebody for a frame now and then.
    assert!(others <= 2, "{others}");
}

#[test]
fn spots_whose_middle_is_out_of_view_are_not_reported_by_frames_together() {
    // The view ends at 125 m; the sway moves it by 21 m.
    let walks = [[0.0, 0.0], [60.0, 40.0], [-50.0, 60.0], [-30.0, -60.0], [118.0, -10.0]].map(|at| (at, [0.5, 0.2]));
    let farthest = |name: &str| {
        let mut flight = Flight::new(&walks);
        let mut estimator = estimator(Some(name), &flight.camera);
        let mut farthest = 0.0f64;
        for _ in 0..100 {
            let (_, found) = flight.estimate(&mut *estimator, Clone::clone);
            let places = found.emitters.iter().flat_map(|e| e.sensor_m);
            farthest = places.fold(farthest, |most, v| most.max(v.abs()));
        }
        (farthest - flight.camera.x.half_width()) / flight.camera.spot_sigma_m
    };
    let (together, alone) = (farthest("sequence"), farthest("ml"));
    assert!(together < 0.5 && alone > 0.5, "{together} and {alone} σ");
}
