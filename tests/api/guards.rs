//! Strangers' pages, ambiguous hosts and greedy clients.

use std::time::Instant;

use oapwatch::api::Config;
use reqwest::{Client, StatusCode, header};
use tokio::io::AsyncWriteExt;
use tokio::net::TcpStream;
use tokio_tungstenite::tungstenite::client::IntoClientRequest;

use crate::fake::{Fake, audited, until_closed};

#[tokio::test]
async fn names_and_origins_of_strangers_are_refused() {
    let fake = Fake::start(Config {
        allowed_hosts: vec!["uav.local".into()],
        ..Config::default()
    })
    .await;
    fake.step(1);
    for (host, expected) in [
        (fake.address.to_string(), 200),
        ("localhost:8787".into(), 200),
        ("uav.local".into(), 200),
        ("rebound.example".into(), 421),
    ] {
        let request = Client::new().get(fake.url("/v1/positions")).header(header::HOST, &host);
        assert_eq!(request.send().await.unwrap().status().as_u16(), expected, "{host}");
    }
    let claim = r#"{"time":"2026-11-21T08:00:00Z","user":"u","x_m":1,"y_m":1}"#;
    for (origin, expected) in [
        (format!("http://{}", fake.address), 200),
        ("https://evil.example".into(), 403),
        ("null".into(), 403),
    ] {
        let request = Client::new()
            .post(fake.url("/v1/claims"))
            .header(header::ORIGIN, &origin)
            .body(claim);
        assert_eq!(request.send().await.unwrap().status().as_u16(), expected, "{origin}");
        let mut stream = format!("ws://{}/v1/stream", fake.address)
            .into_client_request()
            .unwrap();
        stream.headers_mut().insert(header::ORIGIN, origin.parse().unwrap());
        assert_eq!(
            tokio_tungstenite::connect_async(stream).await.is_ok(),
            expected == 200,
            "{origin}"
        );
    }
    fake.stop().await;
}

#[tokio::test]
async fn other_pages_may_read_only_when_listed() {
    let origin = "https://ops.example.org";
    let closed = Fake::start(Config::default()).await;
    let answer = Client::new().get(closed.url("/healthz")).header(header::ORIGIN, origin);
    assert!(
        !answer
            .send()
            .await
            .unwrap()
            .headers()
            .contains_key("access-control-allow-origin")
    );
    closed.stop().await;
    let open = Fake::start(Config {
        allowed_origins: vec![origin.into()],
        ..Config::default()
    })
    .await;
    let answer = Client::new().get(open.url("/healthz")).header(header::ORIGIN, origin);
    assert_eq!(
        answer.send().await.unwrap().headers()["access-control-allow-origin"],
        origin
    );
    let stranger = Client::new()
        .get(open.url("/healthz"))
        .header(header::ORIGIN, "https://evil.example");
    assert!(
        !stranger
            .send()
            .await
            .unwrap()
            .headers()
            .contains_key("access-control-allow-origin")
    );
    open.stop().await;
}

#[tokio::test]
async fn the_page_may_load_nothing_from_elsewhere() {
    let fake = Fake::start(Config::default()).await;
    let page = Client::new().get(fake.url("/")).send().await.unwrap();
    let policy = page.headers()["content-security-policy"].to_str().unwrap().to_owned();
    assert!(
        policy.contains("default-src 'none'") && policy.contains("frame-ancestors 'none'"),
        "{policy}"
    );
    assert!(!policy.contains("unsafe"), "{policy}");
    assert_eq!(page.headers()["x-content-type-options"], "nosniff");
    fake.stop().await;
}

#[tokio::test]
async fn who_asks_too_often_waits() {
    let fake = Fake::start(Config {
        requests_per_second: 5,
        ..Config::default()
    })
    .await;
    let client = Client::new();
    let mut limited = None;
    for _ in 0..200 {
        let answer = client.get(fake.url("/openapi.json")).send().await.unwrap();
        if answer.status() == StatusCode::TOO_MANY_REQUESTS {
            limited = Some(answer);
            break;
        }
    }
    let limited = limited.expect("two hundred at once are too many");
    assert!(limited.headers().contains_key(header::RETRY_AFTER));
    assert_eq!(limited.headers()[header::CONTENT_TYPE], "application/problem+json");
    for _ in 0..50 {
        let probe = client.get(fake.url("/healthz")).send().await.unwrap();
        assert_eq!(probe.status(), StatusCode::OK, "a supervisor's probe is not counted");
    }
    let rows = audited(&fake, "request.refused").await;
    assert_eq!(rows.len(), 1, "{rows:?}");
    assert_eq!(rows[0].entry.client, "127.0.0.1");
    fake.stop().await;
}

/// Sends bytes as they are and gives the whole answer.
async fn raw(fake: &Fake, request: &str) -> String {
    let mut stream = TcpStream::connect(fake.address).await.unwrap();
    stream.write_all(request.as_bytes()).await.unwrap();
    until_closed(stream).await
}

#[tokio::test]
async fn a_request_names_exactly_one_host() {
    let fake = Fake::start(Config::default()).await;
    for (hosts, expected) in [
        ("Host: localhost\r\n", "HTTP/1.1 200"),
        ("", "HTTP/1.1 400"),
        ("Host: localhost\r\nHost: rebound.example\r\n", "HTTP/1.1 400"),
        ("Host: localhost\r\nHost: localhost\r\n", "HTTP/1.1 400"),
        ("Host: \u{e4}.example\r\n", "HTTP/1.1 400"),
    ] {
        let said = raw(
            &fake,
            &format!("GET /healthz HTTP/1.1\r\n{hosts}Connection: close\r\n\r\n"),
        )
        .await;
        assert!(said.starts_with(expected), "{hosts:?}: {said}");
    }
    fake.stop().await;
}

#[tokio::test]
async fn behind_a_trusted_proxy_its_clients_are_told_apart() {
    let limited = |trusted: &[&str]| Config {
        requests_per_second: 1,
        trusted_proxies: trusted.iter().map(|t| (*t).to_owned()).collect(),
        ..Config::default()
    };
    for (trusted, is_told_apart) in [(&["127.0.0.0/8"][..], true), (&["192.0.2.0/24"], false)] {
        let fake = Fake::start(limited(trusted)).await;
        let client = Client::new();
        let started = Instant::now();
        let mut served = 0;
        for k in 0..60 {
            let request = client
                .get(fake.url("/openapi.json"))
                .header("x-forwarded-for", format!("203.0.113.{k}"));
            served += usize::from(request.send().await.unwrap().status() == StatusCode::OK);
        }
        // One client has a burst of two and earns a request a second. Of sixty, a few may share one of 1024 buckets.
        let of_one = 3 + started.elapsed().as_secs() as usize;
        match is_told_apart {
            true => assert!(served >= 55, "{served} served"),
            false => assert!(served <= of_one, "{served} served, {of_one} of one client"),
        }
        fake.stop().await;
    }
}
