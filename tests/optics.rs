//! The optics against mpmath (tests/reference/optics.py) and against the conservation of energy.

mod reference;

use oapwatch::optics::fading::{GammaGamma, Wave, rytov_variance};
use oapwatch::optics::{Axis, psf, radiometry};
use reference::{quantiles, relative, table};

fn pixels() -> Vec<[f64; 7]> {
    table(
        include_str!("reference/pixel.csv"),
        ["lo_m", "hi_m", "centre_m", "sigma_m", "fraction", "d_centre", "d_sigma"],
    )
}

#[test]
fn pixel_fraction_is_exact_to_1e_12() {
    let errors = pixels()
        .into_iter()
        .map(|[lo, hi, c, s, exact, ..]| relative(psf::pixel_fraction(lo, hi, c, s), exact));
    assert!(quantiles("pixel fraction", errors).max <= 1e-12);
}

#[test]
fn pixel_derivatives_are_exact_to_1e_12() {
    let rows = pixels();
    let centre = rows
        .iter()
        .map(|&[lo, hi, c, s, _, exact, _]| relative(psf::pixel_response(lo, hi, c, s).d_centre, exact));
    assert!(quantiles("d/dcentre", centre).max <= 1e-12);
    // ∂ΔΦ/∂σ changes sign near m = ±1; relative to the larger of itself and ΔΦ/σ, its own scale, the error has a meaning there too.
    let sigma = rows.iter().map(|&[lo, hi, c, s, fraction, _, exact]| {
        let error = psf::pixel_response(lo, hi, c, s).d_sigma - exact;
        error.abs() / exact.abs().max(fraction / s)
    });
    assert!(quantiles("d/dsigma", sigma).max <= 1e-12);
}

#[test]
fn hard_pixels_are_exact_to_1e_12() {
    let rows = table(
        include_str!("reference/hard_pixel.csv"),
        ["lo_m", "hi_m", "centre_m", "sigma_m", "fraction", "d_centre", "d_sigma"],
    );
    let errors = rows
        .into_iter()
        .flat_map(|[lo, hi, c, s, fraction, d_centre, d_sigma]| {
            let r = psf::pixel_response(lo, hi, c, s);
            let scale = d_sigma.abs().max(fraction / s);
            [
                relative(r.fraction, fraction),
                relative(r.d_centre, d_centre),
                (r.d_sigma - d_sigma).abs() / scale,
            ]
        });
    assert!(quantiles("hard pixels", errors).max <= 1e-12);
}

#[test]
fn hard_gamma_gamma_densities_are_exact_to_1e_10() {
    let rows = table(
        include_str!("reference/hard_gamma_gamma.csv"),
        ["alpha", "beta", "rho", "ln_density"],
    );
    // Where f is below 1e-300 an ulp of ln f is already 1e-13 of f; there the error is relative to ln f.
    let errors = rows.into_iter().map(|[alpha, beta, rho, exact]| {
        let error = GammaGamma { alpha, beta }.ln_density(rho) - exact;
        error.abs() / (exact.abs() / 700.0).max(1.0)
    });
    assert!(quantiles("hard Gamma-Gamma densities", errors).max <= 1e-10);
}

#[test]
fn response_and_fraction_are_the_same_number() {
    for [lo, hi, c, s, ..] in pixels() {
        assert_eq!(
            psf::pixel_response(lo, hi, c, s).fraction,
            psf::pixel_fraction(lo, hi, c, s)
        );
    }
}

#[test]
fn gamma_gamma_density_is_exact_to_1e_10() {
    let rows = table(
        include_str!("reference/gamma_gamma.csv"),
        ["alpha", "beta", "rho", "ln_density"],
    );
    // An error of ln f is the relative error of f; where f underflows ln f still counts.
    let errors = rows.iter().map(|&[alpha, beta, rho, exact]| {
        let error = GammaGamma { alpha, beta }.ln_density(rho) - exact;
        error.abs() / exact.abs().max(1.0)
    });
    assert!(quantiles("Gamma-Gamma ln density", errors).max <= 1e-13);
    let errors = rows
        .iter()
        .filter(|row| row[3] > -700.0)
        .map(|&[alpha, beta, rho, exact]| f64::exp_m1(GammaGamma { alpha, beta }.ln_density(rho) - exact).abs());
    assert!(quantiles("Gamma-Gamma density", errors).max <= 1e-10);
}

