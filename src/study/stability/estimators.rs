//! Hard cases of each estimator, and ill-conditioned matrix pencils.

use ndarray::Array2;
use rand_distr::{Distribution, Uniform};

use super::trial::{Source, anywhere, camera, energy, expose, frame, observe};
use super::{Case, Options};
use crate::estimate::{Config, ESTIMATORS};

const GROUP: &str = "Estimators";

pub(super) fn cases() -> Vec<Case> {
    let mut cases = vec![
        pencil("two that coincide", "two of the pencil's vectors are one", |_| {
            [0.0, 0.0]
        }),
        pencil("two at d = 1e-9 σ", "singular values 1e-18 of each other", |k| {
            [1e-9 * k as f64, 0.0]
        }),
        pencil(
            "nine in a line, 0.5 σ apart",
            "eigenvalues of the shift crowd together",
            |k| [0.5 * k as f64, 0.0],
        ),
        pencil(
            "nine in a row of equal x",
            "one shift has one eigenvalue nine times",
            |k| [0.0, 0.3 * k as f64],
        ),
        pencil(
            "a 3 × 3 lattice",
            "both shifts have each eigenvalue three times",
            |k| [(k % 3) as f64, (k / 3) as f64],
        ),
    ];
    cases.extend(ESTIMATORS.iter().map(|estimator| estimator.name).map(bears_anything));
    cases
}

/// Nine emitters (two where the name says so) at σ_eff 8 mm, where the estimator `pencil` returns the eigenvalues unrefined.
fn pencil(name: &'static str, hard: &'static str, place: impl Fn(usize) -> [f64; 2] + 'static) -> Case {
    let count = if name.starts_with("two") { 2 } else { 9 };
    Case::new(
        GROUP,
        format!("pencil: {name}"),
        hard,
        "no more found than there are, or a warning; nothing malformed",
        move |options| {
            let camera = camera([64, 64], 8e-3);
            let options = Options {
                estimator: Config {
                    name: Some("pencil".to_owned()),
                    ..options.estimator.clone()
                },
                ..options.clone()
            };
            let middle = (0..count)
                .map(&place)
                .fold([0.0; 2], |m, p| [0, 1].map(|k| m[k] + p[k] / count as f64));
            let tally = observe(&options, &camera, |rng| {
                let [x, y] = anywhere(&camera, 12e-3, rng);
                let sources: Vec<_> = (0..count)
                    .map(|k| Source {
                        sensor_m: [
                            x + (place(k)[0] - middle[0]) * camera.spot_sigma_m,
                            y + (place(k)[1] - middle[1]) * camera.spot_sigma_m,
                        ],
                        energy_j: energy(&camera, 1e6),
                    })
                    .collect();
                (expose(&camera, &sources, rng), sources)
            });
            let surplus = tally
                .estimates()
                .filter(|(truth, e)| {
                    let clean = e.emitters.iter().filter(|e| !e.flags.intersects(super::trial::WARNING));
                    clean.count() > truth.len()
                })
                .count();
            tally.observed(surplus == 0, &format!("{surplus} frames with too many"))
        },
    )
}

/// Frames with coincident emitters, random bits, and missing pixels, in turn.
fn bears_anything(estimator: &'static str) -> Case {
    Case::new(
        GROUP,
        format!("{estimator}: frames of any kind"),
        "coincident emitters, random bits, and half of the pixels missing, in turn",
        "no panic, nothing malformed",
        move |options| {
            let camera = camera([24, 16], 1e-3);
            let options = Options {
                estimator: Config {
                    name: Some(estimator.to_owned()),
                    ..options.estimator.clone()
                },
                ..options.clone()
            };
            let kind = std::cell::Cell::new(0);
            let tally = observe(&options, &camera, |rng| {
                kind.set((kind.get() + 1) % 3);
                let sources = [Source {
                    sensor_m: anywhere(&camera, 0.0, rng),
                    energy_j: energy(&camera, 1e3),
                }; 2];
                let mut pixels = expose(&camera, &sources, rng).pixels;
                let bits = Uniform::new_inclusive(u64::MIN, u64::MAX).expect("a range");
                match kind.get() {
                    0 => {}
                    1 => pixels = Array2::from_shape_simple_fn(camera.shape(), || f64::from_bits(bits.sample(rng))),
                    _ => pixels.mapv_inplace(|p| if bits.sample(rng) % 2 == 0 { f64::NAN } else { p }),
                }
                (frame(pixels), sources.to_vec())
            });
            tally.observed(true, "")
        },
    )
}
