//! How the ground moves over the sensor while the platform does: the smear of spots during an exposure.

use nalgebra::{Vector2, Vector6};

use super::sight::Sight;
use crate::optics::{Camera, Smear, light_std};

impl Sight {
    /// Motion of spots from the ground during `exposure_s`, where the pose changes by `rates` (rotation about north, east, down, rad/s;
    /// velocity east, north, up, m/s). A point of the ground moves against what the same place of the sensor sees: −(∂ground/∂sensor)⁻¹ ·
    /// ∂ground/∂pose · rates. `None` where the middle of the view is no ground.
    pub fn smear(&self, camera: &Camera, rates: &Vector6<f64>, exposure_s: f64) -> Option<Smear> {
        let displacement = |place_m: [f64; 2]| {
            let point = self.ground(camera, place_m)?;
            let by_ground = point.by_sensor.try_inverse()?;
            Some(-(by_ground * point.by_pose * rates) * exposure_s)
        };
        let centre = displacement([0.0; 2])?;
        // Across the half of the view, which is seen even where a corner is above the horizon: how displacements change, and bend, along a step.
        let across = |step: [f64; 2]| -> (Vector2<f64>, Vector2<f64>) {
            let ends = (displacement(step), displacement(step.map(|s| -s)));
            let length = step[0].hypot(step[1]);
            match ends {
                (Some(up), Some(down)) => (
                    (up - down) / (2.0 * length),
                    ((up + down) / 2.0 - centre) / (length * length),
                ),
                _ => Default::default(),
            }
        };
        let (along_x, bent_x) = across([0.5 * camera.x.half_width(), 0.0]);
        let (along_y, bent_y) = across([0.0, 0.5 * camera.y.half_width()]);
        Some(Smear {
            at_centre_m: centre.into(),
            by_place: [[along_x.x, along_y.x], [along_x.y, along_y.y]],
            by_square_per_m: [bent_x.x, bent_y.y],
            light_std: light_std(exposure_s),
        })
    }
}

#[cfg(test)]
mod tests {
    use jiff::Timestamp;
    use nalgebra::{Matrix6, UnitQuaternion};

    use super::*;
    use crate::pose::{Mount, Pose};

    #[test]
    fn a_smear_is_what_a_place_moves_by_between_the_ends_of_an_exposure() {
        let camera = crate::optics::Config::default().camera().unwrap();
        let pose = Pose {
            attitude: UnitQuaternion::from_euler_angles(0.06, -0.1, 2.1),
            ..Pose::level(Timestamp::UNIX_EPOCH, [40.0, -25.0, 280.0])
        };
        let mount = Mount {
            yaw_deg: 30.0,
            ..Mount::default()
        };
        let sight = Sight::new(&pose, &mount);
        let rates = Vector6::new(0.1, -0.15, 0.4, 6.0, -3.0, 1.0);
        let exposure_s = 0.05;
        let smear = sight.smear(&camera, &rates, exposure_s).expect("looks down");
        let half = [camera.x.half_width(), camera.y.half_width()];
        for share in [[0.0, 0.0], [0.7, -0.4], [-0.9, 0.9]] {
            let place = [share[0] * half[0], share[1] * half[1]];
            let ground = sight.ground(&camera, place).expect("looks down").position_m;
            let at = |s: f64| {
                let moved = sight.corrected(&(rates * s), Matrix6::zeros());
                Vector2::from(moved.sensor(&camera, ground.into()).expect("in front"))
            };
            let moved = at(0.5 * exposure_s) - at(-0.5 * exposure_s);
            let found = Vector2::from(smear.displacement_m(place));
            assert!(
                (found - moved).norm() < 0.002 * smear.longest_m(&camera),
                "{found} {moved}"
            );
        }
    }
}
