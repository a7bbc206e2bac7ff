//! What alerts say beside their verdict: the claim, and likelihood ratios of light that decide nothing.

use serde_json::{Value, json};

use super::frame_context::FrameContext;
use super::input::claim_state::ActiveClaim;
use super::stats::robust::median_high;

/// Standard deviations of ln energies about what is expected: of honest users (29 % scintillation at ten coherence times a frame),
/// and of a stranger, whose light may be off by any factor of ten. Assumed; they only weigh evidence that decides nothing.
const HONEST_LN_STD: f64 = 0.3;
const STRANGER_LN_STD: f64 = 2.3;
/// Other users who report their power before anybody's is compared with it. With one, two users would each be compared with the
/// other. It decides nothing.
const MIN_OTHERS: usize = 2;

/// The claim as an alert carries it.
pub(super) fn claimed(claim: &ActiveClaim) -> Value {
    let mut claimed = json!({
        "x_m": claim.claim.x_m,
        "y_m": claim.claim.y_m,
        "sigma_m": claim.claim.sigma_m,
        "time": claim.claim.time,
    });
    if let Some(cov) = claim.claim.cov_m2 {
        claimed["cov_m2"] = json!(cov);
    }
    if let Some(z_m) = claim.claim.z_m {
        claimed["z_m"] = z_m.into();
    }
    claimed
}

/// The light of the user of claim `i` against the power that they report, by what arrives of each watt of the others: a beam from
/// elsewhere, or with a second one in its spot, has another yield. It decides nothing: an attacker writes it.
pub(super) fn power_against_reported(frame: &FrameContext, i: usize) -> Option<Value> {
    let own = ln_yield(frame, i)?;
    let others: Vec<f64> = (0..frame.claims.len())
        .filter(|j| *j != i)
        .filter_map(|j| ln_yield(frame, j))
        .collect();
    if others.len() < MIN_OTHERS {
        return None;
    }
    let off = own - median_high(others.into_iter())?;
    Some(json!({
        "reported_w": frame.claims[i].claim.power_w,
        "ratio": off.exp(),
        "likelihood_ratio": stranger_likelihood_ratio(off),
    }))
}

/// ln of what arrives of each watt that a user reports to send, the beam's slant towards the sensor taken out (h/L); none for who
/// reports none or is not seen.
fn ln_yield(frame: &FrameContext, i: usize) -> Option<f64> {
    let track = frame.track(i).filter(|t| t.hit)?;
    let altitude_m = frame.view.height_m();
    let slant = altitude_m / altitude_m.hypot((track.filter.position() - frame.view.nadir_m()).norm());
    let yield_j = track.detection.energy_j / (frame.claims[i].claim.power_w? * slant);
    Some(yield_j.ln()).filter(|y| y.is_finite())
}

/// Likelihood of a stranger's light over an honest user's, `off` from what is expected in ln energy.
pub(super) fn stranger_likelihood_ratio(off: f64) -> f64 {
    let density = |std: f64| (-0.5 * (off / std).powi(2)).exp() / std;
    (density(STRANGER_LN_STD) / density(HONEST_LN_STD).max(1e-12)).min(1e9)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::monitor::fixture::Scene;

    #[test]
    fn light_as_expected_speaks_for_a_user_and_far_off_for_a_stranger() {
        assert!((stranger_likelihood_ratio(0.0) - 0.3 / 2.3).abs() < 1e-12);
        assert!(stranger_likelihood_ratio(2.0) > 1e6);
        assert_eq!(stranger_likelihood_ratio(-100.0), stranger_likelihood_ratio(100.0));
        assert!(stranger_likelihood_ratio(100.0) <= 1e9);
    }

    #[test]
    fn a_yield_is_compared_with_the_median_of_others() {
        let mut scene = Scene::of_users(&[[50.0, 0.0], [-50.0, 0.0], [0.0, 50.0]]);
        for claim in &mut scene.claims {
            claim.claim.power_w = Some(1.0);
        }
        // All are as far from the nadir. The same light of twice the reported power is half the yield.
        scene.claims[0].claim.power_w = Some(2.0);
        let found = power_against_reported(scene.context(), 0).unwrap();
        assert!((found["ratio"].as_f64().unwrap() - 0.5).abs() < 1e-12);
        assert_eq!(found["reported_w"], 2.0);
        scene.claims[1].claim.power_w = None;
        assert!(power_against_reported(scene.context(), 0).is_none());
    }
}
