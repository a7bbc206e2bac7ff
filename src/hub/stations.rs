//! What each access point said last, and what follows from all of it together.

use std::collections::{BTreeMap, HashMap};

use jiff::Timestamp;
use nalgebra::{Matrix2, Vector2};
use serde_json::Value;

use crate::api::{StationState, StationStatus};
use crate::claim::{Claim, ClaimState};
use crate::fleet::message::{HealthMessage, PositionsMessage};
use crate::geo::{Geodetic, LocalAxes};
use crate::monitor::{PositionStatus, StationName, TrackedPosition};

/// Stations known at once. Each costs some 50 kB with its positions and status.
const MOST_STATIONS: usize = 4096;
/// Positions that arrived longer ago say nothing of where anybody is, s. A few messages at the lowest usual rate.
const FRESH_S: f64 = 2.0;
/// A station whose frames are dated further from the hub's clock than this is shown, and not compared with others, s.
const LARGEST_LAG_S: f64 = 5.0;
/// Standard deviations by which two sightings of one user must differ beyond what is tolerated. At 4, independent errors reach it
/// once in 3,000 comparisons on a plane; a conflict has to last for [`super::conflicts`] besides.
const DIFFERENCE_SIGMAS: f64 = 4.0;
/// Fastest user, m/s: how far one may have come between two frames of different times.
const FASTEST_M_S: f64 = 40.0;

/// Why a message is not used. The names are values of a metric's label.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Refused {
    /// More stations than the hub keeps.
    TooMany,
    /// Older than what is known.
    Late,
}

impl Refused {
    pub fn name(self) -> &'static str {
        match self {
            Self::TooMany => "too_many_stations",
            Self::Late => "late",
        }
    }
}

#[derive(Debug)]
struct Station {
    last_seen: Timestamp,
    positions: Option<(Timestamp, PositionsMessage)>,
    health: Option<HealthMessage>,
}

#[derive(Debug, Default)]
pub struct Stations {
    known: BTreeMap<StationName, Station>,
    tracks: Tracks,
}

/// Where a user is, by one station.
#[derive(Clone, Debug, PartialEq)]
pub struct Sighting {
    pub name: StationName,
    pub x_m: f64,
    pub y_m: f64,
    pub z_m: f64,
    /// Of a beam, where its station has an origin.
    pub geodetic: Option<Geodetic>,
    /// Seen, not only claimed.
    pub is_seen: bool,
}

impl Stations {
    /// Notes that a station is alive at `now`, the hub's clock.
    fn station(&mut self, name: &StationName, now: Timestamp) -> Result<&mut Station, Refused> {
        if !self.known.contains_key(name) && self.known.len() >= MOST_STATIONS {
            return Err(Refused::TooMany);
        }
        let station = self.known.entry(name.clone()).or_insert_with(|| Station {
            last_seen: now,
            positions: None,
            health: None,
        });
        station.last_seen = now;
        Ok(station)
    }

    pub fn take_positions(&mut self, message: PositionsMessage, now: Timestamp) -> Result<(), Refused> {
        let station = self.station(&message.name, now)?;
        // A station that starts its recording again goes back in time for good; one old message is late.
        let is_late =
            |(at, known): &(Timestamp, PositionsMessage)| message.time < known.time && seconds(*at, now) < FRESH_S;
        if station.positions.as_ref().is_some_and(is_late) {
            return Err(Refused::Late);
        }
        station.positions = Some((now, message));
        Ok(())
    }

    pub fn take_health(&mut self, message: HealthMessage, now: Timestamp) -> Result<(), Refused> {
        let station = self.station(&message.name, now)?;
        station.health = Some(message);
        Ok(())
    }

    /// A station that is known from its alerts is missed from then on.
    pub fn take_sign(&mut self, name: &StationName, now: Timestamp) -> Result<(), Refused> {
        self.station(name, now).map(|_| ())
    }

    /// Stations without a message for `lost_after_s`, and the others.
    pub fn lost(&self, now: Timestamp, lost_after_s: f64) -> impl Iterator<Item = (&StationName, bool, Timestamp)> {
        self.known
            .iter()
            .map(move |(name, s)| (name, seconds(s.last_seen, now) > lost_after_s, s.last_seen))
    }

    /// Fresh positions.
    fn fresh(&self, now: Timestamp) -> impl Iterator<Item = &PositionsMessage> {
        let all = self.known.values().filter_map(|s| s.positions.as_ref());
        all.filter(move |(at, _)| seconds(*at, now) < FRESH_S)
            .map(|(_, message)| message)
    }

