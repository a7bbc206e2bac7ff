//! REST: positions, alerts, claims, problem details.

use oapwatch::api::Config;
use reqwest::{Client, StatusCode, header};
use serde_json::{Value, json};

use crate::fake::{Fake, get, json_of, problem};

#[tokio::test]
async fn positions_and_users_are_as_the_report_says() {
    let fake = Fake::start(Config::default()).await;
    problem(get(&fake, "/v1/positions").await, 503).await;
    fake.step(7);
    let body = json_of(get(&fake, "/v1/positions").await).await;
    assert_eq!(body["frame"], 7);
    assert_eq!(body["emitters"].as_array().unwrap().len(), 3);
    assert_eq!(body["emitters"][1]["user"], "u-2");
    assert_eq!(body["emitters"][1]["status"], "mismatch");
    assert_eq!(body["emitters"][2]["user"], Value::Null);
    assert_eq!(body["unseen"], json!(["u-9"]));

    let body = json_of(get(&fake, "/v1/users/u-2/position").await).await;
    assert_eq!(body["position"]["x_m"], 55.0);
    assert_eq!(body["claim"]["x_m"], 90.0);
    let body = json_of(get(&fake, "/v1/users/u-9/position").await).await;
    assert_eq!(body["position"], Value::Null);
    let detail = problem(get(&fake, "/v1/users/nobody/position").await, 404).await;
    assert!(detail.contains("nobody"), "{detail}");
    fake.stop().await;
}

#[tokio::test]
async fn an_etag_saves_the_transfer_until_something_changes() {
    let fake = Fake::start(Config::default()).await;
    fake.step(1);
    for path in ["/v1/positions", "/v1/alerts", "/v1/frame.png", "/v1/status", "/"] {
        let tag = get(&fake, path).await.headers()[header::ETAG].clone();
        let again = Client::new().get(fake.url(path)).header(header::IF_NONE_MATCH, &tag);
        let again = again.send().await.unwrap();
        assert_eq!(again.status(), StatusCode::NOT_MODIFIED, "{path}");
        assert!(again.bytes().await.unwrap().is_empty());
    }
    let tag = get(&fake, "/v1/positions").await.headers()[header::ETAG].clone();
    fake.step(2);
    let again = Client::new()
        .get(fake.url("/v1/positions"))
        .header(header::IF_NONE_MATCH, &tag);
    assert_eq!(again.send().await.unwrap().status(), StatusCode::OK);
    fake.stop().await;
}

#[tokio::test]
async fn alerts_are_paged_newest_first_and_filtered() {
    let fake = Fake::start(Config::default()).await;
    for k in 0..25 {
        fake.alert(&format!("a-{k:02}"), k / 2).await;
    }
    let mut seen = Vec::new();
    let mut path = "/v1/alerts?limit=10".to_owned();
    loop {
        let page = json_of(get(&fake, &path).await).await;
        seen.extend(
            page["alerts"]
                .as_array()
                .unwrap()
                .iter()
                .map(|a| a["id"].as_str().unwrap().to_owned()),
        );
        match page["next_cursor"].as_str() {
            Some(cursor) => path = format!("/v1/alerts?limit=10&cursor={cursor}"),
            None => break,
        }
    }
    let expected: Vec<String> = (0..25).rev().map(|k| format!("a-{k:02}")).collect();
    assert_eq!(seen, expected);

    let since = json_of(get(&fake, "/v1/alerts?since=2025-11-21T08:00:11Z").await).await;
    assert_eq!(since["alerts"].as_array().unwrap().len(), 3);
    let none = json_of(get(&fake, "/v1/alerts?kind=user_unseen").await).await;
    assert_eq!(none["alerts"], json!([]));
    for wrong in [
        "limit=0",
        "limit=1001",
        "limit=x",
        "state=sleeping",
        "since=yesterday",
        "cursor=%21",
        "nosuch=1",
    ] {
        problem(get(&fake, &format!("/v1/alerts?{wrong}")).await, 400).await;
    }
    fake.stop().await;
}

#[tokio::test]
async fn an_alert_is_acknowledged_once_and_for_all() {
    let fake = Fake::start(Config::default()).await;
    fake.alert("a-1", 1).await;
    let acknowledge = |id: &str| {
        Client::new()
            .post(fake.url(&format!("/v1/alerts/{id}/acknowledge")))
            .send()
    };
    for _ in 0..2 {
        let answer = acknowledge("a-1").await.unwrap();
        assert_eq!(answer.status(), StatusCode::OK);
        assert_eq!(json_of(answer).await["state"], "acknowledged");
    }
    assert_eq!(
        json_of(get(&fake, "/v1/alerts/a-1").await).await["state"],
        "acknowledged"
    );
    problem(acknowledge("a-2").await.unwrap(), 404).await;
    fake.stop().await;
}

