//! The emitters' motion: who has left their straight course, and what is reported of velocities.

use nalgebra::{DMatrix, DVector, Matrix2, Vector2};

use crate::estimate::emitter::Velocity;
use crate::estimate::sequence::course::SPEED_STD_M_S;
use crate::estimate::sequence::joint_information::{JointInformation, STATE};
use crate::estimate::sequence::window::Window;
use crate::optics::Camera;

/// Standard deviations of a speed along an axis, m/s, that emitters of a scene may have: all stand still, walk, cycle, drive.
const SPEEDS_M_S: [f64; 4] = [0.01, 0.7, 2.5, SPEED_STD_M_S];
/// Relative rounding of a difference of covariances.
const ROUNDING: f64 = 1e-8;
/// A hypothesis of less weight is left out.
const LEAST_WEIGHT: f64 = 1e-3;

/// Positions and velocities with their covariance.
pub(crate) struct Posterior {
    pub state: DVector<f64>,
    pub covariance: DMatrix<f64>,
}

/// The posterior of `total` over hypotheses of how fast the emitters of a scene are, each weighed by its evidence: people who all stand still
/// cost no information for velocities that are not there, and people who walk are not held back. Without `has_speeds` any speed is as likely.
/// `unit` is 1 m/s in σ/s. `None` where the information is singular.
pub(crate) fn posterior(total: &JointInformation, unit: f64, has_speeds: bool) -> Option<Posterior> {
    let n = total.len();
    if n == 0 {
        return None;
    }
    let covariance = total.covariance()?;
    let state = &total.at + &covariance * &total.gradient;
    let velocity = |k: usize| STATE * (k / 2) + 2 + k % 2;
    let speeds = DVector::from_fn(2 * n, |k, _| state[velocity(k)]);
    let errors = DMatrix::from_fn(2 * n, 2 * n, |r, c| covariance[(velocity(r), velocity(c))]);
    if !has_speeds {
        return Some(Posterior { state, covariance });
    }
    // −2 ln of the velocities' probability where they are N(0, variance) and measured with these errors.
    let cost = |speed: f64| -> Option<f64> {
        let mut sum = errors.clone();
        for k in 0..2 * n {
            sum[(k, k)] += (speed * unit).powi(2);
        }
        let factor = sum.cholesky()?;
        let spread: f64 = factor.l_dirty().diagonal().iter().map(|d| 2.0 * d.ln()).sum();
        Some(spread + speeds.dot(&factor.solve(&speeds)))
    };
    let costs = SPEEDS_M_S.map(|s| cost(s).unwrap_or(f64::INFINITY));
    let best = costs.into_iter().fold(f64::INFINITY, f64::min);
    let weights = costs.map(|c| (0.5 * (best - c)).exp());
    let sum: f64 = weights.iter().filter(|w| **w > LEAST_WEIGHT).sum();
    let mut mean = DVector::zeros(STATE * n);
    let mut second = DMatrix::zeros(STATE * n, STATE * n);
    for (speed, weight) in SPEEDS_M_S.into_iter().zip(weights).filter(|(_, w)| *w > LEAST_WEIGHT) {
        let of = held(total, speed * unit)?;
        // Relative to the unrestrained state, against rounding.
        let shift = &of.state - &state;
        mean += weight / sum * &shift;
        second += weight / sum * (of.covariance + &shift * shift.transpose());
    }
    Some(Posterior {
        covariance: second - &mean * mean.transpose(),
        state: state + mean,
    })
}

/// The posterior with velocities of standard deviation `speed`.
fn held(total: &JointInformation, speed: f64) -> Option<Posterior> {
    let mut held = total.clone();
    let precision = 1.0 / (speed * speed);
    for e in 0..total.len() {
        for i in [STATE * e + 2, STATE * e + 3] {
            held.information[(i, i)] += precision;
            held.gradient[i] -= held.at[i] * precision;
        }
    }
    let covariance = held.covariance()?;
    let state = &held.at + &covariance * &held.gradient;
    Some(Posterior { state, covariance })
}

/// Velocity on the ground of one on the sensor, m/s, at `sensor_m`.
pub(crate) fn velocity_on_ground(camera: &Camera, sensor_m: [f64; 2], velocity: [f64; 2]) -> Velocity {
    /// Time over which the difference quotient is taken, s: a walker's place on the sensor moves by 10⁻⁷ m.
    const DT: f64 = 1e-3;
    let ahead = camera.to_ground([0, 1].map(|k| sensor_m[k] + 0.5 * DT * velocity[k]));
    let behind = camera.to_ground([0, 1].map(|k| sensor_m[k] - 0.5 * DT * velocity[k]));
    Velocity {
        vx_m_s: (ahead[0] - behind[0]) / DT,
        vy_m_s: (ahead[1] - behind[1]) / DT,
    }
}

