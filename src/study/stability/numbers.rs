//! Formulas at the limits of their ranges, and difficult assignments.

use super::{Case, Observed};
use crate::assign::assign;
use crate::optics::fading::{GammaGamma, Wave, rytov_variance};
use crate::optics::{geometry, psf, radiometry};

pub(super) fn cases() -> Vec<Case> {
    vec![
        far_pixels(),
        narrow_pixels(),
        densities(),
        turbulence(),
        apertures(),
        grazing(),
        ties(),
        huge_costs(),
        empty_sides(),
        greedy_trap(),
    ]
}

fn observed(bad: &[String], tried: usize) -> Observed {
    Observed {
        happened: match bad.first() {
            None => format!("{tried} tried, all as required"),
            Some(first) => format!("{} of {tried} not, the first: {first}", bad.len()),
        },
        holds: bad.is_empty(),
        fit: None,
    }
}

const OPTICS: &str = "Optics";

fn far_pixels() -> Case {
    Case::new(
        OPTICS,
        "pixels up to 1e300 σ away",
        "tails underflow, squares overflow",
        "ΔΦ in [0, 1], derivatives finite, ΔΦ falls with distance",
        |_| {
            let (mut bad, mut tried) = (Vec::new(), 0);
            for width in [1e-300, 1e-12, 1.0, 1e12, 1e300] {
                let mut last = f64::INFINITY;
                for out in [0.0, 1e-300, 1e-9, 1.0, 10.0, 37.0, 38.5, 40.0, 1e3, 1e154, 1e300] {
                    let r = psf::pixel_response(out, out + width, 0.0, 1.0);
                    // A pixel too narrow to change the number of its edge has no width.
                    let width = (out + width) - out;
                    let is_sound = (0.0..=1.0).contains(&r.fraction) && r.d_centre.is_finite() && r.d_sigma.is_finite();
                    let is_falling = r.fraction <= last || width == 0.0 || out <= 1e-9;
                    if !(is_sound && is_falling) {
                        bad.push(format!("{out} σ out, {width} σ wide: {r:?}"));
                    }
                    if width > 0.0 {
                        last = r.fraction;
                    }
                    tried += 1;
                }
            }
            observed(&bad, tried)
        },
    )
}

fn narrow_pixels() -> Case {
    Case::new(
        OPTICS,
        "10⁵ pixels of 1e-4 σ",
        "a difference of two nearly equal integrals each",
        "their sum is the whole to 1e-13",
        |_| {
            let n = 100_000;
            let sum: f64 = (0..n)
                .map(|k| {
                    let edge = |k: i32| f64::from(k) * 1e-4 - 5.0;
                    psf::pixel_fraction(edge(k), edge(k + 1), 0.0, 1.0)
                })
                .sum();
            let whole = psf::pixel_fraction(-5.0, 5.0, 0.0, 1.0);
            let error = (sum / whole - 1.0).abs();
            Observed {
                happened: format!("off by {error:.1e}"),
                holds: error <= 1e-13,
                fit: None,
            }
        },
    )
}

