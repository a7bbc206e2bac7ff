//! Extreme cameras and units.

use super::emitters::LIMIT;
use super::trial::{Source, anywhere, camera, energy, expose, observe};
use super::{Case, false_alarms_allowed};
use crate::optics::{BlurConfig, Camera, Config};

const GROUP: &str = "Sensors";

pub(super) fn cases() -> Vec<Case> {
    let mut cases = Vec::new();
    for ratio in [1e-6, 1e-3, 0.03, 0.1, 0.3] {
        cases.push(shows(
            format!("σ_eff = {ratio} pixel"),
            "the position within a pixel hardly changes the frame",
            move || camera([32, 32], ratio * 0.03 / 32.0),
        ));
    }
    for ratio in [0.5, 1.0, 10.0, 1e3] {
        cases.push(shows(
            format!("σ_eff = {ratio} sensor widths"),
            "all positions give nearly the same frame",
            move || camera([32, 32], ratio * 0.03),
        ));
    }
    for pixels in [[1, 1], [1, 64], [64, 1], [2, 2], [3, 5], [100, 100]] {
        cases.push(shows(
            format!("{} × {} pixels", pixels[0], pixels[1]),
            "fewer numbers than unknowns, or more than usual",
            move || camera(pixels, 1e-3),
        ));
    }
    for pixels in [[64, 48], [10, 100], [100, 2]] {
        cases.push(shows(
            format!("{} × {} pixels on a square", pixels[0], pixels[1]),
            "pixels that are not square",
            move || camera(pixels, 1e-3),
        ));
    }
    for (z, altitude) in [(1e-9, 300.0), (0.036, 1e9), (0.036, 1e-3), (1e3, 1e-6)] {
        cases.push(shows(
            format!("z = {z:e} m, h_u = {altitude:e} m"),
            "ground and sensor differ by up to 3e11 in scale: grazing angles, or none",
            move || Camera {
                plane_distance_m: z,
                altitude_m: altitude,
                ..camera([32, 32], 1e-3)
            },
        ));
    }
    for (what, z) in [("z = f", 0.036), ("z → 0", 1e-12)] {
        cases.push(shows(
            format!("blur from the lens, {what}"),
            "σ_eff from diffraction alone, or from the whole aperture",
            move || {
                Config {
                    plane_distance_m: z,
                    lens_radius_m: 0.002,
                    pixels: [32, 32],
                    blur: Some(BlurConfig {
                        focal_length_m: 0.036,
                        wavelength_m: 1.55e-6,
                        sensor_sigma_m: 0.0,
                    }),
                    ..Config::default()
                }
                .camera()
                .expect("a valid camera")
            },
        ));
    }
    for snr in [1e-6, 1e-2, 1e6, 1e9, 1e12, 1e15] {
        cases.push(shows_at(
            format!("signal-to-noise ratio {snr:e}"),
            "noise overwhelming, or below the rounding of the data",
            snr,
            || camera([32, 32], 1e-3),
        ));
    }
    for (name, width, noise, is_sampled, saturation) in [
        ("no noise", 1.0, 0.0, false, f64::INFINITY),
        (
            "no noise, 1.4 % narrower than configured",
            0.986,
            0.0,
            false,
            f64::INFINITY,
        ),
        ("10 % wider than configured", 1.1, 1.0, false, f64::INFINITY),
        ("no noise, 10 % wider than configured", 1.1, 0.0, false, f64::INFINITY),
        ("sampled instead of integrated", 1.0, 0.0, true, f64::INFINITY),
        ("saturated at half of its peak", 1.0, 1.0, false, 0.5),
    ] {
        cases.push(brightest(name, width, noise, is_sampled, saturation));
    }
    cases
}

/// A spot of a peak of 10⁵ standard deviations that is not as the config says.
fn brightest(name: &'static str, width: f64, noise: f64, is_sampled: bool, saturation: f64) -> Case {
    const PEAK: f64 = 1e5;
    Case::new(
        GROUP,
        format!("brightest beam: {name}"),
        "at this signal-to-noise ratio no hypothesis explains the frame",
        "an emitter within a pixel of it",
        move |options| {
            let mut camera = camera([64, 64], 1e-3);
            let peak_j = PEAK * camera.noise_std_j;
            if saturation.is_finite() {
                camera.saturation_j = Some(saturation * peak_j);
            }
            let shown = Camera {
                spot_sigma_m: width * camera.spot_sigma_m,
                noise_std_j: noise * camera.noise_std_j,
                ..camera.clone()
            };
            let tally = observe(options, &camera, |rng| {
                let at = anywhere(&camera, 3e-3, rng);
                let area = std::f64::consts::TAU * shown.spot_sigma_m.powi(2) / (camera.x.pitch_m * camera.y.pitch_m);
                let source = Source {
                    sensor_m: at,
                    energy_j: peak_j * area,
                };
                let mut frame = expose(&shown, &[source], rng);
                for ((b, a), pixel) in frame.pixels.indexed_iter_mut() {
                    if is_sampled {
                        let d2 = (camera.x.centre(a) - at[0]).powi(2) + (camera.y.centre(b) - at[1]).powi(2);
                        *pixel = peak_j * (-0.5 * d2 / shown.spot_sigma_m.powi(2)).exp();
                    }
                    *pixel = pixel.min(camera.saturation_limit_j());
                }
                (frame, vec![source])
            });
            let missed = tally
                .estimates()
                .filter(|(truth, estimate)| {
                    estimate.emitters.iter().all(|e| {
                        let d = [0, 1].map(|k| e.sensor_m[k] - truth[0].sensor_m[k]);
                        d[0].hypot(d[1]) > camera.x.pitch_m
                    })
                })
                .count();
            tally.observed(missed == 0, &format!("missed in {missed} frames"))
        },
    )
}

fn shows(name: String, hard: &'static str, camera: impl Fn() -> Camera + 'static) -> Case {
    shows_at(name, hard, 300.0, camera)
}

/// An emitter near the middle of the given camera.
fn shows_at(name: String, hard: &'static str, snr: f64, camera: impl Fn() -> Camera + 'static) -> Case {
    Case::new(
        GROUP,
        name,
        hard,
        "no position without a warning off by more than 6 of its own σ",
        move |options| {
            let camera = camera();
            let source = Source {
                sensor_m: [0.137 * camera.x.half_width(), -0.211 * camera.y.half_width()],
                energy_j: energy(&camera, snr),
            };
            let tally = observe(options, &camera, |rng| (expose(&camera, &[source], rng), vec![source]));
            let (clean, stray) = tally.strays(&camera, LIMIT, |t| t.iter().map(|s| s.sensor_m).collect());
            let remark = format!(
                "seen in {:.0} %; {stray} of {clean} clean positions astray",
                100.0 * tally.share_counted()
            );
            tally.observed(stray <= false_alarms_allowed(options.frames), &remark)
        },
    )
}
