//! Whether a claim near a beam is evidence: where many names are claimed without a beam, one of them is near any beam.

use super::claim_state::ActiveClaim;
use crate::geo::View;
use crate::monitor::track::detection::view_m2;

/// Names claimed in view without a beam from which on a claim nearby is no evidence by itself. Smaller delays honest newcomers,
/// larger lets fewer invented names cover for a stranger. Honest users have their beams: at the start of a run all of them
/// are without one for a frame or two, and more than this many beams are in no scene.
const CROWDED: f64 = 32.0;
/// Largest probability that a beam that has nothing to do with any of the claims meets one of them. One in fifty strangers is
/// believed; of honest newcomers during a flood those whose claim is right to that distance. Not measured.
const BY_CHANCE: f64 = 0.02;

/// How near to a beam a name without one must be claimed to be believed.
#[derive(Clone, Copy, Debug)]
pub struct Crowding {
    is_crowded: bool,
    reach_m: f64,
}

impl Default for Crowding {
    fn default() -> Self {
        Self {
            is_crowded: false,
            reach_m: f64::INFINITY,
        }
    }
}

impl Crowding {
    /// Of a frame's claims, and of `elsewhere` names that the frame had no time or the store no room for.
    pub fn of_claims(claims: &[ActiveClaim], elsewhere: f64, view: &View) -> Self {
        let here = claims.iter().filter(|a| a.expected && !a.before.was_seen()).count();
        Self::of(here as f64 + elsewhere, view_m2(view))
    }

    /// Of `names` anywhere in a view of `area_m2`: the mean number of them within the reach is [`BY_CHANCE`].
    fn of(names: f64, area_m2: f64) -> Self {
        if names <= CROWDED {
            return Self::default();
        }
        Self {
            is_crowded: true,
            reach_m: (BY_CHANCE * area_m2 / (std::f64::consts::PI * names)).sqrt(),
        }
    }

    pub fn is_crowded(&self) -> bool {
        self.is_crowded
    }

    /// Distance of a claim from a beam, m, within which it is believed.
    pub fn reach_m(&self) -> f64 {
        self.reach_m
    }

    /// Whether the claim is evidence by itself: nobody is crowded out, or a beam is known to belong to the user.
    pub fn is_evidence(&self, claim: &ActiveClaim) -> bool {
        !self.is_crowded || claim.before.is_established()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_more_names_the_nearer_one_must_be() {
        let view = 250.0 * 250.0;
        assert!(!Crowding::of(32.0, view).is_crowded() && Crowding::of(33.0, view).is_crowded());
        for names in [33.0, 625.0, 20_000.0] {
            let reach = Crowding::of(names, view).reach_m;
            let expected = names * std::f64::consts::PI * reach * reach / view;
            assert!((expected - BY_CHANCE).abs() < 1e-12, "{names}: {expected}");
        }
    }
}
