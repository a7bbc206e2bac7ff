//! What was recorded around an alert: frames, picture, claims.

use ndarray::Array2;
use oapwatch::api::Config;
use oapwatch::claim::Claim;
use oapwatch::frame::Frame;
use oapwatch::frames::Arrivals;
use oapwatch::frames::record::{self, Recorder};
use oapwatch::pose::Pose;
use reqwest::{StatusCode, header};
use serde_json::json;

use crate::fake::{Fake, at, get, json_of, problem};

/// Width and height of a PNG, all of whose pixels can be decoded.
pub fn size_of(png: &[u8]) -> (u32, u32) {
    let mut reader = png::Decoder::new(std::io::Cursor::new(png)).read_info().unwrap();
    let mut pixels = vec![0; reader.output_buffer_size().unwrap()];
    let info = reader.next_frame(&mut pixels).unwrap();
    (info.width, info.height)
}

#[tokio::test]
async fn evidence_is_served_as_frames_as_a_picture_and_with_claims() {
    let dir = tempfile::tempdir().unwrap();
    let config = record::Config {
        folder: Some(dir.path().join("recordings")),
        after_s: 2.0,
        ..record::Config::default()
    };
    let folder = config.folder.clone().unwrap();
    let mut recorder = Recorder::start(&config).unwrap().unwrap();
    let claim: Claim = serde_json::from_value(json!({"time": at(0), "user": "u-1", "x_m": 1.0, "y_m": 2.0})).unwrap();
    let mut file = None;
    for k in 0..20 {
        let frame = Frame {
            index: k,
            time: at(k as i64),
            pixels: Array2::from_elem((64, 64), k as f64),
            masked: None,
            exposure_s: None,
            energy_scale: 1.0,
        };
        let arrivals = Arrivals {
            claims: vec![claim.clone()],
            poses: vec![Pose::level(at(k as i64), [0.0, 0.0, 300.0])],
        };
        recorder.frame(&frame, &arrivals).expect("taken");
        if k == 10 {
            file = recorder.evidence("a-1", frame.time);
        }
    }
    drop(recorder);
    let file = file.expect("the evidence has a file");
    assert!(
        file.is_file() && file.ends_with("evidence/a-1.npy"),
        "{}",
        file.display()
    );

    let fake = Fake::with_recordings(Config::default(), &folder).await;
    fake.step(1);
    fake.alert("a-1", 10).await;
    fake.alert("a-2", 10).await;
    let npy = get(&fake, "/v1/alerts/a-1/evidence.npy").await;
    assert_eq!(npy.status(), StatusCode::OK);
    assert_eq!(npy.bytes().await.unwrap(), std::fs::read(&file).unwrap());
    let told = json_of(get(&fake, "/v1/alerts/a-1/evidence.json").await).await;
    let position = told["position"].as_u64().unwrap() as usize;
    assert_eq!(told["frames"][position]["index"], 10, "the alert's own frame");
    assert_eq!(told["frames"][position]["claims"][0]["user"], "u-1");
    assert_eq!(told["frames"][position]["poses"][0]["z_m"], 300.0);
    let png = get(&fake, "/v1/alerts/a-1/evidence.png?scale=2").await;
    assert_eq!(png.headers()[header::CONTENT_TYPE], "image/png");
    assert_eq!(
        size_of(&png.bytes().await.unwrap()),
        (3 * 128 + 2 * 8, 128),
        "data, model, residual"
    );
    let png = get(&fake, "/v1/alerts/a-1/evidence.png?scale=2&panels=data").await;
    assert_eq!(size_of(&png.bytes().await.unwrap()), (128, 128));
    problem(get(&fake, "/v1/alerts/a-1/evidence.png?panels=model").await, 400).await;

    for ending in ["npy", "json", "png"] {
        let detail = problem(get(&fake, &format!("/v1/alerts/a-2/evidence.{ending}")).await, 404).await;
        assert!(detail.contains("recorded"), "{detail}");
        problem(get(&fake, &format!("/v1/alerts/a-3/evidence.{ending}")).await, 404).await;
    }
    fake.stop().await;
}

#[tokio::test]
async fn without_a_recorder_an_alert_of_this_run_has_a_picture() {
    let fake = Fake::start(Config::default()).await;
    fake.step(1);
    fake.alert("a-1", 1).await;
    problem(get(&fake, "/v1/alerts/a-1/evidence.png").await, 404).await;
    let alert = fake.journal.alert("a-1").unwrap().unwrap();
    fake.feed.illustrate(&[alert], &crate::fixtures::snapshot(1));
    let png = get(&fake, "/v1/alerts/a-1/evidence.png").await;
    assert_eq!(size_of(&png.bytes().await.unwrap()), (256, 256));
    problem(get(&fake, "/v1/alerts/a-1/evidence.png?panels=all").await, 404).await;
    fake.stop().await;
}
