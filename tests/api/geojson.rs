//! Positions and alerts on the earth, from the monitor to GeoJSON, held to reference values (tests/reference/geo/make.py).

use jiff::SignedDuration;
use oapwatch::api::{Config, Snapshot};
use oapwatch::claims::{self, Store};
use oapwatch::estimate::{Emitter, Estimate, Flags, SecondMomentScore};
use oapwatch::geo::{Geodetic, LocalAxes};
use oapwatch::monitor::{Alert, AlertEventKind, AlertKind, Look, Monitor, Observation, Report, Source};
use oapwatch::optics;
use reqwest::{Client, StatusCode, header};
use serde_json::{Value, json};

use crate::fake::{Fake, at, get, json_of, problem, publish};
use crate::fixtures::{alert, snapshot};

/// What the monitor says of a beam that stands at a place, m, and that nobody claims.
fn watch(axes: LocalAxes, [x_m, y_m]: [f64; 2]) -> (Report, Alert) {
    let claims = claims::Config {
        axes: Some(axes),
        ..claims::Config::default()
    };
    let camera = optics::Config::default().camera().unwrap();
    let source = Source {
        kind: "replay".into(),
        file: None,
        rate_hz: 10.0,
    };
    let mut monitor = Monitor::new(&Default::default(), &claims, &camera, source);
    let mut store = Store::new(&claims);
    let emitter = Emitter {
        x_m,
        y_m,
        cov_m2: [[0.01, 0.0], [0.0, 0.01]],
        energy_j: 8e-3,
        energy_std_j: 1e-5,
        sensor_m: camera.to_sensor([x_m, y_m]),
        velocity: None,
        lasting_cov_m2: None,
        second_moment: SecondMomentScore::default(),
        flags: Flags::empty(),
    };
    let estimate = Estimate {
        emitters: vec![emitter],
        reduced_chi2: 1.0,
        condition: 1.0,
        ..Estimate::default()
    };
    for k in 0..600 {
        let seen = Observation {
            frame: k,
            time: at(0) + SignedDuration::from_millis(100 * k as i64),
            result: Ok(&estimate),
            energy_scale: 1.0,
            digest: k,
            look: Look::Level,
        };
        let report = monitor.step(seen, &mut store);
        let is_unclaimed = |alert: &&Alert| alert.kind == AlertKind::UnclaimedEmitter;
        if let Some(alert) = report.events.iter().map(|e| &e.alert).find(is_unclaimed).cloned() {
            return (report, alert);
        }
    }
    panic!("no alert about a beam at ({x_m}, {y_m})")
}

#[track_caller]
fn is_at(feature: &Value, place: &Value) {
    assert_eq!(feature["type"], "Feature");
    assert_eq!(feature["geometry"]["type"], "Point");
    let found = &feature["geometry"]["coordinates"];
    let properties = &feature["properties"];
    // A tenth of a millimetre on the ground; the references agree to a micrometre.
    for (k, key, reference, tolerance) in [
        (0, "longitude_deg", 1, 1e-9),
        (1, "latitude_deg", 0, 1e-9),
        (2, "height_m", 2, 1e-4),
    ] {
        let expected = place[reference].as_f64().unwrap();
        let off = found[k].as_f64().unwrap() - expected;
        assert!(off.abs() < tolerance, "{found} for {place}");
        assert_eq!(found[k], properties[key]);
    }
    assert_eq!(properties["z_m"], 0.0);
}

