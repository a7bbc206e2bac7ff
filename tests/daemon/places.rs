//! Zones, known lights and maintenance, set over HTTP and kept over a kill.

use serde_json::{Value, json};

use super::over_http::SCENE;
use super::process::{Daemon, alerts, receiver};

const CONFIG: &str = "[source]\nkind = \"simulator\"\nscene = \"scene.toml\"\n[journal]\npath = \"journal.db\"\n";

fn scene(dir: &std::path::Path) {
    std::fs::write(dir.join("scene.toml"), SCENE).unwrap();
}

fn json_of((status, body): (u16, String)) -> (u16, Value) {
    let value = serde_json::from_str(&body).unwrap_or_else(|e| panic!("{e}: {body}"));
    (status, value)
}

fn status_of_stranger(positions: &Value) -> Option<&str> {
    let emitters = positions["emitters"].as_array()?;
    emitters.iter().find(|e| e["user"].is_null())?["status"].as_str()
}

fn square(name: &str, kind: &str, x: f64, y: f64) -> Value {
    json!({
        "type": "Feature",
        "properties": { "name": name, "kind": kind },
        "geometry": { "type": "Polygon", "coordinates": [[[x, y], [x + 40.0, y], [x + 40.0, y + 40.0], [x, y + 40.0], [x, y]]] },
    })
}

fn collection(features: Vec<Value>) -> String {
    json!({ "type": "FeatureCollection", "features": features }).to_string()
}

#[test]
fn an_approved_emitter_is_known_after_kill_9() {
    let dir = tempfile::tempdir().unwrap();
    scene(dir.path());
    let first = Daemon::start(dir.path(), CONFIG);
    let list = first.wait_for("/v1/alerts?kind=unclaimed_emitter", "alert", |v| !alerts(v).is_empty());
    let id = alerts(&list)[0]["id"].as_str().unwrap().to_owned();
    let body = json!({ "alert": id, "note": "street lamp" }).to_string();
    let (status, light) = json_of(first.post("/v1/known-lights", &body));
    assert_eq!(status, 201, "{light}");
    assert_eq!((&light["note"], &light["alert"]), (&json!("street lamp"), &json!(id)));
    assert!((light["x_m"].as_f64().unwrap() + 30.0).abs() < 0.5, "{light}");
    // Twice, of nothing, or without an end is refused by name.
    for (body, expected, detail) in [
        (body.clone(), 409, "known light"),
        (json!({ "alert": "none" }).to_string(), 404, "no open alert"),
        (json!({}).to_string(), 422, "expected x_m and y_m, or alert"),
        (
            json!({ "x_m": 1.0, "y_m": 1e9, "radius_m": 2.0 }).to_string(),
            422,
            "y_m: expected",
        ),
        (
            json!({ "x_m": 1.0, "y_m": 1.0, "radius_m": -2.0 }).to_string(),
            422,
            "radius_m: expected",
        ),
        (
            json!({ "x_m": 1.0, "y_m": 1.0, "until": "2001-01-01T00:00:00Z" }).to_string(),
            422,
            "until: expected",
        ),
        (
            json!({ "x_m": 1.0, "y_m": 1.0, "colour": 3 }).to_string(),
            422,
            "colour",
        ),
    ] {
        let (status, problem) = json_of(first.post("/v1/known-lights", &body));
        assert!(
            status == expected && problem["detail"].as_str().unwrap().contains(detail),
            "{body}: {problem}"
        );
    }
    first.wait_for("/v1/alerts?state=open", "no alert", |v| alerts(v).is_empty());
    first.wait_for("/v1/positions", "the lamp", |v| status_of_stranger(v) == Some("known"));
    first.signal("-KILL");
    first.end();

    let second = Daemon::start(dir.path(), CONFIG);
    second.wait_for("/v1/positions", "frames", |v| v["frame"].as_u64() > Some(40));
    let (_, lights) = json_of(second.get("/v1/known-lights"));
    assert_eq!(lights["known_lights"][0]["note"], "street lamp");
    let (_, standing) = json_of(second.get("/v1/alerts?state=open"));
    assert!(alerts(&standing).is_empty(), "{standing}");
    let path = format!("/v1/known-lights/{}", light["id"].as_str().unwrap());
    assert_eq!(second.send("DELETE", &path, "", "").0, 200);
    assert_eq!(second.send("DELETE", &path, "", "").0, 404);
    second.wait_for("/v1/alerts?state=open", "the alert again", |v| !alerts(v).is_empty());
    let (_, log) = json_of(second.get("/v1/audit"));
    let text = log.to_string();
    assert!(
        text.contains("known_light.approve") && text.contains("known_light.revoke"),
        "{text}"
    );
}

