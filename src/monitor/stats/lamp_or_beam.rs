//! What a light's statistics say of its source: likelihoods of a beam's light over a lamp's.

/// Standard deviations of ln energy that lamps and beams have, each as likely as the other: a lamp is steady to a few per cent; a beam of
/// ten coherence times a frame has 0.3, at weak turbulence and slow frames less. Assumed.
const LAMP_STD: [f64; 4] = [0.01, 0.02, 0.04, 0.08];
const BEAM_STD: [f64; 4] = [0.12, 0.2, 0.3, 0.45];
/// Traces of the second moments of a lamp that is not a point, σ², each as likely as the others; half of the lamps are points. Assumed.
const LAMP_TRACES: [f64; 4] = [0.1, 0.3, 1.0, 3.0];
/// Largest likelihood ratio that is stated: the models are no better.
const LARGEST_RATIO: f64 = 1e6;

/// A likelihood ratio within what is stated.
pub fn stated(ratio: f64) -> f64 {
    ratio.clamp(1.0 / LARGEST_RATIO, LARGEST_RATIO)
}

/// Likelihood of a trace of the second moments for a point over that for a lamp.
pub fn point_over_lamp(trace: f64, variance: f64) -> f64 {
    // Over the likelihood for a point.
    let extended = LAMP_TRACES.iter().map(|t| (t * (trace - 0.5 * t) / variance).exp());
    stated(2.0 / (1.0 + extended.sum::<f64>() / LAMP_TRACES.len() as f64))
}

/// Likelihood of the strongest line's −ln p in `n` frames for light that is steady or scintillates over that for a lamp: half of the lamps
/// flicker, and of those whose frames show it the line has half of the variance in the mean.
pub fn steady_over_flicker(neg_log_p: f64, n: f64) -> f64 {
    let usual = 0.25 * n;
    stated(2.0 / (1.0 + (neg_log_p * (1.0 - 1.0 / usual)).exp() / usual))
}

/// Likelihood of a sample variance of `n` normal deviates under a beam's over a lamp's standard deviations.
pub fn beam_over_lamp(variance: f64, noise: f64, n: f64) -> f64 {
    let ln_likelihood = |std: &f64| {
        let expected = std * std + noise;
        -0.5 * (n - 1.0) * (expected.ln() + variance / expected)
    };
    let mean = |stds: &[f64], most: f64| stds.iter().map(|s| (ln_likelihood(s) - most).exp()).sum::<f64>();
    let most = LAMP_STD
        .iter()
        .chain(&BEAM_STD)
        .map(ln_likelihood)
        .fold(f64::NEG_INFINITY, f64::max);
    let (beam, lamp) = (mean(&BEAM_STD, most), mean(&LAMP_STD, most));
    stated(beam / lamp.max(1e-300))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_light_as_steady_as_lamps_is_a_lamp_and_one_that_scintillates_a_beam() {
        let ratio = |std: f64| beam_over_lamp(std * std, 1e-6, 64.0);
        assert!(ratio(0.02) < 1e-5 && ratio(0.3) > 1e5, "{} {}", ratio(0.02), ratio(0.3));
        // Between the two, neither.
        assert!((0.01..100.0).contains(&ratio(0.1)), "{}", ratio(0.1));
    }

    #[test]
    fn a_point_may_be_either_and_what_is_wide_is_a_lamp() {
        let ratio = |trace: f64| point_over_lamp(trace, 0.02);
        assert!((1.0..2.0).contains(&ratio(0.0)), "{}", ratio(0.0));
        assert!(ratio(1.0) < 1e-5, "{}", ratio(1.0));
    }

    #[test]
    fn light_without_a_line_may_be_either_and_what_flickers_is_a_lamp() {
        assert!((1.0..2.0).contains(&steady_over_flicker(1.0, 128.0)));
        // As likely as not: n/4·ln(n/4)/(n/4 − 1) = 3.6 for 128 frames.
        assert!((steady_over_flicker(3.578, 128.0) - 1.0).abs() < 0.01);
        assert!(steady_over_flicker(40.0, 128.0) < 1e-5);
    }

    #[test]
    fn no_ratio_is_beyond_what_the_models_are_good_for() {
        for ratio in [
            beam_over_lamp(10.0, 0.0, 1e4),
            beam_over_lamp(0.0, 1e-9, 1e4),
            point_over_lamp(1e9, 1e-3),
        ] {
            assert!((1.0 / LARGEST_RATIO..=LARGEST_RATIO).contains(&ratio), "{ratio}");
        }
    }
}