#[tokio::test]
async fn an_acknowledgement_has_a_note_and_can_be_undone() {
    let fake = Fake::start(Config::default()).await;
    fake.alert("a-1", 1).await;
    let path = fake.url("/v1/alerts/a-1/acknowledge");
    let post = |body: &str| Client::new().post(&path).body(body.to_owned()).send();
    let noted = post("{\"note\": \" seen from the tower\\nunit 3 goes \"}")
        .await
        .unwrap();
    assert_eq!(noted.status(), StatusCode::OK);
    let alert = json_of(noted).await;
    assert_eq!(alert["state"], "acknowledged");
    assert_eq!(alert["acknowledgement"]["note"], "seen from the tower\nunit 3 goes");
    assert_eq!(alert["acknowledgement"]["by"], Value::Null);

    let undone = Client::new().delete(&path).send().await.unwrap();
    assert_eq!(undone.status(), StatusCode::OK);
    let stored = json_of(get(&fake, "/v1/alerts/a-1").await).await;
    assert_eq!(stored["state"], "open");
    assert!(stored["acknowledgement"]["withdrawn"]["at"].is_string(), "{stored}");
    assert_eq!(stored["acknowledgement"]["note"], "seen from the tower\nunit 3 goes");

    for wrong in [
        "{\"note\": 7}",
        "{\"nota\": \"x\"}",
        "[",
        "{\"note\": \"bell \\u0007\"}",
        &format!("{{\"note\": \"{}\"}}", "x".repeat(1001)),
    ] {
        problem(post(wrong).await.unwrap(), 422).await;
    }
    problem(post(&"x".repeat(20_000)).await.unwrap(), 413).await;
    let text = Client::new()
        .post(&path)
        .header("content-type", "text/plain")
        .body("hello");
    problem(text.send().await.unwrap(), 415).await;
    problem(
        Client::new()
            .delete(fake.url("/v1/alerts/a-2/acknowledge"))
            .send()
            .await
            .unwrap(),
        404,
    )
    .await;

    let log = json_of(get(&fake, "/v1/audit?limit=1").await).await;
    assert_eq!(log["records"][0]["action"], "alert.unacknowledge");
    let before = log["next_before"].as_u64().unwrap();
    let log = json_of(get(&fake, &format!("/v1/audit?before={before}")).await).await;
    assert_eq!(log["records"][0]["action"], "alert.acknowledge");
    assert_eq!(log["records"][0]["detail"], "seen from the tower\nunit 3 goes");
    assert_eq!(log["next_before"], Value::Null);
    fake.stop().await;
}

#[tokio::test]
async fn claims_are_counted_and_refused_one_by_one() {
    let fake = Fake::start(Config::default()).await;
    let post = |body: &str| Client::new().post(fake.url("/v1/claims")).body(body.to_owned()).send();
    let good =
        r#"{"time":"2026-11-21T08:00:00.000Z","user":"u-17","x_m":12.5,"y_m":-80.0,"sigma_m":1.0,"state":"active"}"#;
    let far = r#"{"time":"2026-11-21T08:00:00Z","user":"u-18","x_m":1e6,"y_m":0}"#;

    let one = post(good).await.unwrap();
    assert_eq!(one.status(), StatusCode::OK);
    assert_eq!(json_of(one).await, json!({"accepted": 1, "refused": 0, "reasons": []}));

    let pretty = serde_json::to_string_pretty(&serde_json::from_str::<Value>(good).unwrap()).unwrap();
    assert_eq!(json_of(post(&pretty).await.unwrap()).await["accepted"], 1);

    let mixed = json_of(post(&format!("{good}\n\nnot json\n{far}\n{good}\n")).await.unwrap()).await;
    assert_eq!((&mixed["accepted"], &mixed["refused"]), (&json!(2), &json!(2)));
    let lines: Vec<u64> = mixed["reasons"]
        .as_array()
        .unwrap()
        .iter()
        .map(|r| r["line"].as_u64().unwrap())
        .collect();
    assert_eq!(lines, [3, 4]);

    let detail = problem(post(far).await.unwrap(), 409).await;
    assert!(detail.contains("x_m"), "{detail}");
    let detail = problem(post("not json").await.unwrap(), 422).await;
    assert!(detail.contains("line 1"), "{detail}");
    problem(post("").await.unwrap(), 422).await;
    let image = Client::new()
        .post(fake.url("/v1/claims"))
        .header("content-type", "image/png")
        .body(good);
    problem(image.send().await.unwrap(), 415).await;
    problem(post(&"x".repeat(5 << 20)).await.unwrap(), 413).await;
    fake.stop().await;
}

