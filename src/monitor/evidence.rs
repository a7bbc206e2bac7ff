use serde_json::{Value, json};

use crate::monitor::input::claim_state::ActiveClaim;
use crate::monitor::input::claim_timing::median;
use crate::monitor::monitor::Monitor;

/// How the ln energies of honest users scatter (ten coherence times a frame), and a stranger's: any factor of ten.
const HONEST: f64 = 0.3;
const STRANGER: f64 = 2.3;
/// Other users who report their power before anybody's is held against it.
const FEWEST_OTHERS: usize = 2;

impl Monitor {
    /// The light of user `i` against the power that they report, by what arrives of each watt of the others: a beam from elsewhere, or
    /// with a second one in its spot, has another yield.
    pub fn against_reported(&self, active: &[ActiveClaim], association: &[Option<u64>], i: usize) -> Option<Value> {
        let yields = |j: usize| self.ln_yield(&active[j], association[j]);
        let own = yields(i)?;
        let others: Vec<f64> = (0..active.len()).filter(|j| *j != i).filter_map(yields).collect();
        if others.len() < FEWEST_OTHERS {
            return None;
        }
        let off = own - median(others.into_iter())?;
        Some(json!({
            "reported_w": active[i].claim.power_w,
            "ratio": off.exp(),
            "likelihood_ratio": likelihood_ratio(off),
        }))
    }

    /// ln of what arrives of each watt that a user reports to send, the beam's slant towards the sensor taken out (h/L); none for who
    /// reports none or is not seen.
    fn ln_yield(&self, a: &ActiveClaim, answer: Option<u64>) -> Option<f64> {
        let track = self.tracks.get(answer?).filter(|t| t.hit)?;
        let slant = self.camera.altitude_m / self.camera.altitude_m.hypot(track.motion.position().norm());
        Some((track.detection.energy_j / (a.claim.power_w? * slant)).ln()).filter(|y| y.is_finite())
    }
}

/// Of a stranger's light to an honest user's, that far from what is expected in ln.
pub fn likelihood_ratio(off: f64) -> f64 {
    let density = |std: f64| (-0.5 * (off / std).powi(2)).exp() / std;
    (density(STRANGER) / density(HONEST).max(1e-12)).min(1e9)
}
