//! Claims as networks write them: 3GPP shapes, Cisco Spaces, Cursor on Target and CSV, from a log.

use std::fmt::Write as _;
use std::path::Path;
use std::time::SystemTime;

use oapwatch::claim::Claim;
use oapwatch::claims::{Config, Follower, Format, read_log};
use oapwatch::geo::{Geodetic, LocalAxes};

fn config(format: Format) -> Config {
    Config {
        format,
        axes: Some(LocalAxes::at(Geodetic {
            latitude_deg: 48.0,
            longitude_deg: 11.0,
            height_m: 0.0,
        })),
        ..Config::default()
    }
}

/// Claims and reasons of a log of these lines.
fn read(text: &str, config: &Config) -> (Vec<Claim>, Vec<String>) {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("claims.log");
    std::fs::write(&path, text).unwrap();
    let read = read_log(&path, config, None).unwrap();
    let reasons = read.refused.iter().map(|r| format!("{}: {}", r.line, r.error));
    (read.claims, reasons.collect())
}

fn one(text: &str, config: &Config) -> Claim {
    let (mut claims, reasons) = read(text, config);
    assert_eq!((claims.len(), &reasons[..]), (1, &[][..]), "{text}");
    claims.remove(0)
}

fn is_about(found: [[f64; 2]; 2], expected: [[f64; 2]; 2]) {
    for (found, expected) in found.iter().flatten().zip(expected.iter().flatten()) {
        assert!((found - expected).abs() < 1e-3, "{found} for {expected}");
    }
}

/// k² within which a plane Gaussian lies with this probability.
fn k2(probability: f64) -> f64 {
    -2.0 * (1.0 - probability).ln()
}

