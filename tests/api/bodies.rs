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
        (&[("content-type", "application/xml")], plain.clone(), 415),
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
