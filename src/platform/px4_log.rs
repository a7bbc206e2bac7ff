//! Poses from a flight log of PX4: the attitudes, with the place interpolated to their times.

use nalgebra::{Matrix6, UnitQuaternion};

use super::place::{Origin, Place, SeaLevelPlace};
use crate::pose::{PoseSigmas, attitude_of};
use crate::ulog::{self, Log};

/// Places this far apart in time are not interpolated between, s: PX4 logs ten a second, where memory is short one.
const LONGEST_GAP_S: f64 = 2.0;
/// Standard deviations beyond this, m, say that the filter has no position.
const LARGEST_SIGMA_M: f64 = 50.0;

/// A pose of a log.
#[derive(Clone, Debug, PartialEq)]
pub struct LoggedPose {
    /// Since the autopilot started, µs.
    pub time_us: u64,
    pub attitude: UnitQuaternion<f64>,
    pub place: Place,
    /// As in [`crate::pose::Pose`].
    pub cov: Matrix6<f64>,
}

/// The poses of a log in the order of their times. Attitudes that are no rotation and those without a place are left out; `sigmas`
/// hold where the log states none.
pub fn poses(log: &Log, sigmas: PoseSigmas) -> Vec<LoggedPose> {
    let mut places: Vec<_> = log.places.iter().filter(|p| is_known(p)).collect();
    places.sort_by_key(|p| p.time_us);
    let mut attitudes: Vec<_> = log.attitudes.iter().collect();
    attitudes.sort_by_key(|a| a.time_us);
    attitudes.dedup_by_key(|a| a.time_us);
    let found = attitudes.into_iter().filter_map(|a| {
        let next = places.partition_point(|p| p.time_us < a.time_us);
        let after = *places.get(next)?;
        let before = if after.time_us == a.time_us {
            after
        } else {
            *places.get(next.checked_sub(1)?)?
        };
        let gap_s = (after.time_us - before.time_us) as f64 * 1e-6;
        if gap_s > LONGEST_GAP_S {
            return None;
        }
        let since_s = (a.time_us - before.time_us) as f64 * 1e-6;
        let share = if gap_s > 0.0 { since_s / gap_s } else { 0.0 };
        Some(LoggedPose {
            time_us: a.time_us,
            attitude: attitude_of(a.q).ok()?,
            place: between(before, after, share, log.undulation_m),
            cov: cov(before, sigmas),
        })
    });
    found.collect()
}

fn is_known(place: &ulog::Place) -> bool {
    // NaN: the log does not state it.
    place.ned_m.iter().all(|v| v.is_finite()) && !(place.sigma_m[0] > LARGEST_SIGMA_M)
}

fn between(a: &ulog::Place, b: &ulog::Place, share: f64, undulation_m: Option<f64>) -> Place {
    // A moved reference, or one place by latitude and longitude after another: their numbers are not mixed.
    let (a, b) = if a.reference == b.reference { (a, b) } else { (a, a) };
    let [north, east, down] = [0, 1, 2].map(|k| a.ned_m[k] + (b.ned_m[k] - a.ned_m[k]) * share);
    let [latitude_deg, longitude_deg, sea_level_m] = a.reference;
    let at = SeaLevelPlace {
        latitude_deg,
        longitude_deg,
        sea_level_m,
    };
    let is_known = a.reference.iter().all(|v| v.is_finite());
    Place {
        origin: match a.axes {
            _ if !is_known => Origin::Unknown,
            ulog::Axes::Local => Origin::Start(at),
            ulog::Axes::None => Origin::Passing(at),
        },
        enu_m: [east, north, -down],
        undulation_m,
    }
}

fn cov(place: &ulog::Place, sigmas: PoseSigmas) -> Matrix6<f64> {
    let mut cov = sigmas.cov();
    let [horizontal, vertical] = place.sigma_m;
    for (k, sigma) in [(3, horizontal), (4, horizontal), (5, vertical)] {
        if sigma > 0.0 && sigma <= LARGEST_SIGMA_M {
            cov[(k, k)] = sigma * sigma;
        }
    }
    cov
}