    /// Whether another station than `name` sees this user.
    pub fn is_seen_elsewhere(&self, user: &str, name: &StationName, now: Timestamp) -> bool {
        let others = self.fresh(now).filter(|message| message.name != *name);
        others
            .flat_map(|m| &m.emitters)
            .any(|e| e.user.as_deref() == Some(user))
    }

    /// Users that are claimed or seen at two places, with one sighting of each: places that differ by more than `tolerated_m`, by what
    /// both covariances allow, and by the way that a user can have gone between the two times.
    pub fn conflicts(&self, now: Timestamp, tolerated_m: f64) -> BTreeMap<String, [Sighting; 2]> {
        let mut places: HashMap<&str, Vec<Place>> = HashMap::new();
        for message in self.fresh(now).filter(|m| seconds(m.time, now).abs() <= LARGEST_LAG_S) {
            for emitter in &message.emitters {
                if let Some(user) = &emitter.user {
                    places.entry(user).or_default().push(Place::seen(message, emitter));
                }
            }
            let is_current =
                |c: &&Claim| c.state == ClaimState::Active && seconds(c.time, message.time).abs() < FRESH_S;
            for claim in message.claims.iter().filter(is_current) {
                let place = Place::claimed(message, claim);
                // A claim beside the user's own beam is the station's to judge.
                let others = places.entry(&claim.user).or_default();
                if !others.iter().any(|other| other.name == place.name) {
                    others.push(place);
                }
            }
        }
        let mut conflicts = BTreeMap::new();
        for (user, places) in places {
            let pairs = places
                .iter()
                .enumerate()
                .flat_map(|(k, a)| places[k + 1..].iter().map(move |b| (a, b)));
            // Two claims alone are the network's own business until a beam answers one of them.
            let apart = |(a, b): &(&Place, &Place)| (a.is_seen || b.is_seen) && a.is_apart_from(b, tolerated_m);
            if let Some((a, b)) = pairs.into_iter().find(apart) {
                conflicts.insert(user.to_owned(), [a.sighting(), b.sighting()]);
            }
        }
        conflicts
    }

    /// All beams as one picture: a user whom several stations see at one place is one beam, fused; the numbers of the tracks are the
    /// hub's own and stay with a user from one station to the next.
    pub fn picture(&mut self, now: Timestamp, tolerated_m: f64) -> Picture {
        let mut picture = Picture::default();
        let mut beams: Vec<(TrackedPosition, StationName)> = Vec::new();
        let known = &self.known;
        let fresh = known.values().filter_map(|s| s.positions.as_ref());
        for (_, message) in fresh.filter(|(at, _)| seconds(*at, now) < FRESH_S) {
            picture.time = picture.time.max(message.time);
            picture.frame = picture.frame.max(message.frame);
            picture.claims.extend(message.claims.iter().cloned());
            for emitter in &message.emitters {
                let mut beam = emitter.clone();
                beam.track = self.tracks.number(&message.name, emitter);
                let same = beams.iter_mut().find(|(other, _)| {
                    beam.user.is_some() && other.user == beam.user && is_near(other, &beam, tolerated_m)
                });
                match same {
                    Some((other, _)) => fuse(other, &beam, &message.name),
                    None => {
                        beam.station = Some(message.name.clone());
                        beams.push((beam, message.name.clone()));
                    }
                }
            }
            picture.unseen.extend(message.unseen.iter().cloned());
        }
        self.tracks.forget_unused();
        picture.unseen.sort();
        picture.unseen.dedup();
        let is_seen = |user: &String| beams.iter().any(|(b, _)| b.user.as_deref() == Some(user));
        picture.unseen.retain(|user| !is_seen(user));
        picture.emitters = beams.into_iter().map(|(beam, _)| beam).collect();
        picture
    }

