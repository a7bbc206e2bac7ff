//! The spots that are watched for a second beam: those of users and known lights whose beam stands alone, each with all of its light.

use crate::estimate::Flags;
use crate::monitor::frame_context::FrameContext;
use crate::monitor::stats::brightness::Light;
use crate::monitor::stats::gaussian::largest_eigenvalue;
use crate::monitor::track::beam_track::Track;
use crate::monitor::track::detection::Detection;

/// Whose spot it is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Owner<'a> {
    User(&'a str),
    /// A known light, by id.
    Light(&'a str),
}

/// The beam of a user or a known light that stands alone in this frame.
pub struct WatchedSpot<'a> {
    /// Index of the claim, of a user's.
    pub claim: Option<usize>,
    pub owner: Owner<'a>,
    pub track: &'a Track,
    /// The track's detection, with all the light of the spot.
    pub detection: Detection,
}

impl WatchedSpot<'_> {
    /// The spot's light, where the frame shows all of it.
    pub fn light(&self, frame: &FrameContext) -> Option<Light> {
        let incomplete = Flags::SATURATED | Flags::MASKED | Flags::NEAR_EDGE | Flags::OUT_OF_TIME;
        let detection = &self.detection;
        let is_whole = detection.energy_j > 0.0 && !detection.flags.intersects(incomplete);
        let ln_gain = frame.view.ln_gain(self.track.filter.position())?;
        is_whole.then(|| Light {
            ln_energy: detection.energy_j.ln(),
            ln_gain,
        })
    }
}

/// The watched spots of a frame, by owner: beams that are detected and confirmed, and where nobody else's may be.
pub fn watched_spots<'a>(frame: &'a FrameContext) -> Vec<WatchedSpot<'a>> {
    let of_users = (0..frame.claims.len()).filter_map(|i| {
        let owner = Owner::User(&frame.claims[i].claim.user);
        watched_spot(frame, Some(i), owner, frame.track(i)?)
    });
    let mut watched: Vec<WatchedSpot> = of_users.collect();
    if !frame.lights.is_empty() {
        watched.extend(frame.lights.iter().filter(|s| s.is_seen).filter_map(|state| {
            let track = frame.tracker.get(state.track?)?;
            watched_spot(frame, None, Owner::Light(&state.light.id), track)
        }));
        watched.sort_by_key(|w| w.owner);
    }
    watched
}

fn watched_spot<'a>(
    frame: &'a FrameContext,
    claim: Option<usize>,
    owner: Owner<'a>,
    track: &'a Track,
) -> Option<WatchedSpot<'a>> {
    (track.hit && track.confirmed && !is_shared(frame, claim, track)).then(|| WatchedSpot {
        claim,
        owner,
        track,
        detection: whole_spot(frame, track),
    })
}

/// The track's detection with all the light of its spot that is associated with nobody else's claim.
fn whole_spot(frame: &FrameContext, track: &Track) -> Detection {
    let detection = &track.detection;
    let others = frame.tracker.tracks.iter().filter(|t| {
        let near = &t.detection;
        let reach = detection.resolution_m + 2.0 * largest_eigenvalue(&near.cov).sqrt().min(detection.resolution_m);
        let is_near = (near.position - detection.position).norm() < reach;
        t.hit && t.id != track.id && is_near && !frame.association.contains(t.id)
    });
    detection.united(others.map(|t| &t.detection), &frame.view)
}

/// Whether the beam of another user than that of claim `own`, or a known light, may be in this spot, by tracks or by claims.
fn is_shared(frame: &FrameContext, own: Option<usize>, track: &Track) -> bool {
    let (here, reach) = (track.filter.position(), track.detection.resolution_m);
    frame.confusion_m(track) > 0.0
        || (0..frame.claims.len())
            .filter(|&j| Some(j) != own && frame.association.track_id(j).is_none())
            .map(|j| &frame.claims[j])
            .filter(|a| frame.crowding.is_evidence(a))
            .any(|a| {
                let away = (a.position - here).norm() - a.slack_m - 2.0 * a.variance.sqrt();
                away < reach + frame.config.tolerated_distance_m || (a.is_unresolvable && away < frame.overlap_m())
            })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::monitor::fixture::Scene;
    use crate::monitor::track::association::Association;
    use crate::monitor::track::detection::fixture::detection;

    fn users(scene: &Scene) -> Vec<String> {
        let spots = watched_spots(scene.context());
        let user = |owner: Owner| match owner {
            Owner::User(name) | Owner::Light(name) => name.to_owned(),
        };
        spots.iter().map(|spot| user(spot.owner)).collect()
    }

    #[test]
    fn a_spot_that_may_be_shared_is_not_watched() {
        let mut scene = Scene::of_users(&[[0.0, 0.0], [80.0, 0.0]]);
        assert_eq!(users(&scene), ["u-0", "u-1"]);
        // The second user claims to be 4 m from the first, and has no beam.
        scene.claim(1, 4.0, 0.0);
        scene.association = Association::none(2);
        scene.association.assign(0, 1);
        assert!(users(&scene).is_empty());
        scene.claim(1, 40.0, 0.0);
        assert_eq!(users(&scene), ["u-0"]);
        // A name that no beam has answered is not believed to be there while there are many.
        scene.claim(1, 4.0, 0.0);
        scene.claims[1].before = Default::default();
        scene.crowd(300.0);
        assert_eq!(users(&scene), ["u-0"]);
    }

    #[test]
    fn light_in_the_spot_that_is_nobodys_counts_with_it() {
        let mut scene = Scene::of_users(&[[0.0, 0.0]]);
        // Resolutions are 2 m, errors 0.1 m.
        for (x, energy_j) in [(2.1, 2.0), (2.3, 1.0)] {
            scene.detect(&[detection(0.0, 0.0), detection(x, 0.0)]);
            let spots = watched_spots(scene.context());
            assert_eq!(spots[0].detection.energy_j, energy_j, "{x}");
            let light = spots[0].light(scene.context()).unwrap();
            assert_eq!(light.ln_energy, energy_j.ln());
        }
    }

    #[test]
    fn light_that_is_cut_off_is_not_compared() {
        let mut scene = Scene::of_users(&[[0.0, 0.0]]);
        let mut beam = detection(0.0, 0.0);
        beam.flags = Flags::NEAR_EDGE;
        scene.detect(&[beam]);
        let frame = scene.context();
        assert_eq!(watched_spots(frame)[0].light(frame), None);
    }
}
