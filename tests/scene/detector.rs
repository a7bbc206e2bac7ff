//! The detector: noise, saturation, defects and quantisation.

use oapwatch::scene::{Fate, Plan};

use super::{moments, plan};

/// All pixels of `frames` frames without a beam.
fn dark(effects: &str, frames: u64) -> Vec<f64> {
    let plan = plan(&format!("[effects]\n{effects}\n"));
    plan.frames(0, frames)
        .iter()
        .flat_map(|f| f.frame.pixels.iter().copied().collect::<Vec<_>>())
        .collect()
}

#[test]
fn thermal_noise_is_white_and_normal_in_every_pixel() {
    let plan = plan("[effects]\nthermal_noise = {}\n");
    let frames = plan.frames(0, 200);
    let values: Vec<f64> = frames
        .iter()
        .flat_map(|f| f.frame.pixels.iter().map(|p| p / 1e-6))
        .collect();
    let n = values.len() as f64;
    let (mean, variance) = moments(&values);
    // Five standard errors: 1/√n and √(2/n); of the fourth moment √(96/n).
    assert!(
        mean.abs() < 5.0 / n.sqrt() && (variance - 1.0).abs() < 5.0 * (2.0 / n).sqrt(),
        "{mean} {variance}"
    );
    let kurtosis = values.iter().map(|v| v.powi(4)).sum::<f64>() / n;
    assert!((kurtosis - 3.0).abs() < 5.0 * (96.0 / n).sqrt(), "{kurtosis}");
    let neighbours = values.windows(2).map(|w| w[0] * w[1]).sum::<f64>() / n;
    assert!(neighbours.abs() < 5.0 / n.sqrt(), "{neighbours}");
    for pixel in [(0, 0), (31, 17), (63, 63)] {
        let one: Vec<f64> = frames.iter().map(|f| f.frame.pixels[pixel] / 1e-6).collect();
        // 200 draws: a standard error of the variance of 0.1.
        assert!((moments(&one).1 - 1.0).abs() < 0.5);
    }
}

#[test]
fn shot_noise_has_poissons_mean_and_variance_from_few_quanta_to_many() {
    // Expected quanta a pixel: 0.3 and 50 by Poisson's law, 10⁷ by the normal one.
    for quanta in [0.3, 50.0, 1e7] {
        let quantum = 1e-9;
        let light = quanta * quantum;
        let values = dark(
            &format!("background = {{ uniform_j = {light:e} }}\nshot_noise = {{ quantum_j = {quantum:e} }}"),
            20,
        );
        let n = values.len() as f64;
        let counts: Vec<f64> = values.iter().map(|v| v / quantum).collect();
        let (mean, variance) = moments(&counts);
        assert!((mean - quanta).abs() < 5.0 * (quanta / n).sqrt(), "{mean}");
        // Poisson: the fourth central moment is λ + 3λ², so the variance's standard error √((λ + 2λ²)/n).
        let error = ((quanta + 2.0 * quanta * quanta) / n).sqrt();
        assert!((variance - quanta).abs() < 5.0 * error, "{variance} {quanta}");
    }
}

#[test]
fn background_and_dark_current_are_levels_without_noise_of_their_own() {
    let values = dark(
        "background = { uniform_j = 2e-6, gradient_j = [1e-6, 0] }\ndark_current = { energy_j = 5e-7 }",
        1,
    );
    let (left, right) = (values[0], values[63]);
    // Pixel centres are 63/64 of the half-width out.
    assert!(
        (left - (2.5e-6 - 1e-6 * 63.0 / 64.0)).abs() < 1e-18 && (right - (2.5e-6 + 1e-6 * 63.0 / 64.0)).abs() < 1e-18
    );
}

#[test]
fn dark_current_scatters_from_pixel_to_pixel_and_not_from_frame_to_frame() {
    let values = dark("dark_current = { energy_j = 1e-6, spread = 0.3 }", 2);
    let (first, second) = values.split_at(4096);
    assert_eq!(first, second);
    let (mean, variance) = moments(first);
    // Log-normal of relative spread 0.3: five standard errors of the mean are 2.4 %, of the spread about 8 %.
    assert!(
        (mean / 1e-6 - 1.0).abs() < 0.024 && (variance.sqrt() / 3e-7 - 1.0).abs() < 0.1,
        "{mean} {variance}"
    );
}

#[test]
fn gain_scatters_the_light_and_the_calibration_knows_it() {
    let plan = plan("[effects]\nbackground = { uniform_j = 1e-3 }\ngain = { std = 0.02 }\n");
    let frame = plan.frame(0).frame.pixels;
    let (mean, variance) = moments(&frame.iter().map(|p| p / 1e-3).collect::<Vec<_>>());
    // 4,096 draws: the standard deviation's standard error is 1.1 % of it.
    assert!(
        (mean - 1.0).abs() < 0.0016 && (variance.sqrt() / 0.02 - 1.0).abs() < 0.06,
        "{mean} {variance}"
    );
    let gain = &plan.calibration().pixels.unwrap().gain;
    assert!(
        frame
            .iter()
            .zip(gain)
            .all(|(p, g)| (p / (1e-3 * g) - 1.0).abs() < 1e-12)
    );
}