#[test]
fn gamma_gamma_moments_are_exact_to_1e_12() {
    let rows = table(
        include_str!("reference/moment.csv"),
        ["alpha", "beta", "order", "moment"],
    );
    let errors = rows
        .into_iter()
        .map(|[alpha, beta, order, exact]| relative(GammaGamma { alpha, beta }.moment(order), exact));
    assert!(quantiles("Gamma-Gamma moments", errors).max <= 1e-12);
}

#[test]
fn gamma_gamma_density_integrates_to_its_moments() {
    // In u = ln ρ the integrand is smooth and falls off exponentially at both ends, so the trapezoidal rule is exact to rounding.
    for (alpha, beta) in [(4.0, 2.0), (0.6, 40.0), (150.0, 150.0)] {
        let law = GammaGamma { alpha, beta };
        let step = 0.01;
        let integral = |k: f64| -> f64 {
            (-9000..1000)
                .map(|i| {
                    let u = step * f64::from(i);
                    (law.ln_density(u.exp()) + (k + 1.0) * u).exp() * step
                })
                .sum()
        };
        assert!((integral(0.0) - 1.0).abs() < 1e-11, "{law:?}: {}", integral(0.0));
        assert!((integral(1.0) - 1.0).abs() < 1e-11, "{law:?}: {}", integral(1.0));
        let second = 1.0 + law.scintillation_index();
        assert!(
            (integral(2.0) - second).abs() < 1e-11 * second,
            "{law:?}: {}",
            integral(2.0)
        );
    }
}

#[test]
fn turbulence_parameters_are_exact_to_1e_13() {
    let rows = table(
        include_str!("reference/rytov.csv"),
        [
            "cn2",
            "wavelength_m",
            "length_m",
            "spherical",
            "variance",
            "alpha",
            "beta",
        ],
    );
    let errors = rows
        .into_iter()
        .flat_map(|[cn2, wavelength, length, spherical, variance, alpha, beta]| {
            let wave = if spherical == 1.0 { Wave::Spherical } else { Wave::Plane };
            let computed = rytov_variance(cn2, wavelength, length);
            let law = GammaGamma::from_rytov(computed, wave);
            [
                relative(computed, variance),
                relative(law.alpha, alpha),
                relative(law.beta, beta),
            ]
        });
    assert!(quantiles("Rytov variance, alpha, beta", errors).max <= 1e-13);
}

#[test]
fn aperture_fraction_is_exact_to_1e_12() {
    let rows = table(
        include_str!("reference/aperture.csv"),
        ["lens_radius_m", "beam_radius_m", "offset_m", "fraction"],
    );
    let errors = rows
        .into_iter()
        .map(|[lens, beam, offset, exact]| relative(radiometry::aperture_fraction(lens, beam, offset), exact));
    assert!(quantiles("aperture fraction", errors).max <= 1e-12);
}

#[test]
fn pixels_of_an_uncropped_spot_add_up_to_the_collected_energy() {
    // 10σ of margin leaves 2e-23 outside; the rest is rounding of the n additions.
    for (n, sigma) in [(1, 1e-3), (10, 1e-3), (64, 5e-4), (100, 1e-5), (300, 1.4e-3)] {
        let axis = Axis::centred(n, 0.03);
        let mut row = vec![0.0; n];
        let mut column = vec![0.0; n];
        for centre in [0.0, 1e-4, -3.21e-4] {
            psf::profile(&axis, centre, sigma, &mut row);
            psf::profile(&axis, -0.5 * centre, sigma, &mut column);
            let energy = 0.0123;
            let sum: f64 = row
                .iter()
                .flat_map(|x| column.iter().map(move |y| energy * x * y))
                .sum();
            assert!(relative(sum, energy) < 1e-15 * n as f64 + 1e-14, "{n} {sigma}: {sum}");
        }
    }
}
