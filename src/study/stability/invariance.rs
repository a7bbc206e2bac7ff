//! Transformations that must not change the estimate, or must change it in a known way.

use std::sync::Arc;

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use super::trial::{Source, anywhere, camera, energy, expose, noiseless};
use super::{Case, Observed, Options};
use crate::estimate::{self, Estimate};
use crate::frame::Frame;
use crate::optics::{Axis, Camera};

const GROUP: &str = "Invariance";

pub(super) fn cases() -> Vec<Case> {
    let mut cases: Vec<Case> = [-300, -200, -100, -9, 9, 100, 200, 300].map(unit).into();
    cases.extend([
        mirrored("mirrored in x", |camera, frame| {
            frame.pixels.invert_axis(ndarray::Axis(1));
            (camera.clone(), |[x, y]| [-x, y])
        }),
        mirrored("mirrored in y", |camera, frame| {
            frame.pixels.invert_axis(ndarray::Axis(0));
            (camera.clone(), |[x, y]| [x, -y])
        }),
        mirrored("transposed", |camera, frame| {
            frame.pixels.swap_axes(0, 1);
            let turned = Camera {
                x: camera.y,
                y: camera.x,
                ..camera.clone()
            };
            (turned, |[x, y]| [y, x])
        }),
        shifted(),
        permuted(),
        single_precision(),
        threads(),
        no_worse_than_nothing(),
    ]);
    cases
}

fn scene(options: &Options, camera: &Camera) -> Vec<(Frame, Vec<Source>)> {
    let mut rng = ChaCha8Rng::seed_from_u64(options.seed);
    (0..options.frames)
        .map(|k| {
            let sources: Vec<_> = (0..1 + k % 4)
                .map(|i| Source {
                    sensor_m: anywhere(camera, 2e-3, &mut rng),
                    energy_j: energy(camera, 200.0 * (1.0 + i as f64)),
                })
                .collect();
            (expose(camera, &sources, &mut rng), sources)
        })
        .collect()
}

fn locate(options: &Options, camera: &Camera, frame: &Frame) -> Estimate {
    let mut estimator = estimate::build(&options.estimator, camera).expect("a known estimator");
    estimator.estimate(frame).expect("a usable frame")
}

/// Largest distance between two estimates over their emitters, in standard deviations of the first; ∞ where the numbers of
/// emitters differ. Their order does not matter.
fn difference(a: &Estimate, b: &Estimate, map: impl Fn([f64; 2]) -> [f64; 2]) -> f64 {
    if a.emitters.len() != b.emitters.len() {
        return f64::INFINITY;
    }
    let nearest = a.emitters.iter().map(|e| {
        let [x, y] = map([e.x_m, e.y_m]);
        let sigma = (e.cov_m2[0][0] + e.cov_m2[1][1]).sqrt();
        b.emitters
            .iter()
            .map(|f| (f.x_m - x).hypot(f.y_m - y) / sigma)
            .fold(f64::INFINITY, f64::min)
    });
    nearest.fold(0.0, f64::max)
}

/// Summary over all frames: the share that agrees within `limit` standard deviations, and the worst.
fn agreement(differences: impl Iterator<Item = f64>, limit: f64) -> Observed {
    let all: Vec<f64> = differences.collect();
    let apart = all.iter().filter(|d| **d > limit).count();
    let worst = all.iter().copied().fold(0.0, f64::max);
    Observed {
        happened: format!(
            "{apart} of {} frames differ; the largest difference is {worst:.1e} σ",
            all.len()
        ),
        holds: apart == 0,
        fit: None,
    }
}

