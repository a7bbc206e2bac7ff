//! Spot shapes that are not Gaussian: defocus and coma.

use serde::{Deserialize, Serialize};

use super::table::Table;
use crate::scene::render::Spot;
use crate::toml_file::{Key, OutOfRange};

/// A spot that is not Gaussian: the rays of a spot diagram, each blurred by the remainder of σ_eff, which is due to diffraction and
/// the sensor. Geometric optics, so valid where the aberration is wider than the diffraction.
///
/// A ray through the pupil at (ρ, φ), ρ ≤ 1, lands beside the centre (Born and Wolf, Principles of Optics, 1999, section 5.3)
/// - through defocus by R·ρ·(cos φ, sin φ), a disc of radius R = 2σ_eff·√share, whose variance per axis, R²/4 = d²/16 with its
///   diameter d, is `share` of σ_eff²: the disc that the estimator takes for part of its Gaussian;
/// - through coma by C·ρ²·(2 + cos 2φ, sin 2φ) − (C, 0), the first axis pointing away from the array's centre, C growing in
///   proportion to the distance from there. The mean, (C, 0), is removed: it belongs to the distortion.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Aberrations {
    /// Share of σ_eff² that is a disc of even light.
    pub defocus_share: f64,
    /// C at the sensor's corner; the comet is 3C long and 2C wide.
    pub coma_m: f64,
}

/// The rays of one spot.
#[derive(Debug)]
pub(in crate::scene) struct Rays {
    /// Rings over the pupil.
    pupil: Vec<Ray>,
    /// R/σ_eff.
    disc: f64,
    /// What is left of σ_eff around each ray, over σ_eff.
    rest: f64,
    coma_m: f64,
}

#[derive(Debug)]
struct Ray {
    /// ρ·(cos φ, sin φ).
    at: [f64; 2],
    /// Of the light.
    share: f64,
}

/// Rings, and the rays of a ring, are at most this many blurs apart: the spot is then good to a hundredth of its peak.
const SPACING: [f64; 2] = [0.35, 0.7];

impl Aberrations {
    pub(in crate::scene) fn rays(&self, sigma_m: f64) -> Rays {
        let (disc, rest) = (2.0 * self.defocus_share.sqrt(), (1.0 - self.defocus_share).sqrt());
        // The pupil's image is at most this many blurs in radius.
        let radius = (disc + 2.0 * self.coma_m / sigma_m) / rest;
        let rings = (radius / SPACING[0]).ceil().clamp(8.0, 64.0) as usize;
        let mut pupil = Vec::new();
        for ring in 0..rings {
            // The mean of ρ² over the ring, so that the variance comes out exactly.
            let inner2 = ((ring * ring) as f64) / ((rings * rings) as f64);
            let outer2 = (((ring + 1) * (ring + 1)) as f64) / ((rings * rings) as f64);
            let rho = (0.5 * (inner2 + outer2)).sqrt();
            let around = ((std::f64::consts::TAU * rho * radius / SPACING[1]).ceil() as usize).max(6);
            pupil.extend((0..around).map(|k| {
                let (sin, cos) = (std::f64::consts::TAU * k as f64 / around as f64).sin_cos();
                Ray {
                    at: [rho * cos, rho * sin],
                    share: (outer2 - inner2) / around as f64,
                }
            }));
        }
        Rays {
            pupil,
            disc,
            rest,
            coma_m: self.coma_m,
        }
    }
}

impl Rays {
    pub fn count(&self) -> usize {
        self.pupil.len()
    }

    /// Pushes what becomes of a Gaussian spot. `field`: its centre, seen from the optical axis, over the half-diagonal.
    pub fn cast(&self, spot: &Spot, field: [f64; 2], out: &mut Vec<Spot>) {
        let distance = field[0].hypot(field[1]);
        let [c, s] = if distance > 0.0 {
            field.map(|v| v / distance)
        } else {
            [1.0, 0.0]
        };
        let coma = self.coma_m * distance;
        let disc = self.disc * spot.sigma_m;
        out.extend(self.pupil.iter().map(|ray| {
            let [p, q] = ray.at;
            // ρ²(2 + cos 2φ) = 3p² + q², ρ² sin 2φ = 2pq.
            let along = disc * p + coma * (3.0 * p * p + q * q - 1.0);
            let across = disc * q + coma * 2.0 * p * q;
            Spot {
                centre: [
                    spot.centre[0] + along * c - across * s,
                    spot.centre[1] + along * s + across * c,
                ],
                sigma_m: spot.sigma_m * self.rest,
                energy_j: spot.energy_j * ray.share,
            }
        }));
    }
}

