//! What each access point said last, and what follows from all of it together.

use std::collections::{BTreeMap, HashMap};
use std::sync::Arc;

use jiff::Timestamp;
use nalgebra::{Matrix2, Vector2};
use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::picture::{self, DIFFERENCE_SIGMAS, Picture, Tracks, cov};
use crate::api::{StationPlace, StationPose, StationState, StationStatus};
use crate::claim::{Claim, ClaimState};
use crate::fleet::message::{HealthMessage, PoseMessage, PositionsMessage};
use crate::geo::Geodetic;
use crate::monitor::{StationName, TrackedPosition};
use crate::time::seconds;

/// Stations known at once. Each costs some 50 kB with its positions and status.
const MOST_STATIONS: usize = 4096;
/// Positions that arrived longer ago say nothing of where anybody is, s. A few messages at the lowest usual rate.
const FRESH_S: f64 = 2.0;
/// A station whose frames are dated further from the hub's clock than this is shown, and not compared with others, s.
const LARGEST_LAG_S: f64 = 5.0;
/// Fastest user, m/s: how far one may have come between two frames of different times.
const FASTEST_M_S: f64 = 40.0;

/// Why a message is not used. The names are values of a metric's label.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Refused {
    /// More stations than the hub keeps.
    TooMany,
    /// Older than what is known.
    Late,
    /// An alert event that was taken before.
    Repeated,
}

impl Refused {
    pub fn name(self) -> &'static str {
        match self {
            Self::TooMany => "too_many_stations",
            Self::Late => "late",
            Self::Repeated => "repeated",
        }
    }
}

#[derive(Debug)]
struct Station {
    last_seen: Timestamp,
    positions: Option<(Timestamp, PositionsMessage)>,
    pose: Option<(Timestamp, PoseMessage)>,
    health: Option<Health>,
}

/// The newest health message.
#[derive(Debug)]
struct Health {
    status: Arc<Value>,
    alerts_waiting: u64,
}

