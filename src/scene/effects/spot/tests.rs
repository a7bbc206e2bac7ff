//! The images against formulas.

use super::*;
use crate::optics::Config;

fn camera() -> Camera {
    Config::default().camera().unwrap()
}

fn image(effect: &SpotEffect, centre: [f64; 2]) -> Vec<f64> {
    let camera = camera();
    let mut pixels = vec![0.0; 64 * 64];
    let spot = Spot {
        centre,
        sigma_m: 1.0,
        energy_j: 1.0,
    };
    effect
        .images(&camera, &Key::new("spot"))
        .unwrap()
        .add(&camera, &spot, &mut pixels);
    pixels
}

/// Σ over a fine grid within each pixel, of a density of the radius.
fn exact(centre: [f64; 2], density: impl Fn(f64) -> f64) -> Vec<f64> {
    exact_at(centre, |x, y| density(x.hypot(y)))
}

fn exact_at(centre: [f64; 2], density: impl Fn(f64, f64) -> f64) -> Vec<f64> {
    let camera = camera();
    let m = 8;
    let mut pixels: Vec<f64> = (0..64 * 64)
        .map(|p| {
            let at = |axis: &crate::optics::Axis, k: usize, s: usize| {
                axis.edge(k) + (s as f64 + 0.5) / m as f64 * axis.pitch_m
            };
            let points = (0..m * m).map(|s| {
                (
                    at(&camera.x, p % 64, s % m) - centre[0],
                    at(&camera.y, p / 64, s / m) - centre[1],
                )
            });
            points.map(|(x, y)| density(x, y)).sum()
        })
        .collect();
    let total: f64 = pixels.iter().sum();
    pixels.iter_mut().for_each(|v| *v /= total);
    pixels
}

fn worst(a: &[f64], b: &[f64]) -> f64 {
    let peak = b.iter().copied().fold(0.0, f64::max);
    a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max) / peak
}

#[test]
fn images_are_those_of_their_formulas() {
    let centre = [0.000_3, -0.000_75];
    let airy = SpotEffect::Airy { first_zero_m: 1.5e-3 };
    let moffat = SpotEffect::Moffat {
        core_m: 1.2e-3,
        index: 2.5,
    };
    let disc = SpotEffect::Defocus {
        radius_m: 1.5e-3,
        blur_m: 2e-4,
    };
    let radial: [(&SpotEffect, Box<dyn Fn(f64) -> f64>); 3] = [
        (&airy, Box::new(|r| density::airy(r / 1.5e-3))),
        (&moffat, Box::new(|r| (1.0 + (r / 1.2e-3).powi(2)).powf(-2.5))),
        (&disc, Box::new(|r| density::disc((r - 1.5e-3) / 2e-4))),
    ];
    for (effect, density) in radial {
        let error = worst(&image(effect, centre), &exact(centre, density));
        // The grid's own error, and for the Airy disc and the Moffat profile the light beyond the table and the sensor.
        assert!(error < 6e-3, "{}: {error}", effect.kind());
    }
}

#[test]
fn an_aperture_without_aberrations_gives_an_airy_disc() {
    let zernike = SpotEffect::Zernike(Pupil {
        first_zero_m: 1.5e-3,
        term: vec![],
        obscuration: 0.0,
        rim: None,
    });
    let centre = [0.000_1, 0.000_2];
    let error = worst(&image(&zernike, centre), &exact(centre, |r| density::airy(r / 1.5e-3)));
    // Beyond seven dark rings lies 1.5 % of the light.
    assert!(error < 0.02, "{error}");
}

