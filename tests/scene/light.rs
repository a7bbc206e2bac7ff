//! Spots, energies and motion of simulated beams.

use std::f64::consts::PI;

use oapwatch::optics::fading::GammaGamma;
use oapwatch::optics::radiometry;
use oapwatch::scene::{Plan, Status};

use super::{moments, plan};

const STILL: &str = "[[user]]\nname = \"u\"\nmotion.still = [10, 20]\n";

/// Energy of the one emitter in `frames` frames over what it is without fading or miss.
fn factors(effects: &str, link: &str, frames: u64) -> Vec<f64> {
    let scene = |effects: &str| plan(&format!("{STILL}[link]\n{link}\n[effects]\n{effects}\n"));
    let energy = |f: &oapwatch::scene::SimulatedFrame| f.truth.emitters[0].energy_j;
    let unfaded = energy(&scene("").frame(0));
    scene(effects)
        .frames(0, frames)
        .iter()
        .map(|f| energy(f) / unfaded)
        .collect()
}

/// Kolmogorov's statistic D of the values against a distribution function.
fn kolmogorov(mut values: Vec<f64>, cumulative: impl Fn(f64) -> f64) -> f64 {
    values.sort_by(f64::total_cmp);
    let n = values.len() as f64;
    let gaps = values.iter().enumerate().map(|(k, v)| {
        let f = cumulative(*v);
        (f - k as f64 / n).abs().max((f - (k as f64 + 1.0) / n).abs())
    });
    gaps.fold(0.0, f64::max)
}

/// Smirnov's statistic D between two samples.
fn smirnov(mut a: Vec<f64>, mut b: Vec<f64>) -> f64 {
    a.sort_by(f64::total_cmp);
    b.sort_by(f64::total_cmp);
    let below = |sample: &[f64], x: f64| sample.partition_point(|v| *v <= x) as f64 / sample.len() as f64;
    a.iter()
        .chain(&b)
        .map(|x| (below(&a, *x) - below(&b, *x)).abs())
        .fold(0.0, f64::max)
}

/// Distribution function of the Gamma–Gamma law on a fine grid: Simpson over the density of ln ρ.
fn distribution(law: GammaGamma) -> impl Fn(f64) -> f64 {
    let (low, high, n) = (-30.0_f64, 4.5_f64, 6900);
    let step = (high - low) / f64::from(n);
    let density = move |u: f64| law.density(u.exp()) * u.exp();
    let mut cumulative = vec![0.0];
    for k in 0..n {
        let u = low + f64::from(k) * step;
        let piece = step / 6.0 * (density(u) + 4.0 * density(u + 0.5 * step) + density(u + step));
        cumulative.push(cumulative[k as usize] + piece);
    }
    move |x: f64| {
        let at = ((x.ln() - low) / step).clamp(0.0, f64::from(n) - 1.0);
        let k = at.floor() as usize;
        cumulative[k] + (at - at.floor()) * (cumulative[k + 1] - cumulative[k])
    }
}

#[test]
fn one_fade_follows_the_gamma_gamma_law() {
    for (alpha, beta) in [(4.0, 2.0), (11.6, 10.1), (2.2, 1.1)] {
        let n = 20_000;
        let values = factors(
            &format!("fading = {{ alpha = {alpha}, beta = {beta} }}"),
            "coherence_time_s = 1.0",
            n,
        );
        let law = GammaGamma { alpha, beta };
        let (mean, variance) = moments(&values);
        let index = law.scintillation_index();
        // Five standard errors of the mean, and of the variance by the law's own fourth moment.
        let fourth = law.moment(4.0) - 4.0 * law.moment(3.0) + 6.0 * law.moment(2.0) - 3.0;
        assert!((mean - 1.0).abs() < 5.0 * (index / n as f64).sqrt(), "{mean}");
        let spread = ((fourth - index * index) / n as f64).sqrt();
        assert!((variance - index).abs() < 5.0 * spread, "{variance} {index}");
        // 1.95/√n is exceeded once in a thousand; the seed is fixed.
        let d = kolmogorov(values, distribution(law));
        assert!(d < 1.95 / (n as f64).sqrt(), "{alpha} {beta}: {d}");
    }
}