fn densities() -> Case {
    Case::new(
        OPTICS,
        "Gamma–Gamma density, α and β from 0.05 to 1e4",
        "Γ(1e4) and K₁₀₀₀₀ overflow; β < 1 has a pole at 0",
        "never NaN; integrates to 1 within 1e-10",
        |_| {
            let shapes = [0.05, 0.3, 4.0, 60.0, 1e4];
            let (mut bad, mut tried) = (Vec::new(), 0);
            for alpha in shapes {
                for beta in shapes {
                    let law = GammaGamma { alpha, beta };
                    for rho in [0.0, 5e-324, 1e-300, 1e-9, 1.0, 1e3, 1e300, f64::INFINITY] {
                        tried += 1;
                        if law.ln_density(rho).is_nan() || law.ln_density(rho) == f64::INFINITY && rho > 0.0 {
                            bad.push(format!("{law:?} at {rho}: {}", law.ln_density(rho)));
                        }
                    }
                    // Over u = ln ρ the integrand is bell-shaped about 0 and falls as exp(min(α, β)·u) to the left.
                    let spread = (1.0 / alpha + 1.0 / beta).sqrt();
                    let step = 0.25 * spread.min(1.0);
                    let left = 10.0 * spread + 30.0 / alpha.min(beta);
                    let right = 10.0 * spread + 6.0;
                    let n = ((left + right) / step) as usize;
                    let integral: f64 = (0..n)
                        .map(|k| {
                            let u = k as f64 * step - left;
                            (law.ln_density(u.exp()) + u).exp() * step
                        })
                        .sum();
                    tried += 1;
                    if (integral - 1.0).abs() > 1e-10 {
                        bad.push(format!("{law:?} integrates to 1 + {:e}", integral - 1.0));
                    }
                }
            }
            observed(&bad, tried)
        },
    )
}

fn turbulence() -> Case {
    Case::new(
        OPTICS,
        "turbulence from none to absurd",
        "α and β run to ∞ as it vanishes, and again as it saturates",
        "α, β > 0, scintillation index ≥ 0, never NaN",
        |_| {
            let (mut bad, mut tried) = (Vec::new(), 0);
            for cn2 in [0.0, 1e-300, 1e-17, 1e-13, 1e-6, 1e100] {
                for wave in [Wave::Plane, Wave::Spherical] {
                    let law = GammaGamma::from_rytov(rytov_variance(cn2, 1.55e-6, 500.0), wave);
                    tried += 1;
                    if !(law.alpha > 0.0 && law.beta > 0.0 && law.scintillation_index() >= 0.0) {
                        bad.push(format!("C_n² = {cn2:e}, {wave:?}: {law:?}"));
                    }
                }
            }
            observed(&bad, tried)
        },
    )
}

fn apertures() -> Case {
    Case::new(
        OPTICS,
        "lens and beam from 1e-3 to 1e3 of each other, any offset",
        "Marcum's function at both its ends",
        "a fraction in [0, 1] that falls with the offset and grows with the lens",
        |_| {
            let ratios = [1e-3, 0.1, 1.0, 10.0, 1e3];
            let offsets = [0.0, 1e-9, 0.5, 1.0, 9.0, 11.0, 990.0, 1010.0, 1e9];
            let (mut bad, mut tried) = (Vec::new(), 0);
            // Rounding in sums of up to 10⁴ terms.
            let slack = 1e-12;
            for (i, lens) in ratios.into_iter().enumerate() {
                for (j, offset) in offsets.into_iter().enumerate() {
                    let f = |lens, offset| radiometry::aperture_fraction(lens, 1.0, offset);
                    let here = f(lens, offset);
                    tried += 1;
                    let is_fraction = (0.0..=1.0).contains(&here);
                    let falls = j == 0 || here <= f(lens, offsets[j - 1]) * (1.0 + slack);
                    let grows = i == 0 || here >= f(ratios[i - 1], offset) * (1.0 - slack);
                    if !(is_fraction && falls && grows) {
                        bad.push(format!("r_a = {lens} w_z, offset {offset} w_z: {here}"));
                    }
                }
            }
            observed(&bad, tried)
        },
    )
}