#[test]
fn a_covered_middle_and_a_rim_are_seen_in_the_spot() {
    let lens = |obscuration: f64, rim: Option<Rim>| {
        SpotEffect::Zernike(Pupil {
            first_zero_m: 1.5e-3,
            term: vec![],
            obscuration,
            rim,
        })
    };
    let centre = [0.000_1, 0.000_2];
    // A ring is the difference of two discs (Born and Wolf, 1999, section 8.6.2).
    let besinc = |v: f64| {
        if v.abs() < 1e-9 { 1.0 } else { 2.0 * libm::j1(v) / v }
    };
    let ring = |r: f64| {
        let v = density::FIRST_ZERO * r / 1.5e-3;
        (besinc(v) - 0.16 * besinc(0.4 * v)).powi(2)
    };
    let error = worst(&image(&lens(0.4, None), centre), &exact(centre, ring));
    // Of the light of a ring more lies beyond the table than of a disc's.
    assert!(error < 0.04, "{error}");
    // A rim half a radius off narrows the aperture along x, and widens the spot.
    let rim = Rim {
        moves: 0.5,
        radius: 1.0,
    };
    let at_edge = [0.8 * 0.015, 0.000_2];
    let peak = |effect: &SpotEffect| image(effect, at_edge).into_iter().fold(0.0, f64::max);
    let ratio = peak(&lens(0.0, Some(rim))) / peak(&lens(0.0, None));
    assert!((0.5..0.9).contains(&ratio), "{ratio}");
}

#[test]
fn coma_grows_away_from_the_middle() {
    let zernike = SpotEffect::Zernike(Pupil {
        first_zero_m: 1.5e-3,
        term: vec![Zernike {
            noll: 8,
            waves: vec![0.0, 0.25],
        }],
        obscuration: 0.0,
        rim: None,
    });
    let skewness = |u: f64| {
        let centre = [u * 0.015 + 1e-5, 1e-5];
        let pixels = image(&zernike, centre);
        let camera = camera();
        let x = |p: usize| camera.x.centre(p % 64);
        let near = |p: &usize| (x(*p) - centre[0]).abs() < 5e-3 && (camera.y.centre(p / 64) - centre[1]).abs() < 5e-3;
        let list: Vec<usize> = (0..64 * 64).filter(near).collect();
        let total: f64 = list.iter().map(|p| pixels[*p]).sum();
        let mean = list.iter().map(|p| pixels[*p] * x(*p)).sum::<f64>() / total;
        let moment = |k: i32| list.iter().map(|p| pixels[*p] * (x(*p) - mean).powi(k)).sum::<f64>() / total;
        moment(3) / moment(2).powf(1.5)
    };
    let (left, middle, right) = (skewness(-0.6), skewness(0.0), skewness(0.6));
    assert!(
        middle.abs() < 0.05 && right.abs() > 0.2 && (left + right).abs() < 0.05,
        "{left} {middle} {right}"
    );
}

#[test]
fn a_learned_spot_changes_over_the_field_and_scales() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("calibration.toml");
    // A wide spot that turns into a narrow one along +x; each profile's coefficients add up to one.
    let wide = "[0.05, 0.1, 0.2, 0.3, 0.2, 0.1, 0.05]";
    let narrow = "[0.0, 0.05, 0.2, 0.5, 0.2, 0.05, 0.0]";
    let term =
        |field: &str, profile: &str| format!("[[spot.shape.term]]\nfield = {field}\nx = {profile}\ny = {profile}\n");
    let text = format!(
        "version = 1\n[spot]\nsigma_m = 0.001\ngrowth = 0.0\n[spot.shape]\nknot_m = 0.0008\nhalf_sensor_m = [0.015, 0.015]\n{}{}",
        term("[0.5, -0.5]", wide),
        term("[0.5, 0.5]", narrow)
    );
    std::fs::write(&file, text).unwrap();
    let shape = calibrated::read(&file, &Key::new("spot")).unwrap();
    for (centre, width) in [
        ([0.0003, -0.00075], 1.0),
        ([0.0053, 0.0021], 1.0),
        ([-0.0107, 0.0012], 1.1),
    ] {
        let effect = SpotEffect::Calibration {
            file: file.clone(),
            width,
        };
        let expected = exact_at(centre, |x, y| shape.density(centre, [x / width, y / width]));
        let error = worst(&image(&effect, centre), &expected);
        // The fine grid's own error.
        assert!(error < 2e-3, "{centre:?}: {error}");
        assert!(effect.validate(&Key::new("spot")).is_ok());
    }
    std::fs::write(&file, "version = 1\n[spot]\nsigma_m = 0.001\ngrowth = 0.0\n").unwrap();
    let message = calibrated::read(&file, &Key::new("spot.file")).unwrap_err().to_string();
    assert!(
        message.contains("spot.file") && message.contains("a Gaussian"),
        "{message}"
    );
}
