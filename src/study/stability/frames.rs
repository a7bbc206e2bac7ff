//! Frames that no optical system could produce.

use ndarray::Array2;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, Uniform};

use super::emitters::LIMIT;
use super::trial::{Source, camera, energy, expose, frame, noiseless, observe};
use super::{Case, Observed, Options, false_alarms_allowed};
use crate::frame::Frame;
use crate::optics::Camera;

const GROUP: &str = "Frames";
const NO_STRAY: &str = "no position without a warning, except at the emitter";

/// The requirement on such a frame.
#[derive(Clone, Copy)]
enum Requirement {
    Nothing,
    NoneClean,
    Refused,
    AtEmitter,
}

impl Requirement {
    fn words(self) -> &'static str {
        match self {
            Self::Nothing => "nothing found",
            Self::NoneClean => "nothing found, or each position carries a warning",
            Self::Refused => "refused as unusable",
            Self::AtEmitter => NO_STRAY,
        }
    }
}

pub(super) fn cases() -> Vec<Case> {
    use Requirement::{AtEmitter, NoneClean, Nothing, Refused};
    vec![
        flat("all zero", "no noise at all", Nothing, 0.0),
        flat(
            "constant, 10 σ_n a pixel",
            "a background that the config does not mention",
            NoneClean,
            1e-5,
        ),
        flat(
            "constant, 1e6 σ_n a pixel",
            "a background that drowns every emitter",
            NoneClean,
            1.0,
        ),
        flat("negative, −10 σ_n a pixel", "no emitter is negative", NoneClean, -1e-5),
        flat("NaN everywhere", "no usable pixel", Refused, f64::NAN),
        flat("+∞ everywhere", "no usable pixel", Refused, f64::INFINITY),
        flat("largest f64 everywhere", "squares overflow", NoneClean, f64::MAX),
        flat("most negative f64 everywhere", "squares overflow", NoneClean, f64::MIN),
        flat("subnormal everywhere", "reciprocals overflow", Nothing, 5e-324),
        saturated("all saturated", 1.0, Refused),
        saturated("half of the pixels saturated at random", 0.5, AtEmitter),
        odd(
            "single hot pixel",
            "no spot is one pixel wide",
            NoneClean,
            |camera, rng| {
                let mut frame = expose(camera, &[], rng);
                frame.pixels[[13, 17]] = 1.0;
                frame
            },
        ),
        odd(
            "ten hot pixels",
            "each looks like an emitter",
            NoneClean,
            |camera, rng| {
                let mut frame = expose(camera, &[], rng);
                for _ in 0..10 {
                    frame.pixels[pixel(camera, rng)] = 1e-3;
                }
                frame
            },
        ),
        odd(
            "checkerboard of ±1000 σ_n",
            "the highest spatial frequency",
            NoneClean,
            |camera, _| pattern(camera, |y, x| if (x + y) % 2 == 0 { 1e-3 } else { -1e-3 }),
        ),
        odd(
            "ramp from 0 to 1000 σ_n",
            "a background with a slope",
            NoneClean,
            |camera, _| pattern(camera, |_, x| 1e-3 * x as f64 / 32.0),
        ),
        odd(
            "alternating largest and most negative f64",
            "sums are ∞ − ∞",
            NoneClean,
            |camera, _| pattern(camera, |y, x| if (x + y) % 2 == 0 { f64::MAX } else { f64::MIN }),
        ),
        odd(
            "dark spot",
            "an emitter of negative energy",
            NoneClean,
            |camera, rng| {
                let mut frame = expose(camera, &[], rng);
                frame.pixels -= &noiseless(camera, &[emitter(camera)]).pixels;
                frame
            },
        ),
        odd("everything masked", "no usable pixel", Refused, |camera, rng| {
            let mut frame = expose(camera, &[emitter(camera)], rng);
            frame.masked = Some(Array2::from_elem(camera.shape(), true));
            frame
        }),
        odd(
            "one of the pixels +∞",
            "one term swamps every sum",
            AtEmitter,
            |camera, rng| {
                let mut frame = expose(camera, &[emitter(camera)], rng);
                frame.pixels[[5, 5]] = f64::INFINITY;
                frame
            },
        ),
        odd(
            "the brightest pixel −∞",
            "it is the one that matters",
            AtEmitter,
            |camera, rng| {
                let mut frame = expose(camera, &[emitter(camera)], rng);
                frame.pixels[[16, 16]] = f64::NEG_INFINITY;
                frame
            },
        ),
        laden("1 % NaN", 0.01),
        laden("half NaN", 0.5),
        laden("99 % NaN", 0.99),
        odd(
            "all but one pixel NaN",
            "one number, three unknowns",
            AtEmitter,
            |camera, rng| {
                let mut frame = expose(camera, &[emitter(camera)], rng);
                let kept = frame.pixels[[16, 16]];
                frame.pixels.fill(f64::NAN);
                frame.pixels[[16, 16]] = kept;
                frame
            },
        ),
        odd(
            "a dead column through the spot",
            "zeros that claim to be data",
            AtEmitter,
            |camera, rng| {
                let mut frame = expose(camera, &[emitter(camera)], rng);
                frame.pixels.column_mut(16).fill(0.0);
                frame
            },
        ),
        wrong_shape(),
        random_bits(),
    ]
}