fn grazing() -> Case {
    Case::new(
        OPTICS,
        "emitters out to 1e300 m",
        "tan θ runs to ∞; squares overflow",
        "length and incidence finite; angles within ±π/2; the way back is the way there while 1 + tan²θ leaves digits",
        |_| {
            let (mut bad, mut tried) = (Vec::new(), 0);
            for p in [0.0, 1e-300, 1.0, 1e3, 1e6, 1e9, 1e154, 1e300] {
                for h in [1e-3, 300.0, 1e7] {
                    let length = geometry::link_length(h, [p, p]);
                    let cos = geometry::incidence_cos(h, [p, p]);
                    let angles = geometry::angles_from_ground(h, [p, -p]);
                    let back = geometry::ground_from_angles(h, angles)[0];
                    let allowed = 8.0 * f64::EPSILON * (1.0 + p / h);
                    let returns = allowed > 0.1 || (back - p).abs() <= allowed * p;
                    let is_sound =
                        length.is_finite() && (0.0..=1.0).contains(&cos) && angles[0] <= std::f64::consts::FRAC_PI_2;
                    tried += 1;
                    if !(is_sound && returns) {
                        bad.push(format!("{p} m at {h} m: L {length}, cos {cos}, back {back}"));
                    }
                }
            }
            observed(&bad, tried)
        },
    )
}

const ASSIGNMENT: &str = "Assignment";

fn ties() -> Case {
    Case::new(
        ASSIGNMENT,
        "all costs equal, 40 × 60",
        "every assignment is optimal",
        "40 pairs, the same ones every time",
        |_| {
            let once = || assign(40, 60, 1.0, |_, _| 0.5);
            Observed {
                happened: format!("{} pairs", once().pairs.len()),
                holds: once().pairs.len() == 40 && once() == once(),
                fit: None,
            }
        },
    )
}

fn huge_costs() -> Case {
    Case::new(
        ASSIGNMENT,
        "costs from 1e-300 to 1e300, NaN, ∞, negative",
        "a solver in integers overflows; one in floats never ends",
        "ends; keeps no pair at or above the penalty, nor one that is no number",
        |_| {
            let value = |i: usize, j: usize| match (i * 7 + j * 3) % 9 {
                0 => f64::NAN,
                1 => f64::INFINITY,
                2 => f64::NEG_INFINITY,
                3 => -1.0,
                4 => 1e300,
                5 => 1e-300,
                k => k as f64,
            };
            let (mut bad, mut tried) = (Vec::new(), 0);
            for c_max in [f64::MIN_POSITIVE, 1e-9, 1.0, 7.5, 1e300] {
                let m = assign(12, 9, c_max, value);
                tried += 1;
                let is_whole =
                    m.pairs.len() + m.unmatched_rows.len() == 12 && m.pairs.len() + m.unmatched_columns.len() == 9;
                if !is_whole || m.pairs.iter().any(|&(i, j)| !(value(i, j) < c_max)) {
                    bad.push(format!("penalty {c_max:e}: {m:?}"));
                }
            }
            observed(&bad, tried)
        },
    )
}

fn empty_sides() -> Case {
    Case::new(
        ASSIGNMENT,
        "0 × 5, 5 × 0, 0 × 0",
        "nothing to match",
        "everybody is left alone",
        |_| {
            let alone = |r, c| {
                let m = assign(r, c, 1.0, |_, _| 0.0);
                m.pairs.is_empty() && m.unmatched_rows.len() == r && m.unmatched_columns.len() == c
            };
            Observed {
                happened: "tried".to_owned(),
                holds: alone(0, 5) && alone(5, 0) && alone(0, 0),
                fit: None,
            }
        },
    )
}

/// Costs (i + 1)(j + 1) make the nearest-first choice as bad as it can be.
fn greedy_trap() -> Case {
    Case::new(
        ASSIGNMENT,
        "Machol–Wien costs (i + 1)(j + 1), 60 × 60",
        "the hardest known instance for the Hungarian method: the longest augmenting paths",
        "the anti-diagonal, which is optimal",
        |_| {
            let m = assign(60, 60, 1e4, |i, j| ((i + 1) * (j + 1)) as f64);
            let cost: usize = m.pairs.iter().map(|&(i, j)| (i + 1) * (j + 1)).sum();
            let best: usize = (1..=60).map(|i| i * (61 - i)).sum();
            Observed {
                happened: format!("{} pairs, cost {cost}, optimum {best}", m.pairs.len()),
                holds: m.pairs.len() == 60 && cost == best,
                fit: None,
            }
        },
    )
}