#[test]
fn the_mean_as_one_draw_has_the_distribution_of_the_mean_drawn_value_by_value() {
    // Motion blur of a user that stands still changes nothing but makes the plan draw every value.
    let cases = [
        (
            "fading = { alpha = 4.0, beta = 2.0 }\npointing = { jitter_m = 0.1 }",
            0.01,
        ),
        ("fading = { alpha = 4.0, beta = 2.0 }", 0.05),
        (
            "fading = { alpha = 1.2, beta = 0.8 }\npointing = { jitter_m = 0.2, boresight_m = [0.3, 0.1] }",
            0.05,
        ),
        ("pointing = { jitter_m = 0.3, boresight_m = [0.0, 0.2] }", 0.04),
        (
            "fading = { alpha = 300.0, beta = 200.0 }\npointing = { jitter_m = 0.05 }",
            0.02,
        ),
        (
            "fading = { alpha = 4.0, beta = 2.0 }\npointing = { jitter_m = 0.1 }\nexact_aperture = {}",
            0.04,
        ),
    ];
    let n = 6000;
    for (effects, coherence) in cases {
        let link = format!("coherence_time_s = {coherence}");
        let folded = factors(effects, &link, n);
        let drawn = factors(&format!("{effects}\nmotion_blur = {{}}"), &link, n);
        // Two samples of n: 1.95·√(2/n) is exceeded once in a thousand; the seed is fixed.
        let d = smirnov(folded.clone(), drawn.clone());
        assert!(d < 1.95 * (2.0 / n as f64).sqrt(), "{effects}: {d}");
        let ((a, va), (b, vb)) = (moments(&folded), moments(&drawn));
        assert!((a - b).abs() < 5.0 * (2.0 * va / n as f64).sqrt(), "{effects}: {a} {b}");
        // Five standard errors of a ratio of variances, by the samples' own kurtosis.
        let kurtosis = |values: &[f64], mean: f64, variance: f64| {
            values
                .iter()
                .map(|v| ((v - mean).powi(2) / variance).powi(2))
                .sum::<f64>()
                / n as f64
        };
        let error = ((kurtosis(&folded, a, va) + kurtosis(&drawn, b, vb) - 2.0) / n as f64).sqrt();
        assert!((va / vb - 1.0).abs() < 5.0 * error, "{effects}: {va} {vb} {error}");
    }
}

#[test]
fn folding_is_what_the_papers_scene_gets() {
    let folded = plan("[effects]\nfading = { alpha = 4.0, beta = 2.0 }\npointing = { jitter_m = 0.1 }\n");
    let status = |plan: &Plan, name: &str| {
        plan.decisions()
            .iter()
            .find(|d| d.effect.name() == name)
            .unwrap()
            .status
    };
    assert_eq!(status(&folded, "fading"), Status::Folded);
    let moving = plan("[effects]\nfading = { alpha = 4.0, beta = 2.0 }\nwander = { std_rad = 1e-5, time_s = 0.1 }\n");
    assert_eq!(status(&moving, "fading"), Status::On);
}

#[test]
fn the_mean_pointing_loss_is_the_closed_form() {
    for (jitter, boresight) in [(0.1, [0.0, 0.0]), (0.25, [0.2, -0.1])] {
        let n = 20_000;
        let effects = format!("pointing = {{ jitter_m = {jitter}, boresight_m = {boresight:?} }}");
        let (mean, variance) = moments(&factors(&effects, "coherence_time_s = 1.0", n));
        let expected = radiometry::pointing_moment(1.0, 0.6, boresight, jitter);
        let second = radiometry::pointing_moment(2.0, 0.6, boresight, jitter);
        assert!(
            (mean - expected).abs() < 5.0 * (variance / n as f64).sqrt(),
            "{mean} {expected}"
        );
        let spread = second - expected * expected;
        // The loss lies in [0, 1]: its fourth central moment is at most its variance.
        assert!(
            (variance - spread).abs() < 5.0 * (spread / n as f64).sqrt(),
            "{variance} {spread}"
        );
    }
}

