//! Tokens, TLS, strangers' pages, slow and greedy clients.

use std::path::Path;
use std::time::{Duration, Instant};

use futures_util::StreamExt;
use oapwatch::api::{Config, Server};
use reqwest::{Client, Method, StatusCode, header};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio::time::timeout;
use tokio_tungstenite::tungstenite::client::IntoClientRequest;

use crate::fake::Fake;

const PATIENCE: Duration = Duration::from_secs(20);

async fn status(fake: &Fake, method: Method, path: &str, token: Option<&str>) -> u16 {
    let mut request = Client::new().request(method, fake.url(path));
    if let Some(token) = token {
        request = request.bearer_auth(token);
    }
    request.send().await.unwrap().status().as_u16()
}

fn with_tokens(dir: &Path) -> Config {
    std::fs::write(dir.join("full"), "# operators\nfull-token-1\nfull-token-2\n").unwrap();
    std::fs::write(dir.join("read"), "read-token\n").unwrap();
    Config {
        token_file: Some(dir.join("full")),
        read_token_file: Some(dir.join("read")),
        ..Config::default()
    }
}

#[tokio::test]
async fn tokens_open_what_they_are_for_and_change_while_running() {
    let dir = tempfile::tempdir().unwrap();
    let fake = Fake::start(with_tokens(dir.path())).await;
    fake.step(1);
    fake.alert("a", 1).await;
    for (token, get, post) in [
        (None, 401, 401),
        (Some("wrong"), 401, 401),
        (Some("full-token-"), 401, 401),
        (Some("# operators"), 401, 401),
        (Some("read-token"), 200, 403),
        (Some("full-token-1"), 200, 200),
        (Some("full-token-2"), 200, 200),
    ] {
        assert_eq!(
            status(&fake, Method::GET, "/v1/positions", token).await,
            get,
            "{token:?}"
        );
        assert_eq!(status(&fake, Method::GET, "/metrics", token).await, get, "{token:?}");
        assert_eq!(
            status(&fake, Method::POST, "/v1/alerts/a/acknowledge", token).await,
            post,
            "{token:?}"
        );
    }
    for open in ["/", "/healthz", "/readyz", "/openapi.json", "/page/main.js"] {
        assert_eq!(status(&fake, Method::GET, open, None).await, 200, "{open}");
    }
    let refused = Client::new().get(fake.url("/v1/positions")).send().await.unwrap();
    assert!(
        refused.headers()[header::WWW_AUTHENTICATE]
            .to_str()
            .unwrap()
            .starts_with("Bearer")
    );

    std::fs::write(dir.path().join("full"), "rotated\n").unwrap();
    let started = Instant::now();
    while status(&fake, Method::GET, "/v1/positions", Some("rotated")).await != 200 {
        assert!(started.elapsed() < PATIENCE);
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
    assert_eq!(
        status(&fake, Method::GET, "/v1/positions", Some("full-token-1")).await,
        401
    );
    fake.stop().await;
}

#[tokio::test]
async fn a_browser_gives_its_token_as_a_subprotocol() {
    let dir = tempfile::tempdir().unwrap();
    let fake = Fake::start(with_tokens(dir.path())).await;
    let url = format!("ws://{}/v1/stream", fake.address);
    let offer = |protocols: &str| {
        let mut request = url.as_str().into_client_request().unwrap();
        request
            .headers_mut()
            .insert("sec-websocket-protocol", protocols.parse().unwrap());
        tokio_tungstenite::connect_async(request)
    };
    // "read-token" and "wrong" in base64url
    let (mut socket, answer) = offer("oapwatch.v1, bearer.cmVhZC10b2tlbg").await.unwrap();
    assert_eq!(answer.headers()["sec-websocket-protocol"], "oapwatch.v1");
    assert!(socket.next().await.unwrap().unwrap().is_text());
    for refused in ["oapwatch.v1", "oapwatch.v1, bearer.d3Jvbmc"] {
        assert!(offer(refused).await.unwrap_err().to_string().contains("401"));
    }
    fake.stop().await;
}

#[test]
fn bad_token_files_are_named_before_a_port_is_bound() {
    let dir = tempfile::tempdir().unwrap();
    let config = |file: &str| Config {
        token_file: Some(dir.path().join(file)),
        ..Config::default()
    };
    std::fs::write(dir.path().join("empty"), "\n# nothing\n").unwrap();
    let empty = Server::new(config("empty")).err().unwrap().to_string();
    assert!(empty.contains("api.token_file") && empty.contains("empty"), "{empty}");
    let missing = Server::new(config("missing")).err().unwrap().to_string();
    assert!(
        missing.contains("missing") && missing.contains("No such file"),
        "{missing}"
    );
}

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
        let answer = client.get(fake.url("/healthz")).send().await.unwrap();
        if answer.status() == StatusCode::TOO_MANY_REQUESTS {
            limited = Some(answer);
            break;
        }
    }
    let limited = limited.expect("two hundred at once are too many");
    assert!(limited.headers().contains_key(header::RETRY_AFTER));
    assert_eq!(limited.headers()[header::CONTENT_TYPE], "application/problem+json");
    fake.stop().await;
}

/// Reads until the server closes; gives what it said.
async fn until_closed(mut stream: TcpStream) -> String {
    let mut said = Vec::new();
    // A reset is a close too.
    let _ = timeout(PATIENCE, stream.read_to_end(&mut said))
        .await
        .expect("the server closes");
    String::from_utf8_lossy(&said).into_owned()
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