/// An emitter near the middle, off the pixels' centres.
fn emitter(camera: &Camera) -> Source {
    Source {
        sensor_m: [3.7e-4, 5.1e-4],
        energy_j: energy(camera, 300.0),
    }
}

fn pixel(camera: &Camera, rng: &mut ChaCha8Rng) -> [usize; 2] {
    [camera.y.n, camera.x.n].map(|n| Uniform::new(0, n).expect("a range").sample(rng))
}

fn pattern(camera: &Camera, value: impl Fn(usize, usize) -> f64) -> Frame {
    frame(Array2::from_shape_fn(camera.shape(), |(y, x)| value(y, x)))
}

fn check(
    options: &Options,
    camera: &Camera,
    requirement: Requirement,
    make: impl Fn(&Camera, &mut ChaCha8Rng) -> Frame,
) -> Observed {
    let tally = observe(options, camera, |rng| (make(camera, rng), Vec::new()));
    let place = emitter(camera).sensor_m;
    let places = if matches!(requirement, Requirement::AtEmitter) {
        vec![place]
    } else {
        Vec::new()
    };
    let (clean, stray) = tally.strays(camera, LIMIT, |_| places.clone());
    let holds = match requirement {
        Requirement::Nothing => tally.refused() == 0 && tally.counts().1 == 0,
        Requirement::Refused => tally.refused() == options.frames,
        Requirement::NoneClean | Requirement::AtEmitter => stray <= false_alarms_allowed(options.frames),
    };
    tally.observed(holds, &format!("{clean} clean positions, {stray} astray"))
}

fn odd(
    name: &'static str,
    hard: &'static str,
    requirement: Requirement,
    make: impl Fn(&Camera, &mut ChaCha8Rng) -> Frame + 'static,
) -> Case {
    Case::new(GROUP, name, hard, requirement.words(), move |options| {
        check(options, &camera([32, 32], 1e-3), requirement, &make)
    })
}

fn flat(name: &'static str, hard: &'static str, requirement: Requirement, value: f64) -> Case {
    odd(name, hard, requirement, move |camera, _| pattern(camera, |_, _| value))
}

fn laden(name: &'static str, share: f64) -> Case {
    odd(
        name,
        "holes anywhere in the spot",
        Requirement::AtEmitter,
        move |camera, rng| {
            let mut frame = expose(camera, &[emitter(camera)], rng);
            let uniform = Uniform::new(0.0, 1.0).expect("a range");
            for value in &mut frame.pixels {
                if uniform.sample(rng) < share {
                    *value = f64::NAN;
                }
            }
            frame
        },
    )
}

fn saturated(name: &'static str, share: f64, requirement: Requirement) -> Case {
    Case::new(
        GROUP,
        name,
        "a saturated pixel gives only a lower bound",
        requirement.words(),
        move |options| {
            let mut camera = camera([32, 32], 1e-3);
            camera.saturation_j = Some(1e-3);
            check(options, &camera, requirement, |camera, rng| {
                let mut frame = expose(camera, &[emitter(camera)], rng);
                let uniform = Uniform::new(0.0, 1.0).expect("a range");
                for value in &mut frame.pixels {
                    if uniform.sample(rng) < share {
                        *value = 1e-3;
                    }
                }
                frame
            })
        },
    )
}

fn wrong_shape() -> Case {
    Case::new(
        GROUP,
        "transposed shape",
        "the config's array is not the frame's",
        "refused as unusable",
        |options| {
            let camera = camera([32, 16], 1e-3);
            let tally = observe(options, &camera, |_| (frame(Array2::zeros((32, 16))), Vec::new()));
            tally.observed(tally.refused() == options.frames, "")
        },
    )
}

/// Every pixel any 64 bits: subnormals, huge values, infinities and NaN all appear.
fn random_bits() -> Case {
    Case::new(
        GROUP,
        "random bits",
        "numbers of every magnitude, and those that are none",
        "no panic, nothing malformed",
        |options| {
            let camera = camera([32, 32], 1e-3);
            let tally = observe(options, &camera, |rng| {
                let bits = Uniform::new_inclusive(u64::MIN, u64::MAX).expect("a range");
                let pixels = Array2::from_shape_simple_fn(camera.shape(), || f64::from_bits(bits.sample(rng)));
                (frame(pixels), Vec::new())
            });
            tally.observed(true, "")
        },
    )
}