#[test]
fn the_exact_aperture_collects_what_the_disc_does() {
    let energy = |effects: &str| {
        let text = format!(
            "{STILL}[link]\nbeam_radius_m = 0.06\n[effects]\npointing = {{ jitter_m = 0, boresight_m = [0.04, 0] }}\n{effects}\n"
        );
        plan(&text).frame(0).truth.emitters[0].energy_j
    };
    let expected =
        radiometry::aperture_fraction(0.05, 0.06, 0.04) / radiometry::flat_aperture_fraction(0.05, 0.06, 0.04);
    let ratio = energy("exact_aperture = {}") / energy("");
    // The table's cubic interpolation is good to 10⁻⁶ of the centre.
    assert!((ratio - expected).abs() < 1e-5, "{ratio} {expected}");
}

#[test]
fn every_spot_adds_up_to_its_energy_and_the_link_budget_is_the_papers() {
    let plan = plan(&format!("{STILL}[effects]\nattenuation = {{ kappa_per_m = 0.001 }}\n"));
    let frame = plan.frame(0);
    let energy = frame.truth.emitters[0].energy_j;
    let sum: f64 = frame.frame.pixels.iter().sum();
    // 4,096 additions of rounded products.
    assert!((sum / energy - 1.0).abs() < 1e-12, "{sum} {energy}");
    let length = (300f64.powi(2) + 500.0).sqrt();
    let irradiance = 2.0 / (PI * 0.36);
    let expected = 0.9 * 0.9 * irradiance * (PI * 0.0025) * (-0.001 * length).exp() * 300.0 / length;
    assert!((energy / expected - 1.0).abs() < 1e-12, "{energy} {expected}");
}

/// Variance of the light about its centroid along both axes, m², in units of the sensor.
fn widths(plan: &Plan, k: u64) -> [f64; 2] {
    let frame = plan.frame(k).frame.pixels;
    let camera = plan.camera();
    let total: f64 = frame.iter().sum();
    let along = |centre: &dyn Fn(usize, usize) -> f64| {
        let at =
            |f: &dyn Fn(f64) -> f64| frame.indexed_iter().map(|((j, i), p)| p * f(centre(j, i))).sum::<f64>() / total;
        let mean = at(&|x| x);
        at(&|x| (x - mean).powi(2))
    };
    [along(&|_, i| camera.x.centre(i)), along(&|j, _| camera.y.centre(j))]
}

/// What the pixels add to the variance of a spot: pitch²/12 (Sheppard).
const SHEPPARD: f64 = (0.03 / 64.0) * (0.03 / 64.0) / 12.0;

#[test]
fn vibration_smears_by_its_amplitude_over_root_two() {
    let amplitude = 0.02;
    let plan = plan(&format!(
        "[[user]]\nname = \"u\"\nmotion.still = [0, 0]\n[effects]\nvibration = [{{ amplitude_rad = [{amplitude}, 0], frequency_hz = 20 }}]\n"
    ));
    let [x, y] = widths(&plan, 3);
    let expected = 1e-6 + SHEPPARD + (0.036_f64 * amplitude).powi(2) / 2.0;
    // tan θ is 10⁻⁴ from θ at this amplitude.
    assert!((x / expected - 1.0).abs() < 1e-3, "{x} {expected}");
    assert!((y / (1e-6 + SHEPPARD) - 1.0).abs() < 1e-9, "{y}");
}

#[test]
fn wander_smears_by_its_standard_deviation() {
    let plan =
        plan("[[user]]\nname = \"u\"\nmotion.still = [0, 0]\n[effects]\nwander = { std_rad = 0.02, time_s = 0.01 }\n");
    let frames = 60;
    let smears: Vec<f64> = (0..frames)
        .flat_map(|k| widths(&plan, k))
        .map(|v| v - 1e-6 - SHEPPARD)
        .collect();
    let (mean, variance) = moments(&smears);
    // The centroid takes some of the motion: variance of a mean over T of an Ornstein–Uhlenbeck process, 2(r − 1 + e⁻ʳ)/r².
    let r: f64 = 100.0;
    let expected = (0.036_f64 * 0.02).powi(2) * (1.0 - 2.0 * (r - 1.0 + (-r).exp()) / (r * r));
    let error = (variance / smears.len() as f64).sqrt();
    // Sampling eight times a correlation time and tan θ shift the mean by less than 1 %.
    assert!(
        (mean - expected).abs() < 4.0 * error + 0.01 * expected,
        "{mean} {expected} {error}"
    );
}

