//! The beams of all stations as one picture, and the hub's own numbers of their tracks.

use std::collections::{BTreeMap, HashMap};

use jiff::Timestamp;
use nalgebra::{Matrix2, Vector2};

use crate::claim::Claim;
use crate::fleet::message::PositionsMessage;
use crate::geo::LocalAxes;
use crate::monitor::{PositionStatus, StationName, TrackedPosition};

/// Standard deviations by which two sightings of one user must differ beyond what is tolerated. At 4, independent errors reach it
/// once in 3,000 comparisons on a plane; a conflict has to last for [`super::conflicts`] besides.
pub const DIFFERENCE_SIGMAS: f64 = 4.0;

/// All fresh positions together.
#[derive(Debug, Default)]
pub struct Picture {
    pub time: Timestamp,
    pub frame: u64,
    pub emitters: Vec<TrackedPosition>,
    pub unseen: Vec<String>,
    pub claims: Vec<Claim>,
}

/// All beams as one picture: a user whom several stations see at one place is one beam, fused; the numbers of the tracks are the
/// hub's own and stay with a user from one station to the next.
pub fn draw<'a>(fresh: impl Iterator<Item = &'a PositionsMessage>, tracks: &mut Tracks, tolerated_m: f64) -> Picture {
    let mut picture = Picture::default();
    let mut beams: Vec<TrackedPosition> = Vec::new();
    let mut of_user: HashMap<&str, Vec<usize>> = HashMap::new();
    for message in fresh {
        picture.time = picture.time.max(message.time);
        picture.frame = picture.frame.max(message.frame);
        picture.claims.extend(message.claims.iter().cloned());
        for emitter in &message.emitters {
            let mut beam = emitter.clone();
            beam.track = tracks.number(&message.name, emitter);
            if let Some(user) = &emitter.user {
                let theirs = of_user.entry(user).or_default();
                if let Some(k) = theirs.iter().find(|k| is_near(&beams[**k], &beam, tolerated_m)) {
                    fuse(&mut beams[*k], &beam, &message.name);
                    continue;
                }
                theirs.push(beams.len());
            }
            beam.station = Some(message.name.clone());
            beams.push(beam);
        }
        picture.unseen.extend(message.unseen.iter().cloned());
    }
    tracks.forget_unused();
    picture.unseen.sort();
    picture.unseen.dedup();
    picture.unseen.retain(|user| !of_user.contains_key(user.as_str()));
    picture.emitters = beams;
    picture
}

pub fn cov(emitter: &TrackedPosition) -> Matrix2<f64> {
    let [[a, b], [c, d]] = emitter.cov_m2;
    Matrix2::new(a, b, c, d)
}

fn is_near(a: &TrackedPosition, b: &TrackedPosition, tolerated_m: f64) -> bool {
    let sigma = (cov(a) + cov(b)).trace().max(0.0).sqrt();
    (a.x_m - b.x_m).hypot(a.y_m - b.y_m) <= tolerated_m + DIFFERENCE_SIGMAS * sigma
}

/// Combines two sightings whose errors are independent (each has its own platform) in information form; the one with less
/// uncertainty names the station.
fn fuse(into: &mut TrackedPosition, other: &TrackedPosition, name: &StationName) {
    let (Some(a), Some(b)) = (cov(into).try_inverse(), cov(other).try_inverse()) else {
        return;
    };
    let Some(fused) = (a + b).try_inverse() else { return };
    let at = fused * (a * Vector2::new(into.x_m, into.y_m) + b * Vector2::new(other.x_m, other.y_m));
    if cov(other).trace() < cov(into).trace() {
        into.station = Some(name.clone());
        into.energy_j = other.energy_j;
    }
    if into.status != PositionStatus::Verified {
        into.status = other.status;
    }
    into.track = into.track.min(other.track);
    let shift = [at.x - into.x_m, at.y - into.y_m, 0.0];
    into.geodetic = into.geodetic.map(|here| LocalAxes::at(here).to_geodetic(shift));
    (into.x_m, into.y_m) = (at.x, at.y);
    into.cov_m2 = [[fused[(0, 0)], fused[(0, 1)]], [fused[(1, 0)], fused[(1, 1)]]];
}

/// The hub's own track numbers.
#[derive(Debug, Default)]
pub struct Tracks {
    last: u64,
    of_station: BTreeMap<StationName, HashMap<u64, OfStation>>,
    of_user: HashMap<String, u64>,
}

/// The hub's number of a station's track.
#[derive(Debug)]
struct OfStation {
    number: u64,
    is_used: bool,
}

/// Users whose number is kept after they are gone from every view.
const USERS_KEPT: usize = 100_000;

impl Tracks {
    fn number(&mut self, name: &StationName, emitter: &TrackedPosition) -> u64 {
        let of_user = emitter.user.as_ref().and_then(|user| self.of_user.get(user).copied());
        let of_station = self.of_station.get(name).and_then(|tracks| tracks.get(&emitter.track));
        let known = of_user.or_else(|| of_station.map(|track| track.number));
        let number = known.unwrap_or_else(|| {
            self.last += 1;
            self.last
        });
        if let Some(user) = &emitter.user
            && of_user.is_none()
        {
            if self.of_user.len() >= USERS_KEPT {
                self.of_user.clear();
            }
            self.of_user.insert(user.clone(), number);
        }
        let used = OfStation { number, is_used: true };
        match self.of_station.get_mut(name) {
            Some(tracks) => drop(tracks.insert(emitter.track, used)),
            None => drop(
                self.of_station
                    .insert(name.clone(), HashMap::from([(emitter.track, used)])),
            ),
        }
        number
    }

    fn forget_unused(&mut self) {
        self.of_station.retain(|_, tracks| {
            tracks.retain(|_, track| std::mem::take(&mut track.is_used));
            !tracks.is_empty()
        });
    }
}