#[test]
fn zones_are_put_checked_and_kept() {
    let dir = tempfile::tempdir().unwrap();
    scene(dir.path());
    let fixed = "[[zone]]\nname = \"gate\"\nkind = \"watch\"\npolygon = [[60, 60], [70, 60], [70, 70]]\n";
    let config = format!("{fixed}{CONFIG}");
    let first = Daemon::start(dir.path(), &config);
    first.wait_for("/v1/alerts?state=open", "alert", |v| !alerts(v).is_empty());
    let (status, before) = json_of(first.get("/v1/zones"));
    assert_eq!(
        (status, before["features"][0]["properties"]["source"].as_str()),
        (200, Some("config"))
    );
    let mut features = before["features"].as_array().unwrap().clone();
    features.push(square("road", "ignore", -50.0, -10.0));
    let (status, after) = json_of(first.send("PUT", "/v1/zones", "", &collection(features)));
    assert_eq!(
        (status, after["features"].as_array().map(Vec::len)),
        (200, Some(2)),
        "{after}"
    );
    first.wait_for("/v1/alerts?state=open", "no alert", |v| alerts(v).is_empty());
    first.wait_for("/v1/positions", "an ignored beam", |v| {
        status_of_stranger(v) == Some("ignored")
    });
    for (header, body, expected, detail) in [
        (
            "If-Match: \"0000000000000000\"\r\n",
            collection(vec![]),
            412,
            "somebody else",
        ),
        (
            "",
            collection(vec![square("a", "odd", 0.0, 0.0)]),
            422,
            "features[0].properties.kind",
        ),
        (
            "",
            collection(vec![square("gate", "watch", 0.0, 0.0)]),
            422,
            "no other zone has",
        ),
        ("", "{".to_owned(), 422, "the body"),
    ] {
        let (status, problem) = json_of(first.send("PUT", "/v1/zones", header, &body));
        assert!(
            status == expected && problem["detail"].as_str().unwrap().contains(detail),
            "{body}: {problem}"
        );
    }
    first.signal("-KILL");
    first.end();
    let second = Daemon::start(dir.path(), &config);
    second.wait_for("/v1/positions", "an ignored beam", |v| {
        status_of_stranger(v) == Some("ignored")
    });
    let (status, none) = json_of(second.send("PUT", "/v1/zones", "", &collection(vec![])));
    assert_eq!(
        (status, none["features"].as_array().map(Vec::len)),
        (200, Some(1)),
        "the config's own stays"
    );
    second.wait_for("/v1/alerts?state=open", "the alert again", |v| !alerts(v).is_empty());
}

#[test]
fn of_two_operators_who_change_the_same_zones_one_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    scene(dir.path());
    let daemon = Daemon::start(dir.path(), CONFIG);
    daemon.wait_for("/v1/positions", "frames", |v| v["frame"].as_u64() > Some(3));
    let (_, before) = json_of(daemon.send(
        "PUT",
        "/v1/zones",
        "",
        &collection(vec![square("yard", "watch", 0.0, 0.0)]),
    ));
    let tag = daemon.header("/v1/zones", "etag");
    assert_eq!(before["features"].as_array().map(Vec::len), Some(1));
    let header = format!("If-Match: {tag}\r\n");
    let put = |name: &str| {
        json_of(daemon.send(
            "PUT",
            "/v1/zones",
            &header,
            &collection(vec![square(name, "watch", 0.0, 0.0)]),
        ))
    };
    let answers = std::thread::scope(|scope| {
        let [a, b] = ["north", "south"].map(|name| scope.spawn(move || put(name)));
        [a.join().unwrap(), b.join().unwrap()]
    });
    let [winner, loser] = match answers {
        [a, b] if a.0 == 200 => [a, b],
        [a, b] => [b, a],
    };
    assert_eq!((winner.0, loser.0), (200, 412), "{winner:?} {loser:?}");
    assert!(
        loser.1["detail"].as_str().unwrap().contains("somebody else"),
        "{loser:?}"
    );
    let (_, zones) = json_of(daemon.get("/v1/zones"));
    assert_eq!(zones["features"], winner.1["features"]);
}

