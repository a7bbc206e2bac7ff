//! A frame of nine emitters, at 64×64 and 100×100, separated and overlapping: each stage, and the whole by every estimator.

mod timing;

use ndarray::Array2;
use oapwatch::assign::assign;
use oapwatch::estimate::stages::Stages;
use oapwatch::estimate::{Config, ESTIMATORS, build};
use oapwatch::frame::Frame;
use oapwatch::optics::{self, psf};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, Normal};
use timing::time;

/// The frame and where its spots are, m on the sensor.
fn frame(camera: &optics::Camera) -> (Frame, Vec<[f64; 2]>) {
    let mut places = Vec::new();
    let mut rng = ChaCha8Rng::seed_from_u64(42);
    let noise = Normal::new(0.0, camera.noise_std_j).expect("positive");
    let mut pixels = Array2::from_shape_simple_fn(camera.shape(), || noise.sample(&mut rng));
    let (mut row, mut column) = (vec![0.0; camera.x.n], vec![0.0; camera.y.n]);
    for k in 0..9 {
        // A jittered 3 × 3 lattice: nine emitters that can be told apart.
        let mut place = |i: usize| -75.0 + 75.0 * i as f64 + rng.random_range(-15.0..15.0);
        let [x, y] = camera.to_sensor([place(k % 3), place(k / 3)]);
        places.push([x, y]);
        psf::profile(&camera.x, x, camera.spot_sigma_m, &mut row);
        psf::profile(&camera.y, y, camera.spot_sigma_m, &mut column);
        for ((b, a), pixel) in pixels.indexed_iter_mut() {
            *pixel += 7e-3 * column[b] * row[a];
        }
    }
    let frame = Frame {
        index: 0,
        time: jiff::Timestamp::UNIX_EPOCH,
        pixels,
        masked: None,
        exposure_s: None,
        energy_scale: 1.0,
    };
    (frame, places)
}

fn main() {
    for (spots, sigma_m, noise_std_j) in [
        ("separated", 1e-3, 1e-6),
        ("melted", 8e-3, 1e-6 * std::f64::consts::TAU * 64e-6),
    ] {
        for pixels in [64, 100] {
            let camera = optics::Config {
                spot_sigma_m: Some(sigma_m),
                pixels: [pixels; 2],
                noise_std_j,
                ..Default::default()
            }
            .camera()
            .expect("a valid camera");
            let (frame, places) = frame(&camera);
            let group = format!("{spots}/{pixels}");
            stages(&group, &camera, &frame, &places);
            for spec in ESTIMATORS {
                let config = Config {
                    name: Some(spec.name.to_owned()),
                    ..Default::default()
                };
                let mut estimator = build(&config, &camera).expect("an estimator of the list");
                time(&format!("{group} {}", spec.name), || estimator.estimate(&frame));
            }
        }
    }
}

fn stages(group: &str, camera: &optics::Camera, frame: &Frame, places: &[[f64; 2]]) {
    let stage = |name: &str| format!("{group} stage: {name}");
    let mut stages = Stages::new(camera);
    time(&stage("load"), || stages.load(frame));
    time(&stage("matched filter"), || stages.matched_filter());
    time(&stage("suppression, sub-pixel peaks"), || stages.peaks());
    // A tenth of a pixel beside the truth, so that each step has something to do.
    let starts: Vec<_> = places.iter().map(|p| p.map(|v| v + 0.1 * camera.x.pitch_m)).collect();
    time(&stage("joint fit, five steps"), || stages.fit(&starts));
    time(&stage("covariance, ground"), || stages.ground());
    let found = stages.ground();
    time(&stage("assignment to nine claims"), || {
        assign(found.len(), found.len(), 1e4, |i, j| {
            (found[i].x_m - found[j].x_m).powi(2) + (found[i].y_m - found[j].y_m).powi(2)
        })
    });
}