#[test]
fn motion_smears_evenly_along_its_path() {
    let plan = plan(
        "[[user]]\nname = \"u\"\nmotion.drift = { from_m = [-100, 0], velocity_m_s = [10, 0], after_s = -10 }\n[effects]\nmotion_blur = {}\n",
    );
    let [x, _] = widths(&plan, 0);
    // Sixteen sub-frames of a uniform law: its variance times 1 − 1/16².
    let smear = (10.0 * 0.036 / 300.0_f64).powi(2) / 12.0 * (1.0 - 1.0 / 256.0);
    assert!((x / (1e-6 + SHEPPARD + smear) - 1.0).abs() < 1e-9, "{x} {smear}");
}

#[test]
fn attitude_moves_all_spots_alike_and_by_as_much_as_it_says() {
    let plan = plan(
        "[[user]]\nname = \"u\"\nmotion.still = [0, 0]\n[effects]\nattitude = { tilt_std_rad = [1e-3, 2e-3], tilt_bias_rad = [0.01, 0] }\n",
    );
    let camera = plan.camera();
    let centroid = |k: u64| {
        let pixels = plan.frame(k).frame.pixels;
        let total: f64 = pixels.iter().sum();
        let x = pixels
            .indexed_iter()
            .map(|((_, i), p)| p * camera.x.centre(i))
            .sum::<f64>()
            / total;
        let y = pixels
            .indexed_iter()
            .map(|((j, _), p)| p * camera.y.centre(j))
            .sum::<f64>()
            / total;
        [x / 0.036, y / 0.036]
    };
    let n = 400;
    let seen: Vec<[f64; 2]> = (0..n).map(centroid).collect();
    for (axis, (std, bias)) in [(1e-3, 0.01), (2e-3, 0.0)].into_iter().enumerate() {
        let (mean, variance) = moments(&seen.iter().map(|c| c[axis]).collect::<Vec<_>>());
        assert!((mean - bias).abs() < 5.0 * std / f64::from(n as u32).sqrt(), "{mean}");
        // A variance of 400 normal draws: 7 % a standard error.
        assert!((variance.sqrt() / std - 1.0).abs() < 0.16, "{variance}");
    }
}

#[test]
fn distortion_and_vignetting_are_what_the_calibration_says() {
    let plan = plan(
        "[[user]]\nname = \"u\"\nmotion.still = [50, -30]\n[effects]\ndistortion = { radial = [0.2, 0, 0] }\nvignetting = { corner_loss = 0.4 }\n",
    );
    let frame = plan.frame(0);
    let camera = plan.calibration().applied_to(plan.camera()).unwrap();
    let [x, y] = camera.to_sensor([50.0, -30.0]);
    let total: f64 = frame.frame.pixels.iter().sum();
    let centroid = frame
        .frame
        .pixels
        .indexed_iter()
        .map(|((_, i), p)| p * camera.x.centre(i))
        .sum::<f64>()
        / total;
    // The spot is seven σ from the edge.
    assert!((centroid - x).abs() < 1e-9, "{centroid} {x}");
    let bare = super::plan("[[user]]\nname = \"u\"\nmotion.still = [50, -30]\n").frame(0);
    let passed = frame.truth.emitters[0].energy_j / bare.truth.emitters[0].energy_j;
    let expected = 1.0 - 0.4 * (x * x + y * y) / (2.0 * 0.015 * 0.015);
    assert!((passed - expected).abs() < 1e-12, "{passed} {expected}");
}

#[test]
fn fading_from_the_path_follows_andrews_and_phillips() {
    use oapwatch::optics::fading::{Wave, rytov_variance};
    let n = 20_000;
    let values = factors(
        "fading = { cn2 = 5e-13, wavelength_m = 1.55e-6 }",
        "coherence_time_s = 1.0",
        n,
    );
    let length = (300f64.powi(2) + 500.0).sqrt();
    let law = GammaGamma::from_rytov(rytov_variance(5e-13, 1.55e-6, length), Wave::Spherical);
    let d = kolmogorov(values, distribution(law));
    assert!(d < 1.95 / (n as f64).sqrt(), "{d} {law:?}");
}