#[test]
fn a_3gpp_shape_becomes_a_place_with_its_ellipse() {
    let config = config(Format::Gad);
    let line = |shape: &str| {
        format!(
            r#"{{"gpsi":"msisdn-4989","timestampOfLocationEstimate":"2026-11-21T08:00:00Z","locationEstimate":{{{shape}}}}}"#
        )
    };
    let point = r#""point":{"lat":48.001,"lon":11.001}"#;

    let claim = one(&line(&format!(r#""shape":"POINT",{point}"#)), &config);
    assert_eq!(
        (claim.user.as_str(), claim.cov_m2, claim.sigma_m),
        ("msisdn-4989", None, None)
    );
    assert!(
        (claim.x_m - 74.63).abs() < 0.02 && (claim.y_m - 111.2).abs() < 0.02,
        "{claim:?}"
    );

    let claim = one(
        &line(&format!(
            r#""shape":"POINT_UNCERTAINTY_CIRCLE",{point},"uncertainty":10"#
        )),
        &config,
    );
    let variance = 100.0 / k2(0.68);
    is_about(claim.cov_m2.unwrap(), [[variance, 0.0], [0.0, variance]]);

    // The longer axis points 30° east of north.
    let ellipse = r#""uncertaintyEllipse":{"semiMajor":20,"semiMinor":5,"orientationMajor":30},"confidence":95"#;
    let claim = one(
        &line(&format!(r#""shape":"POINT_UNCERTAINTY_ELLIPSE",{point},{ellipse}"#)),
        &config,
    );
    let (sin, cos) = 30f64.to_radians().sin_cos();
    let [a2, b2] = [400.0, 25.0].map(|axis2| axis2 / k2(0.95));
    let expected = [
        [a2 * sin * sin + b2 * cos * cos, (a2 - b2) * sin * cos],
        [(a2 - b2) * sin * cos, a2 * cos * cos + b2 * sin * sin],
    ];
    is_about(claim.cov_m2.unwrap(), expected);

    let local = format!(
        r#""shape":"LOCAL_2D_POINT_UNCERTAINTY_ELLIPSE","localOrigin":{{"coordinateId":"yard"}},"point":{{"x":3.5,"y":-4}},{ellipse}"#
    );
    let claim = one(&line(&local), &config);
    assert_eq!((claim.x_m, claim.y_m), (3.5, -4.0));
    is_about(claim.cov_m2.unwrap(), expected);

    // The shape itself as the line, user and time under our own names.
    let bare = format!(r#"{{"time":1795248000,"user":"u-1","shape":"POINT",{point}}}"#);
    assert_eq!(one(&bare, &config).user, "u-1");

    for (wrong, expected) in [
        (
            line(r#""shape":"POLYGON","pointList":[]"#),
            "field `shape`: expected POINT, ",
        ),
        (
            line(r#""shape":"POINT","point":{"lat":48}"#),
            "field `/point/lon` is missing",
        ),
        (
            line(&format!(
                r#""shape":"POINT_UNCERTAINTY_CIRCLE",{point},"uncertainty":-1"#
            )),
            "field `uncertainty`: expected metres",
        ),
        (
            line(&format!(
                r#""shape":"POINT_UNCERTAINTY_ELLIPSE",{point},"uncertaintyEllipse":{{"semiMajor":1,"semiMinor":1,"orientationMajor":400}}"#
            )),
            "orientationMajor`: expected degrees from 0 to 180",
        ),
        (r#"{"shape":"POINT"}"#.to_owned(), "field"),
    ] {
        let (claims, reasons) = read(&wrong, &config);
        assert!(
            claims.is_empty() && reasons[0].contains(expected),
            "{wrong}: {reasons:?}"
        );
    }
    let nowhere = Config { axes: None, ..config };
    let (_, reasons) = read(&line(&format!(r#""shape":"POINT",{point}"#)), &nowhere);
    assert!(reasons[0].contains("origin"), "{reasons:?}");
}

#[test]
fn a_cisco_spaces_event_is_a_device_with_its_95_percent_radius_in_feet() {
    let config = config(Format::CiscoSpaces);
    let event = |update: &str| {
        format!(
            r#"{{"recordUid":"event-1","recordTimestamp":1795248009000,"eventType":"DEVICE_LOCATION_UPDATE","deviceLocationUpdate":{{{update}}}}}"#
        )
    };
    let claim = one(
        &event(
            r#""device":{"deviceId":"d-1","userId":"","macAddress":"00:11:22:33:44:55"},"lastSeen":1795248000500,"xPos":100.0,"yPos":50.0,"confidenceFactor":72.0,"latitude":48.001,"longitude":11.001"#,
        ),
        &config,
    );
    assert_eq!(claim.user, "00:11:22:33:44:55");
    assert_eq!(claim.time.as_millisecond(), 1_795_248_000_500);
    assert!((claim.y_m - 111.2).abs() < 0.02);
    let variance = (72.0f64 * 0.3048).powi(2) / k2(0.95);
    is_about(claim.cov_m2.unwrap(), [[variance, 0.0], [0.0, variance]]);
    for (wrong, expected) in [
        (
            event(r#""device":{"deviceId":"d"},"latitude":-999.0,"longitude":-999.0"#),
            "`latitude`: expected degrees",
        ),
        (
            r#"{"eventType":"KEEP_ALIVE"}"#.to_owned(),
            "`eventType`: expected DEVICE_LOCATION_UPDATE, found \"KEEP_ALIVE\"",
        ),
        (event(""), "is missing"),
    ] {
        let (_, reasons) = read(&wrong, &config);
        assert!(reasons[0].contains(expected), "{wrong}: {reasons:?}");
    }
}

#[test]
fn a_cot_self_report_is_its_uid_or_callsign_with_ce_as_a_standard_deviation() {
    let mut config = config(Format::Cot);
    let event = |kind: &str, ce: &str| {
        format!(
            r#"<?xml version="1.0"?><event version="2.0" uid="ANDROID-1" type="{kind}" time="2026-11-21T08:00:00.250Z" start="2026-11-21T08:00:00Z" stale="2026-11-21T08:02:00Z" how="m-g"><point lat="48.001" lon="11.001" hae="520" ce="{ce}" le="9999999.0"/><detail><contact callsign="Zo&#235; &amp; co" endpoint="*:-1:stcp"/><remarks>a &lt; b</remarks></detail></event>"#
        )
    };
    let claim = one(&event("a-f-G-U-C", "4.5"), &config);
    assert_eq!((claim.user.as_str(), claim.sigma_m), ("ANDROID-1", Some(4.5)));
    assert_eq!(claim.time.as_millisecond(), 1_795_248_000_250);
    assert!((claim.y_m - 111.2).abs() < 0.02);
    assert_eq!(one(&event("a-f-G", "9999999.0"), &config).sigma_m, None);
    config.fields.user = "callsign".into();
    assert_eq!(one(&event("a-f-G", "4.5"), &config).user, "Zoë & co");
    for (wrong, expected) in [
        (event("t-x-d-d", "1"), "`type`: expected a type that begins with a-"),
        (event("a-f-G", "-1"), "`ce`: expected"),
        (event("a-f-G", "1").replace("</event>", ""), "not an XML event"),
        (
            event("a-f-G", "1").replace("</detail>", "</details>"),
            "not an XML event",
        ),
        ("<event/>".to_owned(), "found none"),
        ("nothing of the kind".to_owned(), "found none"),
        (
            "<event uid=\"a\" type=\"a-f-G\" time=\"2026-11-21T08:00:00Z\"><point lat=\"&lol;\"/></event>".to_owned(),
            "not an XML event",
        ),
    ] {
        let (claims, reasons) = read(&wrong, &config);
        assert!(
            claims.is_empty() && reasons[0].contains(expected),
            "{wrong}: {reasons:?}"
        );
    }
}

#[test]
fn csv_has_a_header_and_any_of_three_delimiters() {
    let local = Config {
        axes: None,
        ..config(Format::Csv)
    };
    let text = "\u{feff}time;user;x_m;y_m;sigma_m;state\n2026-11-21T08:00:00Z;007;1.5;-2;0.5;\n1795248001;\"a;b\";3;4;;ended\n\
                1795248002;u;3\n1795248003;u;three;4;;\n";
    let (claims, reasons) = read(text, &local);
    assert_eq!(claims.len(), 2);
    assert_eq!(
        (claims[0].user.as_str(), claims[0].x_m, claims[0].sigma_m),
        ("007", 1.5, Some(0.5))
    );
    assert_eq!((claims[1].user.as_str(), claims[1].sigma_m), ("a;b", None));
    assert_eq!(
        reasons,
        [
            "4: expected 6 cells as in the header, found 3",
            "5: field `x_m`: expected metres within 10000 km of the origin, found \"three\""
        ]
    );
    let geodetic = "user,time,latitude_deg,longitude_deg\nu,1795248000,48.001,11.001\n";
    assert!((one(geodetic, &config(Format::Csv)).y_m - 111.2).abs() < 0.02);
    let (claims, reasons) = read("1795248000,u,1,2\n", &local);
    assert!(
        claims.is_empty() && reasons[0].contains("a column of this name in the header"),
        "{reasons:?}"
    );
}

#[test]
fn a_csv_log_that_is_read_from_its_tail_or_was_rotated_keeps_its_columns() {
    let config = Config {
        axes: None,
        tail_bytes: 1 << 16,
        ..config(Format::Csv)
    };
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("claims.csv");
    let rows = |count: u64| {
        (0..count).fold("user,time,y_m,x_m\n".to_owned(), |mut text, k| {
            writeln!(text, "u-{k},{},2,1", 1_795_248_000 + k).unwrap();
            text
        })
    };
    std::fs::write(&path, rows(5000)).unwrap();
    let mut follower = Follower::new(&path, &config).live(SystemTime::UNIX_EPOCH);
    let poll = follower.poll().unwrap();
    assert!(
        poll.skipped_at_start_bytes > 0 && poll.claims.len() > 1000 && poll.refused_count == 0,
        "{poll:?}"
    );
    assert_eq!((poll.claims[0].x_m, poll.claims[0].y_m), (1.0, 2.0));
    rotate(&path, "time,user,x_m,y_m\n1795249000,v,5,6\n");
    let poll = follower.poll().unwrap();
    let last = poll.claims.last().unwrap();
    assert_eq!(
        (last.user.as_str(), last.x_m, last.y_m, poll.refused_count),
        ("v", 5.0, 6.0, 0)
    );
}

fn rotate(path: &Path, text: &str) {
    std::fs::rename(path, path.with_extension("csv.1")).unwrap();
    std::fs::write(path, text).unwrap();
}