#[tokio::test]
async fn positions_and_alerts_are_where_geographiclib_and_pymap3d_put_them() {
    for line in include_str!("../reference/geo/ground.ndjson").lines() {
        let line: Value = serde_json::from_str(line).unwrap();
        let number = |of: &str, k: usize| line[of][k].as_f64().unwrap();
        let axes = LocalAxes::at(Geodetic {
            latitude_deg: number("origin", 0),
            longitude_deg: number("origin", 1),
            height_m: number("origin", 2),
        });
        let (report, alert) = watch(axes, [number("local_m", 0), number("local_m", 1)]);
        let fake = Fake::with(Config::default(), |state| state.with_axes(Some(axes))).await;
        fake.feed.publish(Snapshot { report, ..snapshot(1) });
        publish(&fake.feed, &fake.journal, AlertEventKind::Raised, alert).await;

        for (list, key, id) in [("positions", "emitters", "track"), ("alerts", "alerts", "id")] {
            let answer = get(&fake, &format!("/v1/{list}.geojson")).await;
            assert_eq!(answer.headers()[header::CONTENT_TYPE], "application/geo+json");
            let features = json_of(answer).await;
            assert_eq!(features["type"], "FeatureCollection");
            assert_eq!(features["features"].as_array().unwrap().len(), 1);
            let feature = &features["features"][0];
            is_at(feature, &line["place"]);
            let plain = json_of(get(&fake, &format!("/v1/{list}")).await).await;
            assert_eq!(feature["properties"], plain[key][0]);
            assert_eq!(feature["id"], plain[key][0][id]);
        }
        let csv = get(&fake, "/v1/alerts.csv").await.text().await.unwrap();
        assert!(
            csv.lines()
                .next()
                .unwrap()
                .ends_with("z_m,latitude_deg,longitude_deg,height_m"),
            "{csv}"
        );
        fake.stop().await;
    }
}

#[tokio::test]
async fn without_an_origin_there_is_no_geojson_and_nothing_else_is_missing() {
    let fake = Fake::start(Config::default()).await;
    fake.step(1);
    fake.alert("a-1", 1).await;
    for path in ["/v1/positions.geojson", "/v1/alerts.geojson"] {
        let detail = problem(get(&fake, path).await, 404).await;
        assert!(detail.contains("[world] origin"), "{detail}");
    }
    let positions = json_of(get(&fake, "/v1/positions").await).await;
    let alerts = json_of(get(&fake, "/v1/alerts").await).await;
    for object in [&positions["emitters"][0], &alerts["alerts"][0]] {
        assert_eq!(object["z_m"], 0.0);
        for key in ["latitude_deg", "longitude_deg", "height_m"] {
            assert!(object.get(key).is_none(), "{object}");
        }
    }
    fake.stop().await;
}

#[tokio::test]
async fn a_hub_shows_what_its_stations_know_page_by_page() {
    let fake = Fake::with(Config::default(), |state| state.of_hub()).await;
    fake.step(1);
    let positions = json_of(get(&fake, "/v1/positions.geojson").await).await;
    assert_eq!(positions["features"][0]["geometry"], Value::Null);
    let place = Geodetic {
        latitude_deg: 48.25,
        longitude_deg: 11.5,
        height_m: 520.0,
    };
    for k in 0..3 {
        let placed = Alert {
            geodetic: (k == 1).then_some(place),
            ..alert(&format!("a-{k}"), k)
        };
        publish(&fake.feed, &fake.journal, AlertEventKind::Raised, placed).await;
    }
    let answer = get(&fake, "/v1/alerts.geojson?limit=2&state=open").await;
    let link = answer.headers()[header::LINK].to_str().unwrap().to_owned();
    let next = link.trim_start_matches('<').split('>').next().unwrap().to_owned();
    let page = json_of(answer).await;
    let geometries: Vec<&Value> = page["features"]
        .as_array()
        .unwrap()
        .iter()
        .map(|f| &f["geometry"])
        .collect();
    let point = json!({ "type": "Point", "coordinates": [11.5, 48.25, 520.0] });
    assert_eq!(geometries, [&Value::Null, &point]);
    assert!(next.contains(page["next_cursor"].as_str().unwrap()), "{next}");
    let last = json_of(get(&fake, &next).await).await;
    assert_eq!(last["features"][0]["id"], "a-0");
    assert_eq!(last["next_cursor"], Value::Null);
    problem(get(&fake, "/v1/alerts.geojson?limit=0").await, 400).await;

    let tag = get(&fake, "/v1/alerts.geojson").await.headers()[header::ETAG].clone();
    let again = Client::new().get(fake.url("/v1/alerts.geojson"));
    let again = again.header(header::IF_NONE_MATCH, &tag).send().await.unwrap();
    assert_eq!(again.status(), StatusCode::NOT_MODIFIED);
    fake.stop().await;
}