/// The same frame in another unit of energy.
fn unit(exponent: i32) -> Case {
    Case::new(
        GROUP,
        format!("energies × 1e{exponent}"),
        "squares of energies leave the range of f64",
        "the same positions to 1e-6 of their own σ, energies scaled",
        move |options| {
            let before = camera([32, 32], 1e-3);
            let scale = 10f64.powi(exponent);
            let after = Camera {
                noise_std_j: before.noise_std_j * scale,
                ..before.clone()
            };
            let pairs = scene(options, &before).into_iter().map(|(mut frame, _)| {
                let a = locate(options, &before, &frame);
                frame.pixels *= scale;
                let b = locate(options, &after, &frame);
                let energies = |e: &Estimate, s: f64| e.emitters.iter().map(|e| e.energy_j * s).sum::<f64>();
                let ratio = if a.emitters.is_empty() {
                    1.0
                } else {
                    energies(&b, 1.0) / energies(&a, scale)
                };
                let off = if (ratio - 1.0).abs() < 1e-9 { 0.0 } else { f64::INFINITY };
                difference(&a, &b, |p| p).max(off)
            });
            agreement(pairs, 1e-6)
        },
    )
}

fn mirrored(
    name: &'static str,
    turn: impl Fn(&Camera, &mut Frame) -> (Camera, fn([f64; 2]) -> [f64; 2]) + 'static,
) -> Case {
    Case::new(
        GROUP,
        name,
        "sums run the other way, searches meet peaks in another order",
        "the answer turns with the frame, to 1e-3 of its own σ",
        move |options| {
            let camera = camera([32, 24], 1e-3);
            let pairs = scene(options, &camera).into_iter().map(|(mut frame, _)| {
                let a = locate(options, &camera, &frame);
                let (turned, map) = turn(&camera, &mut frame);
                frame.pixels = frame.pixels.as_standard_layout().into_owned();
                difference(&a, &locate(options, &turned, &frame), map)
            });
            agreement(pairs, 1e-3)
        },
    )
}

/// The same pixels in other coordinates: the axis has another origin.
fn shifted() -> Case {
    Case::new(
        GROUP,
        "sensor shifted by 7 pixels",
        "the same numbers at other coordinates",
        "the answer shifts by 7 pixels, to 1e-3 of its own σ",
        |options| {
            let before = camera([32, 32], 1e-3);
            let by = 7.0 * before.x.pitch_m;
            let after = Camera {
                x: Axis {
                    min_m: before.x.min_m + by,
                    ..before.x
                },
                ..before.clone()
            };
            let on_ground = by * before.ground_scale();
            let pairs = scene(options, &before).into_iter().map(|(frame, _)| {
                let (a, b) = (locate(options, &before, &frame), locate(options, &after, &frame));
                difference(&a, &b, |[x, y]| [x + on_ground, y])
            });
            agreement(pairs, 1e-3)
        },
    )
}

/// The same emitters exposed in another order.
fn permuted() -> Case {
    Case::new(
        GROUP,
        "emitters listed backwards",
        "light is added in another order, and rounds otherwise",
        "the same answer to 1e-3 of its own σ, and the bound permuted alike",
        |options| {
            let camera = camera([32, 32], 1e-3);
            let pairs = scene(options, &camera).into_iter().map(|(frame, mut sources)| {
                let noise = &frame.pixels - &noiseless(&camera, &sources).pixels;
                let a = locate(options, &camera, &frame);
                let bound = |sources: &[Source]| {
                    let places: Vec<_> = sources.iter().map(|s| camera.to_ground(s.sensor_m)).collect();
                    let energies: Vec<_> = sources.iter().map(|s| s.energy_j).collect();
                    estimate::position_bound(&camera, &places, &energies)
                };
                let before = bound(&sources);
                sources.reverse();
                let after = bound(&sources);
                let is_permuted = before
                    .iter()
                    .zip(after.iter().rev())
                    .all(|(b, a)| (b / a - 1.0).abs() < 1e-6);
                let mut frame = frame;
                frame.pixels = noise + &noiseless(&camera, &sources).pixels;
                let off = if is_permuted { 0.0 } else { f64::INFINITY };
                difference(&a, &locate(options, &camera, &frame), |p| p).max(off)
            });
            agreement(pairs, 1e-3)
        },
    )
}

