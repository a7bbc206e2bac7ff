//! Sightings of several stations, made by hand.

use serde_json::json;

use super::*;
use crate::geo::LocalAxes;

fn at(s: i64) -> Timestamp {
    Timestamp::from_second(1_000_000 + s).unwrap()
}

/// Positions of a station at `s` seconds: (track, user, x) each, and claims (user, x).
fn positions(station: &str, s: i64, beams: &[(u64, Option<&str>, f64)], claims: &[(&str, f64)]) -> PositionsMessage {
    let emitter = |&(track, user, x_m): &(u64, Option<&str>, f64)| {
        json!({ "track": track, "x_m": x_m, "y_m": 0.0, "cov_m2": [[0.04, 0.0], [0.0, 0.04]], "energy_j": 0.01,
                "user": user, "status": "verified", "flags": [] })
    };
    let claim = |&(user, x_m): &(&str, f64)| json!({ "time": at(s), "user": user, "x_m": x_m, "y_m": 0.0 });
    let message = json!({
        "version": 1, "site": "harbour", "station": station, "time": at(s), "frame": s,
        "emitters": beams.iter().map(emitter).collect::<Vec<_>>(), "unseen": [],
        "claims": claims.iter().map(claim).collect::<Vec<_>>(), "field_of_view_m": [125.0, 125.0],
    });
    serde_json::from_value(message).unwrap()
}

fn stations(messages: Vec<PositionsMessage>) -> Stations {
    let mut stations = Stations::default();
    for message in messages {
        let now = message.time;
        stations.take_positions(message, now).unwrap();
    }
    stations
}

#[test]
fn two_sightings_far_apart_conflict_and_near_ones_are_one_beam() {
    let far = [
        positions("a", 0, &[(1, Some("u"), 0.0)], &[]),
        positions("b", 0, &[(7, Some("u"), 60.0)], &[]),
    ];
    assert_eq!(stations(far.to_vec()).conflicts(at(0), 5.0).len(), 1);
    let near = [
        positions("a", 0, &[(1, Some("u"), 0.0)], &[]),
        positions("b", 0, &[(7, Some("u"), 0.2)], &[]),
    ];
    let mut stations = stations(near.to_vec());
    assert!(stations.conflicts(at(0), 5.0).is_empty());
    let picture = stations.picture(at(0), 5.0);
    let [beam] = picture.emitters.as_slice() else {
        panic!("{picture:?}")
    };
    // Two equal, independent sightings: the mean, with half the variance.
    assert!(
        (beam.x_m - 0.1).abs() < 1e-12 && (beam.cov_m2[0][0] - 0.02).abs() < 1e-12,
        "{beam:?}"
    );
}

#[test]
fn a_fused_beam_is_between_both_on_the_earth_too() {
    let axes = LocalAxes::at(Geodetic {
        latitude_deg: 48.137,
        longitude_deg: 11.575,
        height_m: 520.0,
    });
    let seen = |station: &str, x_m: f64| {
        let mut message = positions(station, 0, &[(1, Some("u"), x_m)], &[]);
        message.emitters[0].geodetic = Some(axes.to_geodetic([x_m, 0.0, 0.0]));
        message
    };
    let picture = stations(vec![seen("a", 80.0), seen("b", 80.2)]).picture(at(0), 5.0);
    let found = axes.to_local(picture.emitters[0].geodetic.expect("stations with an origin"));
    assert!((found[0] - 80.1).abs() < 1e-4 && found[1].abs() < 1e-4, "{found:?}");
    // A station without an origin adds no place on the earth.
    let picture = stations(vec![positions("a", 0, &[(1, None, 0.0)], &[])]).picture(at(0), 5.0);
    assert!(picture.emitters[0].geodetic.is_none());
}

#[test]
fn a_beam_here_and_a_claim_there_conflict_but_two_claims_do_not() {
    let here = positions("a", 0, &[(1, Some("u"), 0.0)], &[("u", 0.0)]);
    let there = positions("b", 0, &[], &[("u", 80.0)]);
    assert_eq!(
        stations(vec![here.clone(), there.clone()]).conflicts(at(0), 5.0).len(),
        1
    );
    let only = positions("a", 0, &[], &[("u", 0.0)]);
    assert!(stations(vec![only, there]).conflicts(at(0), 5.0).is_empty());
    // A user may have gone on between two frames of different times.
    let later = positions("b", 2, &[(1, Some("u"), 60.0)], &[]);
    assert!(stations(vec![here, later]).conflicts(at(2), 5.0).is_empty());
}

#[test]
fn a_track_keeps_its_number_from_one_station_to_the_next() {
    let mut stations = stations(vec![positions("a", 0, &[(1, Some("u"), 0.0), (2, None, 9.0)], &[])]);
    let number = |picture: &Picture| picture.emitters.iter().find(|e| e.user.is_some()).map(|e| e.track);
    let before = number(&stations.picture(at(0), 5.0)).unwrap();
    stations.take_positions(positions("a", 1, &[], &[]), at(1)).unwrap();
    stations
        .take_positions(positions("b", 1, &[(1, Some("u"), 1.0)], &[]), at(1))
        .unwrap();
    assert_eq!(number(&stations.picture(at(1), 5.0)), Some(before));
}

#[test]
fn late_messages_and_too_many_stations_are_refused() {
    let mut stations = stations(vec![positions("a", 5, &[], &[])]);
    assert_eq!(
        stations.take_positions(positions("a", 4, &[], &[]), at(5)),
        Err(Refused::Late)
    );
    for k in 1..MOST_STATIONS {
        stations
            .take_sign(
                &StationName {
                    site: "s".to_owned(),
                    station: k.to_string(),
                },
                at(5),
            )
            .unwrap();
    }
    assert_eq!(
        stations.take_positions(positions("z", 5, &[], &[]), at(5)),
        Err(Refused::TooMany)
    );
    assert_eq!(
        stations.lost(at(20), 10.0).filter(|(_, is_lost, _)| *is_lost).count(),
        MOST_STATIONS
    );
}
