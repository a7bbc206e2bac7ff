//! Users above the ground: each access point sees them where its own ray meets the ground, all of them at the height that they claim.

use nalgebra::Vector3;

use crate::claim::Claim;
use crate::geo::LocalAxes;
use crate::monitor::{PositionStatus, TrackedPosition};

/// The beam of a user who is at a height above the ground by a claim that it answers, where its ray to the lens, m, is as high; any other as it is.
/// A claim moves it along its ray alone, which no single access point can tell from the truth.
pub fn at_claimed_height(mut beam: TrackedPosition, claims: &[&Claim], lens_m: [f64; 3]) -> TrackedPosition {
    let is_theirs = |claim: &&&Claim| beam.user.as_ref() == Some(&claim.user);
    let height_m = claims.iter().find(is_theirs).and_then(|claim| claim.z_m);
    let Some(z_m) = height_m.filter(|_| beam.status == PositionStatus::Verified) else {
        return beam;
    };
    let way = Vector3::from(lens_m) - Vector3::new(beam.x_m, beam.y_m, beam.z_m);
    let share = (z_m - beam.z_m) / way.z;
    if !(0.0..1.0).contains(&share) {
        return beam;
    }
    let shift = way * share;
    beam.geodetic = beam.geodetic.map(|here| LocalAxes::at(here).to_geodetic(shift.into()));
    (beam.x_m, beam.y_m, beam.z_m) = (beam.x_m + shift.x, beam.y_m + shift.y, z_m);
    beam.cov_m2 = beam.cov_m2.map(|row| row.map(|c| c * (1.0 - share).powi(2)));
    beam
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    const ROOF: [f64; 3] = [40.0, -20.0, 30.0];

    /// Where a lens sees the beam of a user on the roof meet the ground, of a variance of 1 m² there, as the fleet is told.
    fn told(lens_m: [f64; 3], status: PositionStatus, claimed_z_m: Option<f64>) -> TrackedPosition {
        let [x, y] = [0, 1].map(|k| lens_m[k] + (ROOF[k] - lens_m[k]) * lens_m[2] / (lens_m[2] - ROOF[2]));
        let beam = json!({ "track": 1, "x_m": x, "y_m": y, "cov_m2": [[1.0, 0.0], [0.0, 1.0]], "energy_j": 0.01,
                           "user": "u", "status": status, "flags": [] });
        let claim: Claim = serde_json::from_value(
            json!({ "time": "2026-01-01T00:00:00Z", "user": "u", "x_m": 40.0, "y_m": -20.0, "z_m": claimed_z_m }),
        )
        .unwrap();
        at_claimed_height(serde_json::from_value(beam).unwrap(), &[&claim], lens_m)
    }

    #[test]
    fn two_access_points_see_a_user_on_a_roof_at_one_place() {
        for lens_m in [[0.0, 0.0, 300.0], [150.0, 80.0, 200.0]] {
            let told = told(lens_m, PositionStatus::Verified, Some(ROOF[2]));
            let off = Vector3::new(told.x_m, told.y_m, told.z_m) - Vector3::from(ROOF);
            assert!(off.norm() < 1e-9, "{told:?}");
            let share = 1.0 - ROOF[2] / lens_m[2];
            assert!((told.cov_m2[0][0] - share * share).abs() < 1e-12, "{told:?}");
        }
    }

    #[test]
    fn a_beam_that_answers_no_claim_of_a_height_stays_on_the_ground() {
        let lens_m = [0.0, 0.0, 300.0];
        for (status, z_m) in [
            (PositionStatus::Verified, None),
            (PositionStatus::Verified, Some(300.0)),
            (PositionStatus::Mismatch, Some(30.0)),
        ] {
            assert!((told(lens_m, status, z_m).x_m - 40.0 / 0.9).abs() < 1e-9);
        }
    }
}