#[test]
fn a_thousand_zones_are_taken_and_more_are_refused_by_name() {
    let dir = tempfile::tempdir().unwrap();
    scene(dir.path());
    let daemon = Daemon::start(dir.path(), CONFIG);
    daemon.wait_for("/v1/positions", "frames", |v| v["frame"].as_u64() > Some(3));
    let zones = |n: usize| {
        let zone = |k: usize| {
            square(
                &format!("z-{k}"),
                "watch",
                50.0 * (k % 64) as f64,
                50.0 * (k / 64) as f64,
            )
        };
        collection((0..n).map(zone).collect())
    };
    let (status, taken) = json_of(daemon.send("PUT", "/v1/zones", "", &zones(1000)));
    assert_eq!((status, taken["features"].as_array().map(Vec::len)), (200, Some(1000)));
    for n in [1001, 5000] {
        let (status, problem) = json_of(daemon.send("PUT", "/v1/zones", "", &zones(n)));
        let said = problem["detail"].as_str().unwrap();
        assert!(
            status == 422 && said.contains(&format!("expected at most 1000, found {n}")),
            "{said}"
        );
    }
    let huge = json!({
        "type": "Feature", "properties": { "name": "huge", "kind": "ignore" },
        "geometry": { "type": "Polygon", "coordinates": [[[-1e300, -1e300], [1e300, -1e300], [1e300, 1e300], [-1e300, -1e300]]] },
    });
    let (status, problem) = json_of(daemon.send("PUT", "/v1/zones", "", &collection(vec![huge])));
    assert!(
        status == 422 && problem["detail"].as_str().unwrap().contains("expected"),
        "{problem}"
    );
    let (_, kept) = json_of(daemon.get("/v1/zones"));
    assert_eq!(kept["features"].as_array().map(Vec::len), Some(1000));
}

#[test]
fn during_maintenance_an_alert_is_recorded_and_sent_when_it_ends() {
    let dir = tempfile::tempdir().unwrap();
    scene(dir.path());
    let (port, requests) = receiver("204 No Content");
    std::fs::write(dir.path().join("secret"), "whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw\n").unwrap();
    let webhook =
        format!("[[webhook]]\nname = \"soc\"\nurl = \"http://127.0.0.1:{port}/\"\nsecret_file = \"secret\"\n");
    let daemon = Daemon::start(dir.path(), &format!("{CONFIG}{webhook}"));
    daemon.wait_until_up();
    let until = jiff::Timestamp::now() + jiff::SignedDuration::from_secs(3600);
    let body = json!({ "until": until, "by": "K. Novak", "note": "mast work" }).to_string();
    let (status, window) = json_of(daemon.post("/v1/maintenance", &body));
    assert_eq!(status, 201, "{window}");
    assert_eq!(
        json_of(daemon.post("/v1/maintenance", &json!({ "until": until }).to_string())).0,
        422
    );
    // A stranger within the time may have been sent before it began; one in a zone drawn now was not.
    let list = daemon.wait_for("/v1/alerts?state=open", "alert", |v| !alerts(v).is_empty());
    let alert = &alerts(&list)[0];
    if alert["maintenance"] == window["id"] {
        assert_eq!(alert["webhooks"], json!([]));
        assert!(requests.lock().unwrap().is_empty());
    }
    let path = format!("/v1/maintenance/{}", window["id"].as_str().unwrap());
    assert_eq!(daemon.send("DELETE", &path, "", "").0, 200);
    daemon.wait_for("/v1/status", "a delivery", |v| {
        v["webhooks"][0]["sent"].as_u64() > Some(0)
    });
    let first = requests.lock().unwrap()[0].clone();
    assert!(first.contains("\"alert.raised\""), "{first}");
}

#[test]
fn maintenance_in_force_goes_on_after_kill_9_beside_one_to_come() {
    let dir = tempfile::tempdir().unwrap();
    scene(dir.path());
    let first = Daemon::start(dir.path(), CONFIG);
    first.wait_until_up();
    let after = |hours: i64| jiff::Timestamp::now() + jiff::SignedDuration::from_hours(hours);
    for body in [
        json!({ "until": after(1), "by": "K. Novak" }),
        json!({ "from": after(2), "until": after(3), "by": "K. Novak" }),
    ] {
        assert_eq!(first.post("/v1/maintenance", &body.to_string()).0, 201);
    }
    let before = first.wait_for("/v1/maintenance", "both windows", |_| true);
    // The journal writes behind.
    std::thread::sleep(std::time::Duration::from_secs(1));
    first.signal("-KILL");
    first.end();
    let second = Daemon::start(dir.path(), CONFIG);
    second.wait_until_up();
    let after = second.wait_for("/v1/maintenance", "both windows", |_| true);
    assert_eq!(before, after);
}