#[test]
fn quantisation_rounds_within_half_a_count_and_clips_at_both_ends() {
    let values = dark(
        "thermal_noise = {}\nquantisation = { bits = 6, joules_per_count = 1e-7, black_level_counts = 20 }",
        4,
    );
    let counts: Vec<f64> = values.iter().map(|v| v / 1e-7).collect();
    assert!(
        counts
            .iter()
            .all(|c| (c - c.round()).abs() < 1e-9 && (-20.0..=43.0).contains(&c.round()))
    );
    assert!(counts.iter().any(|c| c.round() == -20.0));
    // σ_n is ten counts: rounding adds 1/12 of a count².
    let wide = dark(
        "thermal_noise = {}\nquantisation = { bits = 16, joules_per_count = 1e-6, black_level_counts = 1000 }",
        20,
    );
    let (_, variance) = moments(&wide.iter().map(|v| v / 1e-6).collect::<Vec<_>>());
    // 81,920 draws: five standard errors are 2.5 %.
    assert!((variance / (1.0 + 1.0 / 12.0) - 1.0).abs() < 0.025, "{variance}");
}

#[test]
fn no_pixel_carries_more_than_saturation_and_blooming_reaches_up_and_down_only() {
    let text = |effects: &str| {
        format!("[optics]\nsaturation_j = 1e-5\n[[user]]\nname = \"u\"\nmotion.still = [0, 0]\n{effects}")
    };
    let clipped = plan(&text("")).frame(0).frame.pixels;
    let bloomed = plan(&text("[effects]\nsaturation = { blooming = 1.0 }\n"))
        .frame(0)
        .frame
        .pixels;
    assert!(clipped.iter().chain(&bloomed).all(|p| *p <= 1e-5));
    let full = |f: &ndarray::Array2<f64>, column: usize| f.column(column).iter().filter(|p| **p >= 1e-5).count();
    assert!(full(&bloomed, 32) > full(&clipped, 32) + 4);
    assert_eq!(bloomed.column(5), clipped.column(5));
}

#[test]
fn broken_pixels_are_as_many_as_the_scene_says_and_masked_if_it_says_so() {
    let plan = plan(
        "[effects]\nbackground = { uniform_j = 1e-6 }\ndefects = { dead = 0.02, hot = 0.03, hot_j = 1e-4, masked = true }\n",
    );
    let frame = plan.frame(0).frame;
    let count = |f: &dyn Fn(f64) -> bool| frame.pixels.iter().filter(|p| f(**p)).count() as f64;
    // 4,096 Bernoulli draws: 82 ± 9 and 123 ± 11; five standard deviations.
    assert!((count(&|p| p == 0.0) - 82.0).abs() < 45.0);
    assert!((count(&|p| p > 5e-5) - 123.0).abs() < 55.0);
    let mask = frame.masked.unwrap();
    assert!(
        frame
            .pixels
            .iter()
            .zip(&mask)
            .all(|(p, m)| *m == (*p == 0.0 || *p > 5e-5))
    );
}

#[test]
fn a_glint_has_its_peak_and_keeps_to_its_hours() {
    let plan = plan(
        "[effects]\nglint = [{ at_m = [0, 0], spread_m = 40, peak_j = 1e-3, present = { from_s = 5, until_s = 8 } }]\n",
    );
    let brightest = |k| plan.frame(k).frame.pixels.iter().copied().fold(0.0, f64::max);
    assert_eq!(brightest(4), 0.0);
    // A blot of ten pixels' σ: the pixel average is 0.2 % below the peak.
    assert!((brightest(6) / 1e-3 - 1.0).abs() < 0.005);
    assert_eq!(brightest(8), 0.0);
}

#[test]
fn frames_get_lost_and_repeated_as_often_as_the_scene_says() {
    let plan: Plan = plan("[effects]\nthermal_noise = {}\nframe_loss = { dropped = 0.1, repeated = 0.2 }\n");
    let frames = plan.frames(0, 1000);
    let count = |fate| frames.iter().filter(|f| f.fate == fate).count() as f64;
    // 1,000 Bernoulli draws: 100 ± 9.5 and 200 ± 12.6; five standard deviations.
    assert!((count(Fate::Dropped) - 100.0).abs() < 48.0 && (count(Fate::Repeated) - 200.0).abs() < 64.0);
    let mut last = None;
    for frame in &frames {
        match frame.fate {
            Fate::Delivered => last = Some(frame.frame.digest()),
            Fate::Repeated => assert_eq!(Some(frame.frame.digest()), last),
            Fate::Dropped => assert!(frame.frame.pixels.iter().all(|p| p.is_nan())),
        }
    }
}