impl Table for Aberrations {
    fn validate(&self, field: &Key) -> Result<(), OutOfRange> {
        field.at("coma_m").non_negative(self.coma_m)?;
        let share = field.at("defocus_share").non_negative(self.defocus_share)?;
        if share > 0.95 {
            return Err(field
                .at("defocus_share")
                .refuse("at most 0.95, so that no single ray shows", share));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn moments(aberrations: &Aberrations, field: [f64; 2]) -> ([f64; 2], [f64; 2]) {
        let spot = Spot {
            centre: [0.001, -0.002],
            sigma_m: 1e-3,
            energy_j: 2.0,
        };
        let mut rays = Vec::new();
        aberrations.rays(spot.sigma_m).cast(&spot, field, &mut rays);
        assert!((rays.iter().map(|r| r.energy_j).sum::<f64>() - 2.0).abs() < 1e-12);
        let mean = |f: &dyn Fn(&Spot) -> f64| rays.iter().map(|r| r.energy_j / 2.0 * f(r)).sum::<f64>();
        let offset = [0, 1].map(|k| mean(&|r| r.centre[k] - spot.centre[k]));
        let variance = [0, 1].map(|k| mean(&|r| (r.centre[k] - spot.centre[k]).powi(2) + r.sigma_m.powi(2)));
        (offset, variance)
    }

    #[test]
    fn a_disc_keeps_centre_and_variance() {
        for defocus_share in [0.1, 0.5, 0.9] {
            let disc = Aberrations {
                defocus_share,
                coma_m: 0.0,
            };
            let (offset, variance) = moments(&disc, [0.3, 0.4]);
            for k in 0..2 {
                assert!(offset[k].abs() < 1e-15, "{offset:?}");
                assert!((variance[k] / 1e-6 - 1.0).abs() < 1e-12, "{variance:?}");
            }
        }
    }

    #[test]
    fn coma_stretches_away_from_the_centre_and_leaves_the_centroid() {
        let coma = Aberrations {
            defocus_share: 0.0,
            coma_m: 1e-3,
        };
        let (offset, variance) = moments(&coma, [0.5, 0.0]);
        assert!(offset[0].hypot(offset[1]) < 1e-15, "{offset:?}");
        // ⟨(3p² + q² − 1)²⟩ = 1/2 and ⟨(2pq)²⟩ = 1/6 over the unit disc; C is half of that in the corner.
        let expected = [1e-6 + 0.25e-6 / 2.0, 1e-6 + 0.25e-6 / 6.0];
        for k in 0..2 {
            // Of ρ⁴ the rings take the middle.
            assert!(
                (variance[k] / expected[k] - 1.0).abs() < 0.01,
                "{variance:?} {expected:?}"
            );
        }
        let (_, upright) = moments(&coma, [0.0, 0.5]);
        assert!((upright[1] / variance[0] - 1.0).abs() < 1e-9);
    }

    /// The disc's profile, against ∫ over the disc of the Gaussian by a fine grid.
    #[test]
    fn rays_blur_into_one_disc() {
        let (share, sigma) = (0.9, 1.0);
        let mut rays = Vec::new();
        let spot = Spot {
            centre: [0.0; 2],
            sigma_m: sigma,
            energy_j: 1.0,
        };
        let disc = Aberrations {
            defocus_share: share,
            coma_m: 0.0,
        };
        disc.rays(sigma).cast(&spot, [0.0; 2], &mut rays);
        let (radius, rest) = (2.0 * f64::sqrt(share), f64::sqrt(1.0 - share));
        let gauss = |dx: f64, dy: f64| {
            libm::exp(-0.5 * (dx * dx + dy * dy) / (rest * rest)) / (std::f64::consts::TAU * rest * rest)
        };
        let step = 0.02;
        let fine: Vec<[f64; 2]> = (-100..=100)
            .flat_map(|i| (-100..=100).map(move |j| [f64::from(i) * step, f64::from(j) * step]))
            .filter(|[x, y]| x.hypot(*y) <= radius)
            .collect();
        for at in [[0.0, 0.0], [0.7, 0.4], [1.5, -0.6], [2.0, 0.3], [0.0, 2.6]] {
            let got: f64 = rays
                .iter()
                .map(|r| r.energy_j * gauss(at[0] - r.centre[0], at[1] - r.centre[1]))
                .sum();
            let exact = fine.iter().map(|c| gauss(at[0] - c[0], at[1] - c[1])).sum::<f64>() / fine.len() as f64;
            let peak = 1.0 / (std::f64::consts::PI * radius * radius);
            assert!((got - exact).abs() < 0.01 * peak, "{at:?}: {got} {exact}");
        }
    }
}