    pub fn statuses(&self, now: Timestamp, lost_after_s: f64) -> Vec<StationStatus> {
        let status = |(name, station): (&StationName, &Station)| {
            let positions = station.positions.as_ref().map(|(_, message)| message);
            let status = station.health.as_ref().map(|h| h.status.clone()).unwrap_or(Value::Null);
            let is_blind = status["source"]["state"]
                .as_str()
                .is_some_and(|state| state != "running");
            StationStatus {
                site: name.site.clone(),
                station: name.station.clone(),
                state: match (seconds(station.last_seen, now) > lost_after_s, is_blind) {
                    (true, _) => StationState::Lost,
                    (false, true) => StationState::Blind,
                    (false, false) => StationState::Good,
                },
                last_seen_at: station.last_seen,
                lag_s: station
                    .positions
                    .as_ref()
                    .map(|(at, message)| seconds(message.time, *at)),
                alerts_waiting: station.health.as_ref().map_or(0, |h| h.alerts_waiting),
                emitters: positions.map_or(0, |p| p.emitters.len()),
                field_of_view_m: positions.map(|p| p.field_of_view_m),
                footprint_m: positions.map(footprint).unwrap_or_default(),
                status,
            }
        };
        self.known.iter().map(status).collect()
    }
}

/// The outline that a station states; nothing where it cannot be one.
fn footprint(message: &PositionsMessage) -> Vec<[f64; 2]> {
    /// Points of an outline: four times what ours have.
    const MOST: usize = 64;
    let points = &message.footprint_m;
    let is_outline = points.len() <= MOST && points.iter().flatten().all(|v| v.is_finite());
    if is_outline { points.clone() } else { Vec::new() }
}

/// All fresh positions together.
#[derive(Debug, Default)]
pub struct Picture {
    pub time: Timestamp,
    pub frame: u64,
    pub emitters: Vec<TrackedPosition>,
    pub unseen: Vec<String>,
    pub claims: Vec<Claim>,
}

struct Place {
    name: StationName,
    time: Timestamp,
    at: Vector2<f64>,
    z_m: f64,
    geodetic: Option<Geodetic>,
    cov: Matrix2<f64>,
    is_seen: bool,
}

impl Place {
    fn seen(message: &PositionsMessage, emitter: &TrackedPosition) -> Self {
        Self {
            name: message.name.clone(),
            time: message.time,
            at: Vector2::new(emitter.x_m, emitter.y_m),
            z_m: emitter.z_m,
            geodetic: emitter.geodetic,
            cov: cov(emitter),
            is_seen: true,
        }
    }

    fn claimed(message: &PositionsMessage, claim: &Claim) -> Self {
        Self {
            name: message.name.clone(),
            time: claim.time,
            at: Vector2::new(claim.x_m, claim.y_m),
            z_m: claim.z_m.unwrap_or(0.0),
            geodetic: None,
            cov: Matrix2::identity() * claim.sigma_m.unwrap_or(0.0).powi(2),
            is_seen: false,
        }
    }

    fn sighting(&self) -> Sighting {
        Sighting {
            name: self.name.clone(),
            x_m: self.at.x,
            y_m: self.at.y,
            z_m: self.z_m,
            geodetic: self.geodetic,
            is_seen: self.is_seen,
        }
    }

    fn is_apart_from(&self, other: &Self, tolerated_m: f64) -> bool {
        let sigma = (self.cov + other.cov).trace().max(0.0).sqrt();
        let gone = FASTEST_M_S * seconds(self.time, other.time).abs();
        self.name != other.name && (self.at - other.at).norm() > tolerated_m + DIFFERENCE_SIGMAS * sigma + gone
    }
}

fn cov(emitter: &TrackedPosition) -> Matrix2<f64> {
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
struct Tracks {
    last: u64,
    of_station: HashMap<(StationName, u64), (u64, bool)>,
    of_user: HashMap<String, u64>,
}

/// Users whose number is kept after they are gone from every view.
const USERS_KEPT: usize = 100_000;

impl Tracks {
    fn number(&mut self, name: &StationName, emitter: &TrackedPosition) -> u64 {
        let key = (name.clone(), emitter.track);
        let of_user = emitter.user.as_ref().and_then(|user| self.of_user.get(user).copied());
        let known = of_user.or_else(|| self.of_station.get(&key).map(|(number, _)| *number));
        let number = known.unwrap_or_else(|| {
            self.last += 1;
            self.last
        });
        if let Some(user) = &emitter.user {
            if self.of_user.len() >= USERS_KEPT {
                self.of_user.clear();
            }
            self.of_user.insert(user.clone(), number);
        }
        self.of_station.insert(key, (number, true));
        number
    }

    fn forget_unused(&mut self) {
        self.of_station.retain(|_, (_, is_used)| std::mem::take(is_used));
    }
}

/// From `a` to `b`, s.
pub fn seconds(a: Timestamp, b: Timestamp) -> f64 {
    b.duration_since(a).as_secs_f64()
}

#[cfg(test)]
#[path = "stations_test.rs"]
mod tests;