fn single_precision() -> Case {
    Case::new(
        GROUP,
        "frame rounded to f32",
        "24 bits of each pixel, at SNR 200 to 800",
        "the same answer to 0.1 of its own σ",
        |options| {
            let camera = camera([32, 32], 1e-3);
            let pairs = scene(options, &camera).into_iter().map(|(mut frame, _)| {
                let a = locate(options, &camera, &frame);
                frame.pixels.mapv_inplace(|v| f64::from(v as f32));
                difference(&a, &locate(options, &camera, &frame), |p| p)
            });
            agreement(pairs, 0.1)
        },
    )
}

fn threads() -> Case {
    Case::new(
        GROUP,
        "four threads at once, a reused estimator",
        "shared tables, left-over scratch memory",
        "the same bits everywhere",
        |options| {
            let camera = Arc::new(camera([32, 32], 1e-3));
            let frames: Arc<Vec<Frame>> = Arc::new(scene(options, &camera).into_iter().map(|(f, _)| f).collect());
            let bits = |e: &Estimate| -> Vec<u64> {
                let numbers = e
                    .emitters
                    .iter()
                    .flat_map(|e| [e.x_m, e.y_m, e.energy_j, e.cov_m2[0][0], e.cov_m2[0][1]]);
                numbers.map(f64::to_bits).collect()
            };
            let expected: Vec<_> = frames.iter().map(|f| bits(&locate(options, &camera, f))).collect();
            let workers: Vec<_> = (0..4)
                .map(|k| {
                    let (camera, frames, options) = (camera.clone(), frames.clone(), options.clone());
                    std::thread::spawn(move || {
                        let mut estimator = estimate::build(&options.estimator, &camera).expect("a known estimator");
                        // A different order in each thread, so that state kept from one frame would change the next.
                        let n = frames.len();
                        let mut seen = vec![Vec::new(); n];
                        for i in 0..n {
                            let i = if k % 2 == 0 { (i + k * n / 4) % n } else { n - 1 - i };
                            seen[i] = bits(&estimator.estimate(&frames[i]).expect("a usable frame"));
                        }
                        seen
                    })
                })
                .collect();
            let differing = workers
                .into_iter()
                .map(|w| w.join().expect("no panic"))
                .flat_map(|seen| {
                    seen.into_iter()
                        .zip(&expected)
                        .map(|(a, b)| usize::from(a != *b))
                        .collect::<Vec<_>>()
                })
                .sum::<usize>();
            Observed {
                happened: format!("{differing} of {} answers differ", 4 * frames.len()),
                holds: differing == 0,
                fit: None,
            }
        },
    )
}

/// Uses this module's own forward model, not the estimator's.
fn no_worse_than_nothing() -> Case {
    Case::new(
        GROUP,
        "the fit against its start",
        "a step too far, accepted",
        "what is found explains the frame better than finding nothing",
        |options| {
            let camera = camera([32, 32], 1e-3);
            let mut worst = 0.0f64;
            for (frame, _) in scene(options, &camera) {
                let estimate = locate(options, &camera, &frame);
                let found: Vec<_> = estimate
                    .emitters
                    .iter()
                    .map(|e| Source {
                        sensor_m: e.sensor_m,
                        energy_j: e.energy_j,
                    })
                    .collect();
                let residual = &frame.pixels - &noiseless(&camera, &found).pixels;
                let squares = |a: &ndarray::Array2<f64>| a.iter().map(|v| v * v).sum::<f64>();
                worst = worst.max(squares(&residual) / squares(&frame.pixels));
            }
            Observed {
                happened: format!("at most {worst:.1e} of the frame's energy squared is left over"),
                holds: worst <= 1.0,
                fit: None,
            }
        },
    )
}