#[tokio::test]
async fn every_error_is_problem_details() {
    let fake = Fake::start(Config::default()).await;
    problem(get(&fake, "/nothing/here").await, 404).await;
    problem(get(&fake, "/page/nothing.js").await, 404).await;
    let put = Client::new().put(fake.url("/v1/positions")).send().await.unwrap();
    assert!(put.headers()[header::ALLOW].to_str().unwrap().contains("GET"));
    problem(put, 405).await;
    problem(get(&fake, "/v1/stream").await, 400).await;
    problem(get(&fake, "/v1/users/%ff/position").await, 400).await;
    fake.stop().await;
}

#[tokio::test]
async fn the_frame_is_a_picture() {
    let fake = Fake::start(Config::default()).await;
    problem(get(&fake, "/v1/frame.png").await, 503).await;
    fake.step(1);
    for (query, side) in [("", 512), ("?scale=1&detections=false", 64), ("?scale=3", 192)] {
        let answer = get(&fake, &format!("/v1/frame.png{query}")).await;
        assert_eq!(answer.headers()[header::CONTENT_TYPE], "image/png");
        let bytes = answer.bytes().await.unwrap();
        let mut picture = png::Decoder::new(std::io::Cursor::new(&bytes)).read_info().unwrap();
        assert_eq!(picture.info().size(), (side, side), "{query}");
        picture
            .next_frame(&mut vec![0; picture.output_buffer_size().unwrap()])
            .unwrap();
    }
    problem(get(&fake, "/v1/frame.png?scale=1000").await, 400).await;
    fake.stop().await;
}

#[tokio::test]
async fn probes_tell_living_from_ready() {
    let fake = Fake::start(Config::default()).await;
    assert_eq!(get(&fake, "/healthz").await.status(), StatusCode::OK);
    problem(get(&fake, "/readyz").await, 503).await;
    fake.step(1);
    assert_eq!(get(&fake, "/readyz").await.status(), StatusCode::OK);
    fake.ready.store(false, std::sync::atomic::Ordering::Release);
    problem(get(&fake, "/readyz").await, 503).await;
    assert_eq!(get(&fake, "/metrics").await.status(), StatusCode::OK);
    fake.stop().await;
}

#[tokio::test]
async fn the_description_is_openapi_3_1_and_lists_every_path() {
    let fake = Fake::start(Config::default()).await;
    let api = json_of(get(&fake, "/openapi.json").await).await;
    assert!(api["openapi"].as_str().unwrap().starts_with("3.1"));
    for path in [
        "/v1/positions",
        "/v1/positions.geojson",
        "/v1/alerts.geojson",
        "/v1/users/{user}/position",
        "/v1/alerts",
        "/v1/alerts.csv",
        "/v1/history.csv",
        "/v1/webhooks/{name}/test",
        "/v1/alerts/{id}",
        "/v1/alerts/{id}/acknowledge",
        "/v1/alerts/{id}/evidence.npy",
        "/v1/alerts/{id}/evidence.png",
        "/v1/alerts/{id}/evidence.json",
        "/v1/known-lights",
        "/v1/known-lights/{id}",
        "/v1/zones",
        "/v1/maintenance",
        "/v1/maintenance/{id}",
        "/v1/audit",
        "/v1/claims",
        "/v1/frame.png",
        "/v1/background",
        "/v1/background/picture",
        "/v1/background/tiles/{zoom}/{column}/{row}",
        "/v1/stream",
        "/v1/events",
        "/healthz",
        "/readyz",
        "/metrics",
    ] {
        assert!(api["paths"][path].is_object(), "{path}");
    }
    let refused = |path: &str, method: &str, status: &str| api["paths"][path][method]["responses"][status].is_object();
    assert!(refused("/v1/positions", "get", "401") && refused("/v1/zones", "put", "403"));
    assert!(!refused("/healthz", "get", "401") && !refused("/v1/positions", "get", "403"));
    let acknowledge = &api["paths"]["/v1/alerts/{id}/acknowledge"];
    assert!(acknowledge["post"]["requestBody"].is_object() && acknowledge["delete"].is_object());
    assert_ne!(
        acknowledge["post"]["requestBody"]["required"], true,
        "a note may be left out"
    );
    fake.stop().await;
}

#[tokio::test]
async fn long_answers_are_compressed_for_those_who_can_read_them() {
    let fake = Fake::start(Config::default()).await;
    let plain = get(&fake, "/openapi.json").await;
    assert!(!plain.headers().contains_key(header::CONTENT_ENCODING));
    let gzip = Client::new()
        .get(fake.url("/openapi.json"))
        .header(header::ACCEPT_ENCODING, "gzip");
    let gzip = gzip.send().await.unwrap();
    assert_eq!(gzip.headers()[header::CONTENT_ENCODING], "gzip");
    assert!(gzip.bytes().await.unwrap().len() < plain.bytes().await.unwrap().len() / 2);
    fake.stop().await;
}
