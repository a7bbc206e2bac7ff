//! What a lens brings into view of beams that come from just outside it: the first ring of an Airy disc, whose middle is not seen, is a beam of its
//! own to an estimator.

use nalgebra::Vector2;

use super::input::claim_state::{ActiveClaim, is_near_view};
use super::stats::robust::median_high;
use super::track::detection::{Detection, spot_m};
use crate::estimate::Flags;
use crate::geo::View;

/// Distance from a claim beyond the view within which a beam at the sensor's edge may be its halo, spot widths. Larger hides more faint strangers
/// beside such a claim, smaller alerts the ends of a ring.
const REACH: f64 = 6.5;
/// Largest share of a spot's light in what of its halo is taken for a beam. Larger hides brighter strangers, smaller alerts the brightest parts
/// of rings: nine tenths have less than a twentieth.
const SHARE: f64 = 0.15;

/// Takes out of `detections` what may be the halo of users who claim to be beyond the view, of each user's usual energy (`usual_energy_j`), or where
/// that is not known the detections'. Names that no beam has answered count for nothing: whoever writes claims could cover the edges with them.
pub(super) fn leave_out_halos(
    detections: &mut Vec<Detection>,
    claims: &[ActiveClaim],
    view: &View,
    usual_energy_j: impl Fn(&str) -> Option<f64>,
) {
    let usual_of_all = median_high(detections.iter().map(|d| d.energy_j)).unwrap_or(0.0);
    let reach_m = REACH * spot_m(view);
    let beyond = claims
        .iter()
        .filter(|c| c.before.was_seen() && !is_near_view(view, c.position, 0.0));
    let beyond: Vec<(Vector2<f64>, f64)> = beyond
        .map(|c| (c.position, usual_energy_j(&c.claim.user).unwrap_or(usual_of_all)))
        .collect();
    detections.retain(|d| {
        let is_halo_of = |(place, usual_j): &(Vector2<f64>, f64)| {
            d.energy_j < SHARE * usual_j && (d.position - place).norm() < reach_m
        };
        !(d.flags.contains(Flags::NEAR_EDGE) && beyond.iter().any(is_halo_of))
    });
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::monitor::input::claim_state::fixture::active_claim;
    use crate::monitor::track::detection::fixture::detection;
    use crate::optics;

    #[test]
    fn a_faint_beam_at_the_edge_beside_a_claim_beyond_it_is_its_halo() {
        let view = View::level(&optics::Config::default().camera().unwrap());
        let edge_m = view.ground_scale() * view.camera.x.half_width();
        let spot_m = spot_m(&view);
        let left = |claimed_m: f64, share: f64, inside_spots: f64, flags: Flags, was_seen: bool| {
            let of = |x: f64, share: f64, flags: Flags| Detection {
                energy_j: share * 1e-12,
                flags,
                ..detection(x, 0.0)
            };
            let mut detections = vec![
                of(0.0, 1.0, Flags::empty()),
                of(20.0, 1.0, Flags::empty()),
                of(edge_m - inside_spots * spot_m, share, flags),
            ];
            let mut claim = active_claim("u", edge_m + claimed_m, 0.0);
            claim.before.last_seen = was_seen.then_some(claim.made);
            leave_out_halos(&mut detections, &[claim], &view, |_| None);
            detections.len()
        };
        let beyond_m = 3.0 * spot_m;
        assert_eq!(left(beyond_m, 0.05, 1.0, Flags::NEAR_EDGE, true), 2);
        assert_eq!(left(beyond_m, 0.05, 1.0, Flags::NEAR_EDGE, false), 3);
        assert_eq!(left(beyond_m, 0.5, 1.0, Flags::NEAR_EDGE, true), 3);
        assert_eq!(left(beyond_m, 0.05, 1.0, Flags::empty(), true), 3);
        assert_eq!(left(beyond_m, 0.05, 4.0, Flags::NEAR_EDGE, true), 3);
        assert_eq!(left(-spot_m, 0.05, 1.0, Flags::NEAR_EDGE, true), 3);
    }
}
