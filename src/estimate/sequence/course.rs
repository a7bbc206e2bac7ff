//! How emitters go on: their speeds, changes of velocity and accelerations.

use nalgebra::DMatrix;

use crate::estimate::sequence::joint_information::{JointInformation, STATE};

/// Standard deviation of a speed that is not known, m/s: cars in town. It only keeps the first frames' normal equations regular.
pub(crate) const SPEED_STD_M_S: f64 = 8.0;
/// Standard deviation of a change of velocity, m/s: a walker who turns round; a car changes its by as much within two seconds.
pub(crate) const MANOEUVRE_M_S: f64 = 3.0;

/// Adds to `knowledge` that these emitters may have changed their velocity about `since_s` seconds ago. `unit` is 1 m/s in σ/s. Returns what
/// this takes off −2 ln L.
pub(crate) fn open(knowledge: &mut JointInformation, who: &[usize], since_s: f64, unit: f64) -> f64 {
    let speed = (MANOEUVRE_M_S * unit).powi(2);
    let mut explained = 0.0;
    for &e in who {
        let at: Vec<usize> = (0..STATE).map(|k| STATE * e + k).collect();
        let noise = DMatrix::from_fn(STATE, STATE, |r, c| {
            let place = |k: usize| if k < 2 { since_s } else { 1.0 };
            let shared = if r % 2 == c % 2 {
                speed * place(r) * place(c)
            } else {
                0.0
            };
            // A fifth of the position's is its own: when the manoeuvre was is not known.
            if r == c { 1.2 * shared + 1e-12 } else { shared }
        });
        explained += knowledge.add_noise(&at, &noise);
    }
    explained
}

/// Covariance of a state, σ and s, `lag_s` after a time `dt` in which its acceleration had this density, σ²/s³ (Bar-Shalom, Li and Kirubarajan,
/// 2001, eq. 6.2.2-12).
pub(crate) fn accelerated(density: f64, dt: f64, lag_s: f64) -> DMatrix<f64> {
    let place = dt.powi(3) / 3.0 + dt * dt * lag_s + dt * lag_s * lag_s;
    let both = 0.5 * dt * dt + dt * lag_s;
    DMatrix::from_fn(STATE, STATE, |r, c| match (r / 2, c / 2) {
        _ if r % 2 != c % 2 => 0.0,
        (0, 0) => density * place,
        (1, 1) => density * dt,
        _ => density * both,
    })
}

/// Straight courses over `span_s` that end a σ apart, of speeds with this standard deviation along each axis, σ/s: so many more chances than in
/// a lone frame has noise to look like an emitter.
pub(crate) fn courses(speed_std: f64, span_s: f64) -> f64 {
    (1.0 + 2.0 * speed_std * span_s).powi(2)
}

#[cfg(test)]
mod tests {
    use nalgebra::Matrix4;

    use super::accelerated;

    #[test]
    fn accelerations_of_two_spans_add_up_to_that_of_both() {
        let of = |dt: f64, lag_s: f64| Matrix4::from_iterator(accelerated(0.7, dt, lag_s).iter().copied());
        let (first, second, both) = (of(0.3, 1.5), of(0.5, 1.0), of(0.8, 1.0));
        assert!((first + second - both).amax() < 1e-12, "{first} {second} {both}");
    }
}
