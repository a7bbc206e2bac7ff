//! Bodies of POST requests: media types, encodings, sizes.

use std::io::Write;

use oapwatch::api::Config;
use reqwest::{Client, StatusCode};

use crate::fake::Fake;

const CLAIM: &str = r#"{"time":"2026-11-21T08:00:00Z","user":"u-1","x_m":1,"y_m":2}"#;

fn gzip(text: &[u8]) -> Vec<u8> {
    let mut packed = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
    packed.write_all(text).unwrap();
    packed.finish().unwrap()
}

async fn post(fake: &Fake, headers: &[(&str, &str)], body: Vec<u8>) -> (StatusCode, serde_json::Value) {
    let mut request = Client::new().post(fake.url("/v1/claims")).body(body);
    for (name, value) in headers {
        request = request.header(*name, *value);
    }
    let answer = request.send().await.unwrap();
    (
        answer.status(),
        serde_json::from_str(&answer.text().await.unwrap()).unwrap(),
    )
}

#[tokio::test]
async fn claims_are_taken_plain_or_as_gzip_and_nothing_else() {
    let fake = Fake::start(Config::default()).await;
    let plain = CLAIM.as_bytes().to_vec();
    for (headers, body, expected) in [
        (&[][..], plain.clone(), 200),
        (&[("content-encoding", "identity")], plain.clone(), 200),
        (&[("content-encoding", "gzip")], gzip(&plain), 200),
        (&[("content-type", "application/jsonl")], plain.clone(), 200),
        (&[], format!("\u{feff}{CLAIM}").into_bytes(), 200),
        (&[("content-encoding", "br")], plain.clone(), 415),
        (&[("content-encoding", "gzip, gzip")], gzip(&gzip(&plain)), 415),
        (&[("content-type", "application/pdf")], plain.clone(), 415),
        // What is not said is not guessed.
        (&[], gzip(&plain), 422),
        (&[("content-encoding", "gzip")], plain.clone(), 400),
        // 64 MiB of nothing, in 64 KiB.
        (&[("content-encoding", "gzip")], gzip(&vec![b' '; 64 << 20]), 413),
    ] {
        let (status, answer) = post(&fake, headers, body).await;
        assert_eq!(status, expected, "{headers:?}: {answer}");
        if expected == 415 {
            let detail = answer["detail"].as_str().unwrap();
            let value = headers[0].1;
            assert!(detail.contains("expected") && detail.contains(value), "{detail}");
        }
    }
    fake.stop().await;
}

#[tokio::test]
async fn claims_are_taken_in_the_formats_of_networks() {
    let fake = Fake::start(Config::default()).await;
    let csv = "time,user,x_m,y_m\n2026-11-21T08:00:00Z,u-1,1.5,2\n2026-11-21T08:00:01Z,u-2,three,2\n";
    let (status, answer) = post(&fake, &[("content-type", "text/csv; charset=utf-8")], csv.into()).await;
    assert_eq!(
        (status.as_u16(), &answer["accepted"], &answer["refused"]),
        (200, &1.into(), &1.into())
    );
    assert_eq!(answer["reasons"][0]["line"], 3, "{answer}");

    let event =
        "<event uid=\"a\" type=\"a-f-G\" time=\"2026-11-21T08:00:00Z\">\n<point lat=\"48\" lon=\"11\"/>\n</event>\n";
    let (status, answer) = post(&fake, &[("content-type", "application/xml")], event.repeat(2).into()).await;
    assert_eq!((status.as_u16(), &answer["refused"]), (422, &2.into()));
    assert_eq!(answer["reasons"][1]["line"], 4, "{answer}");
    assert!(
        answer["detail"].as_str().unwrap().contains("[world] origin"),
        "{answer}"
    );

    let shape = r#"{"user":"u-1","time":1795248000,"shape":"LOCAL_2D_POINT_UNCERTAINTY_ELLIPSE","localOrigin":{},"point":{"x":1,"y":2},
        "uncertaintyEllipse":{"semiMajor":5,"semiMinor":1,"orientationMajor":90},"confidence":95}"#;
    for (format, expected) in [("gad", 200), ("cot", 422), ("pigeon", 400)] {
        let request = Client::new().post(fake.url(&format!("/v1/claims?format={format}")));
        let answer = request.body(shape).send().await.unwrap();
        assert_eq!(answer.status().as_u16(), expected, "{format}");
    }
    fake.stop().await;
}
