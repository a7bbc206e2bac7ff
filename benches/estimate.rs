//! A whole frame of nine emitters by every rung of the ladder, at 64×64 and 100×100, separated and melted.

use criterion::{Criterion, criterion_group, criterion_main};
use ndarray::Array2;
use oapwatch::estimate::{Config, LADDER, build};
use oapwatch::frame::Frame;
use oapwatch::optics::{self, psf};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, Normal};

fn frame(camera: &optics::Camera) -> Frame {
    let mut rng = ChaCha8Rng::seed_from_u64(42);
    let noise = Normal::new(0.0, camera.noise_std_j).expect("positive");
    let mut pixels = Array2::from_shape_simple_fn(camera.shape(), || noise.sample(&mut rng));
    let (mut row, mut column) = (vec![0.0; camera.x.n], vec![0.0; camera.y.n]);
    for k in 0..9 {
        // A jittered 3 × 3 lattice: nine emitters that can be told apart.
        let mut place = |i: usize| -75.0 + 75.0 * i as f64 + rng.random_range(-15.0..15.0);
        let [x, y] = camera.to_sensor([place(k % 3), place(k / 3)]);
        psf::profile(&camera.x, x, camera.spot_sigma_m, &mut row);
        psf::profile(&camera.y, y, camera.spot_sigma_m, &mut column);
        for ((b, a), pixel) in pixels.indexed_iter_mut() {
            *pixel += 7e-3 * column[b] * row[a];
        }
    }
    Frame {
        index: 0,
        time: jiff::Timestamp::UNIX_EPOCH,
        pixels,
        masked: None,
    }
}

fn frames(criterion: &mut Criterion) {
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
            let frame = frame(&camera);
            let mut group = criterion.benchmark_group(format!("{spots}/{pixels}"));
            for rung in LADDER {
                let config = Config {
                    name: Some(rung.name.to_owned()),
                    ..Default::default()
                };
                let mut estimator = build(&config, &camera).expect("a rung of the ladder");
                group.bench_function(rung.name, |b| b.iter(|| estimator.estimate(&frame)));
            }
            group.finish();
        }
    }
}

criterion_group!(benches, frames);
criterion_main!(benches);
