//! Connections: Unix socket and TLS, limits, clients that stall.

use std::time::{Duration, Instant};

use oapwatch::api::Config;
use reqwest::Client;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpStream, UnixStream};
use tokio::time::timeout;

use crate::fake::{Fake, PATIENCE, until_closed};

#[tokio::test]
async fn a_unix_socket_serves_who_may_open_it() {
    use std::os::unix::fs::PermissionsExt;
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("api.sock");
    let fake = Fake::on_socket(Config::default(), &path).await;
    fake.step(1);
    let mode = std::fs::metadata(&path).unwrap().permissions().mode();
    assert_eq!(mode & 0o777, 0o660);
    let mut stream = UnixStream::connect(&path).await.unwrap();
    let request = "GET /v1/positions HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n";
    stream.write_all(request.as_bytes()).await.unwrap();
    let mut said = String::new();
    timeout(PATIENCE, stream.read_to_string(&mut said))
        .await
        .unwrap()
        .unwrap();
    assert!(
        said.starts_with("HTTP/1.1 200") && said.contains("\"frame\":1"),
        "{said}"
    );
    fake.stop().await;
    assert!(!path.exists(), "the socket is removed at the end");
}

#[tokio::test]
async fn slow_clients_are_cut_off() {
    let fake = Fake::start(Config {
        client_timeout_s: 0.3,
        ..Config::default()
    })
    .await;
    for opening in [
        "",
        "GET /v1/pos",
        "GET /healthz HTTP/1.1\r\nHost: localhost\r\nX-Slow: ",
    ] {
        let mut stream = TcpStream::connect(fake.address).await.unwrap();
        stream.write_all(opening.as_bytes()).await.unwrap();
        until_closed(stream).await;
    }
    let mut stream = TcpStream::connect(fake.address).await.unwrap();
    let body_never_comes = "POST /v1/claims HTTP/1.1\r\nHost: localhost\r\nContent-Length: 100\r\n\r\n{";
    stream.write_all(body_never_comes.as_bytes()).await.unwrap();
    let said = until_closed(stream).await;
    assert!(said.starts_with("HTTP/1.1 408"), "{said}");
    fake.stop().await;
}

#[tokio::test]
async fn connections_are_limited_and_come_free_again() {
    let fake = Fake::start(Config {
        max_connections: 3,
        ..Config::default()
    })
    .await;
    let mut held = Vec::new();
    for _ in 0..3 {
        let (socket, _) = tokio_tungstenite::connect_async(format!("ws://{}/v1/stream", fake.address))
            .await
            .unwrap();
        held.push(socket);
    }
    assert!(Client::new().get(fake.url("/healthz")).send().await.is_err());
    held.pop();
    let started = Instant::now();
    while Client::new().get(fake.url("/healthz")).send().await.is_err() {
        assert!(started.elapsed() < PATIENCE);
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    fake.stop().await;
}

#[tokio::test]
async fn certificates_are_served_and_follow_the_files() {
    let dir = tempfile::tempdir().unwrap();
    let install = |name: &str| {
        for part in ["cert", "key"] {
            let from = format!("{}/tests/api/tls/{name}.{part}.pem", env!("CARGO_MANIFEST_DIR"));
            std::fs::copy(from, dir.path().join(part)).unwrap();
        }
    };
    install("first");
    let fake = Fake::start(Config {
        tls_cert_file: Some(dir.path().join("cert")),
        tls_key_file: Some(dir.path().join("key")),
        hsts_max_age_s: 600,
        ..Config::default()
    })
    .await;
    let served = async || {
        let client = Client::builder()
            .tls_info(true)
            .tls_danger_accept_invalid_certs(true)
            .build()
            .unwrap();
        let answer = client
            .get(format!("https://{}/healthz", fake.address))
            .send()
            .await
            .unwrap();
        let info = answer.extensions().get::<reqwest::tls::TlsInfo>().unwrap();
        info.peer_certificate().unwrap().to_vec()
    };
    let first = served().await;
    let hsts = async |fake: &Fake| {
        let client = Client::builder().tls_danger_accept_invalid_certs(true).build().unwrap();
        let answer = client
            .get(format!("https://{}/healthz", fake.address))
            .send()
            .await
            .unwrap();
        assert_eq!(answer.version(), reqwest::Version::HTTP_2, "ALPN chooses HTTP/2");
        answer.headers().get("strict-transport-security").cloned()
    };
    assert_eq!(hsts(&fake).await.unwrap(), "max-age=600");
    assert!(
        Client::new().get(fake.url("/healthz")).send().await.is_err(),
        "plain HTTP is not served"
    );
    install("second");
    let started = Instant::now();
    while served().await == first {
        assert!(started.elapsed() < PATIENCE);
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
    fake.stop().await;
}