/// The targets of the fitted newest frame that it or the frames before show elsewhere than straight on from what was `known` before. The
/// covariance of a change of position is what the covariance falls by (Kalman, 1960), and successive changes are independent. What all change
/// alike is the pose's. `unit` is 1 m/s in σ/s.
pub(crate) fn surprised(known: &JointInformation, fresh: &mut Window, unit: f64) -> Vec<usize> {
    let of = |knowledge: &JointInformation| {
        let covariance = knowledge.covariance()?;
        Some((&knowledge.at + &covariance * &knowledge.gradient, covariance))
    };
    let (Some((before, prior)), Some((state, posterior))) = (of(known), of(&fresh.total)) else {
        return Vec::new();
    };
    let present = fresh.present(fresh.time_s);
    let n = 2 * present.len();
    let place = |k: usize| STATE * present[k / 2] + k % 2;
    let mut change = DVector::from_fn(n, |k, _| state[place(k)] - before[place(k)]);
    let mut now = DMatrix::from_fn(n, n, |r, c| posterior[(place(r), place(c))]);
    let mut errors = DMatrix::from_fn(n, n, |r, c| prior[(place(r), place(c))] - now[(r, c)]);
    for k in 0..n {
        errors[(k, k)] = errors[(k, k)].max(0.0) + ROUNDING * prior[(place(k), place(k))];
    }
    let newest = fresh.snapshots.last();
    if let Some(outlook) = newest.and_then(|s| s.outlook.as_ref()) {
        let shared = outlook.shared(&fresh.places(&fresh.state, fresh.time_s));
        take_out(&shared, &mut now, &mut DVector::zeros(n));
        take_out(&shared, &mut errors, &mut change);
    }
    let mut is_surprised = |i: usize, e: usize| {
        let block = |m: &DMatrix<f64>| Matrix2::from_fn(|k, l| m[(2 * i + k, 2 * i + l)]);
        let Some(std) = block(&errors).cholesky().map(|c| c.l()) else {
            return false;
        };
        let own = block(&now);
        let Some(normalised) = std.solve_lower_triangular(&Vector2::new(change[2 * i], change[2 * i + 1])) else {
            return false;
        };
        // What the frame adds to what was known.
        let alone = [0, 1].map(|k| {
            let at = 2 * i + k;
            let weight = (own[(k, k)] + errors[(at, at)]) / errors[(at, at)];
            (before[place(at)] + weight * change[at], weight * own[(k, k)])
        });
        let straying = &mut fresh.targets[e].straying;
        straying.see(alone.map(|a| a.0), alone.map(|a| a.1), fresh.time_s, unit);
        straying.add(normalised, 0.5 * own.trace())
    };
    let shown = present.iter().enumerate().filter(|(i, e)| is_surprised(*i, **e));
    shown.map(|(_, e)| *e).collect()
}

/// Takes what the columns of `shared` span out of `change` and its covariance `cov`: what is left where that much is common to all.
pub(crate) fn take_out(shared: &DMatrix<f64>, cov: &mut DMatrix<f64>, change: &mut DVector<f64>) {
    let Some(factor) = cov.clone().cholesky() else { return };
    let weighted = factor.solve(shared);
    let mut information = shared.tr_mul(&weighted);
    for k in 0..information.nrows() {
        information[(k, k)] *= 1.0 + ROUNDING;
    }
    let Some(inverse) = information.cholesky() else { return };
    let fitted = inverse.solve(&weighted.tr_mul(change));
    *change -= shared * fitted;
    *cov -= shared * inverse.solve(&shared.transpose());
    // Nothing is left of few emitters.
    for k in 0..cov.nrows() {
        cov[(k, k)] = cov[(k, k)].max(0.0);
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{DMatrix, DVector};

    use super::take_out;

    #[test]
    fn what_all_change_alike_is_nobody_s_own_change() {
        let shared = DMatrix::from_column_slice(6, 2, &[1.0, 0.0, 1.0, 0.0, 1.0, 0.0, 0.0, 1.0, 0.0, 1.0, 0.0, 1.0]);
        let mut cov = DMatrix::identity(6, 6) * 0.01;
        let mut change = DVector::from_column_slice(&[5.0, -3.0, 5.0, -3.0, 5.3, -3.0]);
        take_out(&shared, &mut cov, &mut change);
        let expected = DVector::from_column_slice(&[-0.1, 0.0, -0.1, 0.0, 0.2, 0.0]);
        assert!((&change - expected).amax() < 1e-4, "{change}");
        assert!((cov[(0, 0)] - 0.01 * 2.0 / 3.0).abs() < 1e-6, "{cov}");
    }
}