#[test]
fn zones_that_cannot_be_used_end_the_program() {
    let dir = tempfile::tempdir().unwrap();
    let yard = "polygon = [[0, 0], [9, 0], [9, 9]]\n";
    for (config, message) in [
        (
            "[[zone]]\nname = \"a\"\nkind = \"watch\"\n".to_owned(),
            "zone 1 (\"a\"): polygon: expected polygon or geojson",
        ),
        (
            "[[zone]]\nname = \"a\"\nkind = \"watch\"\npolygon = []\n".to_owned(),
            "expected at least 3 corners, found 0",
        ),
        (
            "[[zone]]\nname = \"a\"\nkind = \"watch\"\npolygon = [[0, 0], [9, 9], [9, 0], [0, 6]]\n".to_owned(),
            "expected edges that do not cross",
        ),
        (
            "[[zone]]\nname = \"a\"\nkind = \"watch\"\npolygon = [[0, 0], [9, nan], [9, 0]]\n".to_owned(),
            "corner 2: expected two numbers",
        ),
        (
            "[[zone]]\nname = \"a\"\nkind = \"watch\"\ngeojson = \"absent\"\n".to_owned(),
            "absent",
        ),
        (
            format!("[[zone]]\nname = \"a\"\nkind = \"watch\"\nwebhooks = [\"soc\"]\n{yard}"),
            "expected the name of a [[webhook]]",
        ),
        (
            format!("[[zone]]\nname = \"a\"\nkind = \"ignor\"\n{yard}"),
            "unknown variant",
        ),
        (
            "[[known_light]]\nx_m = 1\ny_m = 1\nradius_m = 900\n".to_owned(),
            "known_light 1: radius_m: expected 0.1 to 50",
        ),
        (
            "[[maintenance]]\nfrom = \"2026-01-01T00:00:00Z\"\nuntil = \"2027-01-01T00:00:00Z\"\nby = \"K\"\n"
                .to_owned(),
            "maintenance 1: until: expected",
        ),
    ] {
        let file = dir.path().join("bad.toml");
        std::fs::write(&file, &config).unwrap();
        let mut check = std::process::Command::new(env!("CARGO_BIN_EXE_oapwatch"));
        let output = check.arg("check").arg(&file).output().unwrap();
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(said.contains(message), "{config} said {said}");
        assert_eq!(output.status.code(), Some(64), "{said}");
    }
}

#[test]
fn zones_in_degrees_are_the_same_ground_as_in_metres() {
    let dir = tempfile::tempdir().unwrap();
    scene(dir.path());
    let origin = "latitude_deg = 0.0, longitude_deg = 11.0, height_m = 0.0, datum = \"ellipsoid\"";
    // On the equator a degree of latitude is 110.574 km, one of longitude 111.320 km.
    let features = json!([{ "type": "Feature", "properties": {}, "geometry": { "type": "Polygon", "coordinates": [
        [[11.0005, 0.0005], [11.0006, 0.0005], [11.0006, 0.0006], [11.0005, 0.0005]]
    ] } }]);
    let file = json!({ "type": "FeatureCollection", "features": features });
    std::fs::write(dir.path().join("gate.geojson"), file.to_string()).unwrap();
    let gate = "[[zone]]\nname = \"gate\"\nkind = \"watch\"\ngeojson = \"gate.geojson\"\ncoordinates = \"degrees\"\n";
    let daemon = Daemon::start(dir.path(), &format!("{gate}[world]\norigin = {{ {origin} }}\n{CONFIG}"));
    let metres = daemon.wait_for("/v1/zones", "the zone", |v| v["features"][0].is_object());
    let corner = metres["features"][0]["geometry"]["coordinates"][0][0].clone();
    let [x, y] = [0, 1].map(|k| corner[k].as_f64().unwrap());
    assert!((x - 55.660).abs() < 0.01 && (y - 55.287).abs() < 0.01, "{corner}");
    let (status, degrees) = json_of(daemon.get("/v1/zones?coordinates=degrees"));
    let corner = degrees["features"][0]["geometry"]["coordinates"][0][0].clone();
    assert!(
        status == 200 && (corner[0].as_f64().unwrap() - 11.0005).abs() < 1e-9,
        "{corner}"
    );
    let road = collection(vec![square("road", "ignore", 0.0, 0.001)]);
    let (status, after) = json_of(daemon.send("PUT", "/v1/zones?coordinates=degrees", "", &road));
    assert_eq!(status, 422, "longitude 0 lies far beyond: {after}");
    let (status, problem) = json_of(daemon.get("/v1/zones?coordinates=feet"));
    assert_eq!(status, 400, "{problem}");
}