/// What alerts depend on of a station, in a recording.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct SavedStation {
    #[serde(flatten)]
    name: StationName,
    last_seen: Timestamp,
    /// With the time of their arrival.
    positions: Option<(Timestamp, PositionsMessage)>,
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
            pose: None,
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

    pub fn take_pose(&mut self, message: PoseMessage, now: Timestamp) -> Result<(), Refused> {
        let station = self.station(&message.name, now)?;
        let is_late = |(at, known): &(Timestamp, PoseMessage)| {
            message.status.time < known.status.time && seconds(*at, now) < FRESH_S
        };
        if station.pose.as_ref().is_some_and(is_late) {
            return Err(Refused::Late);
        }
        station.pose = Some((now, message));
        Ok(())
    }

    pub fn take_health(&mut self, message: HealthMessage, now: Timestamp) -> Result<(), Refused> {
        let station = self.station(&message.name, now)?;
        station.health = Some(Health {
            status: Arc::new(message.status),
            alerts_waiting: message.alerts_waiting,
        });
        Ok(())
    }

    /// A station that is known from its alerts is missed from then on.
    pub fn take_sign(&mut self, name: &StationName, now: Timestamp) -> Result<(), Refused> {
        self.station(name, now).map(|_| ())
    }

    pub fn saved(&self) -> Vec<SavedStation> {
        let saved = |(name, station): (&StationName, &Station)| SavedStation {
            name: name.clone(),
            last_seen: station.last_seen,
            positions: station.positions.clone(),
        };
        self.known.iter().map(saved).collect()
    }

    pub fn resume(saved: Vec<SavedStation>) -> Self {
        let known = |saved: SavedStation| {
            let station = Station {
                last_seen: saved.last_seen,
                positions: saved.positions,
                pose: None,
                health: None,
            };
            (saved.name, station)
        };
        Self {
            known: saved.into_iter().map(known).collect(),
            tracks: Tracks::default(),
        }
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

    /// Where a station's track is, m.
    pub fn track(&self, name: &StationName, track: u64, now: Timestamp) -> Option<[f64; 2]> {
        let message = self.fresh(now).find(|message| message.name == *name)?;
        let beam = message.emitters.iter().find(|e| e.track == track)?;
        Some([beam.x_m, beam.y_m])
    }

    /// Users that are claimed or seen at two places, with one sighting of each: places that differ by more than `tolerated_m`, by what
    /// both covariances allow, and by the way that a user can have gone between the two times.
    pub fn conflicts(&self, now: Timestamp, tolerated_m: f64) -> BTreeMap<String, [Sighting; 2]> {
        let mut places: HashMap<&str, Vec<Place<'_>>> = HashMap::new();
        for message in self.fresh(now).filter(|message| is_of(message, now)) {
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
            let apart = |(a, b): &(&Place<'_>, &Place<'_>)| (a.is_seen || b.is_seen) && a.is_apart_from(b, tolerated_m);
            if let Some((a, b)) = pairs.into_iter().find(apart) {
                conflicts.insert(user.to_owned(), [a.sighting(), b.sighting()]);
            }
        }
        conflicts
    }

    /// All beams as one picture.
    pub fn picture(&mut self, now: Timestamp, tolerated_m: f64) -> Picture {
        let Self { known, tracks } = self;
        let arrived = known.values().filter_map(|s| s.positions.as_ref());
        let fresh = arrived.filter(|(at, _)| seconds(*at, now) < FRESH_S);
        picture::draw(fresh.map(|(_, message)| message), tracks, tolerated_m)
    }

    pub fn statuses(&self, now: Timestamp, lost_after_s: f64) -> Vec<StationStatus> {
        let status = |(name, station): (&StationName, &Station)| {
            let arrived = station.positions.as_ref();
            let positions = arrived.map(|(_, message)| message);
            let status = station.health.as_ref().map(|h| h.status.clone()).unwrap_or_default();
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
                lag_s: arrived.map(|(at, message)| seconds(message.time, *at)),
                alerts_waiting: station.health.as_ref().map_or(0, |h| h.alerts_waiting),
                emitters: positions.map_or(0, |p| p.emitters.len()),
                field_of_view_m: positions.map(|p| p.field_of_view_m),
                footprint_m: positions.map(footprint).unwrap_or_default(),
                pose: station.pose.as_ref().map(|(at, message)| pose_at(message, *at, now)),
                is_compared: arrived.is_none_or(|(at, message)| is_of(message, *at)),
                refused: BTreeMap::new(),
                status,
            }
        };
        self.known.iter().map(status).collect()
    }
}

/// Whether a frame is of about this time of the hub's clock, so that it can be compared with other stations'.
fn is_of(message: &PositionsMessage, time: Timestamp) -> bool {
    seconds(message.time, time).abs() <= LARGEST_LAG_S
}

/// Where a platform is, by what its station said of it at `at`.
fn pose_at(message: &PoseMessage, at: Timestamp, now: Timestamp) -> StationPose {
    let status = &message.status;
    StationPose {
        source: status.source.to_string(),
        time: status.time,
        is_lost: status.is_lost,
        place: status.pose.as_ref().map(|pose| StationPlace {
            age_s: pose.age_s + seconds(at, now).max(0.0),
            x_m: pose.x_m,
            y_m: pose.y_m,
            z_m: pose.z_m,
            latitude_deg: pose.latitude_deg,
            longitude_deg: pose.longitude_deg,
            height_m: pose.height_m,
            heading_deg: pose.heading_deg,
        }),
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

struct Place<'a> {
    name: &'a StationName,
    time: Timestamp,
    at: Vector2<f64>,
    z_m: f64,
    geodetic: Option<Geodetic>,
    cov: Matrix2<f64>,
    is_seen: bool,
}

impl<'a> Place<'a> {
    fn seen(message: &'a PositionsMessage, emitter: &TrackedPosition) -> Self {
        Self {
            name: &message.name,
            time: message.time,
            at: Vector2::new(emitter.x_m, emitter.y_m),
            z_m: emitter.z_m,
            geodetic: emitter.geodetic,
            cov: cov(emitter),
            is_seen: true,
        }
    }

    fn claimed(message: &'a PositionsMessage, claim: &Claim) -> Self {
        Self {
            name: &message.name,
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

#[cfg(test)]
#[path = "stations_test.rs"]
mod tests;
