//! Tokens, TLS, strangers' pages, slow and greedy clients.

use std::path::Path;
use std::time::{Duration, Instant};

use futures_util::StreamExt;
use oapwatch::api::{Config, Server};
use oapwatch::journal::AuditRecord;
use reqwest::{Client, Method, StatusCode, header};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpStream, UnixStream};
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
    std::fs::write(dir.path().join("short"), "anna:s3cret-of-anna\nb\n").unwrap();
    let short = Server::new(config("short")).err().unwrap().to_string();
    assert!(short.contains("short: line 2"), "{short}");
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

/// Rows of the audit log about one action, newest first.
async fn audited(fake: &Fake, action: &str) -> Vec<AuditRecord> {
    fake.journal.settled().await;
    let rows = fake.journal.audit_log(None, 100).unwrap();
    let of = |r: &AuditRecord| serde_json::to_value(r.entry.action).unwrap() == action;
    rows.into_iter().filter(of).collect()
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
async fn a_revoked_token_s_streams_end_within_a_second() {
    let dir = tempfile::tempdir().unwrap();
    let fake = Fake::start(with_tokens(dir.path())).await;
    fake.step(1);
    let url = format!("ws://{}/v1/stream", fake.address);
    let open = async |token: &str| {
        let mut request = url.as_str().into_client_request().unwrap();
        let bearer = format!("Bearer {token}");
        request.headers_mut().insert("authorization", bearer.parse().unwrap());
        let (mut socket, _) = tokio_tungstenite::connect_async(request).await.unwrap();
        assert!(socket.next().await.unwrap().unwrap().is_text());
        let events = Client::new().get(fake.url("/v1/events")).bearer_auth(token).send();
        let mut events = events.await.unwrap();
        assert!(events.chunk().await.unwrap().is_some());
        (socket, events)
    };
    let (mut revoked, mut revoked_events) = open("full-token-1").await;
    let (mut kept, _kept_events) = open("full-token-2").await;
    let (mut reader, mut reader_events) = open("read-token").await;

    // One line is taken out of a file.
    std::fs::write(dir.path().join("full"), "full-token-2\n").unwrap();
    let started = Instant::now();
    let close = revoked.next().await.unwrap().unwrap();
    assert!(close.to_string().contains("revoked"), "{close}");
    while revoked_events.chunk().await.unwrap().is_some() {}
    assert!(started.elapsed() < Duration::from_secs(1), "{:?}", started.elapsed());

    // A file is deleted: it has no tokens any more.
    std::fs::remove_file(dir.path().join("read")).unwrap();
    let started = Instant::now();
    assert!(reader.next().await.unwrap().unwrap().is_close());
    while reader_events.chunk().await.unwrap().is_some() {}
    assert!(started.elapsed() < Duration::from_secs(1), "{:?}", started.elapsed());
    assert_eq!(
        status(&fake, Method::GET, "/v1/positions", Some("read-token")).await,
        401
    );

    fake.step(2);
    assert!(
        kept.next().await.unwrap().unwrap().is_text(),
        "who is not revoked stays"
    );
    fake.stop().await;
}

#[tokio::test]
async fn named_tokens_stand_in_the_alert_and_in_the_audit_log() {
    let dir = tempfile::tempdir().unwrap();
    let tokens = "anna:s3cret-of-anna\nplain-token-of-nobody\nold:token-with-a-colon\n";
    std::fs::write(dir.path().join("full"), tokens).unwrap();
    std::fs::write(dir.path().join("read"), "wall:s3cret-of-the-wall\n").unwrap();
    let fake = Fake::start(Config {
        token_file: Some(dir.path().join("full")),
        read_token_file: Some(dir.path().join("read")),
        ..Config::default()
    })
    .await;
    fake.alert("a", 1).await;
    let path = "/v1/alerts/a/acknowledge";
    assert_eq!(status(&fake, Method::POST, path, Some("s3cret-of-the-wall")).await, 403);
    assert_eq!(status(&fake, Method::POST, path, Some("anna")).await, 401);
    for whole_line in ["old:token-with-a-colon", "token-with-a-colon", "plain-token-of-nobody"] {
        assert_eq!(status(&fake, Method::GET, "/v1/audit", Some(whole_line)).await, 200);
    }
    assert_eq!(
        status(&fake, Method::GET, "/v1/audit", Some("s3cret-of-the-wall")).await,
        403
    );
    assert_eq!(status(&fake, Method::POST, path, Some("s3cret-of-anna")).await, 200);
    let alert = fake.journal.alert("a").unwrap().unwrap();
    assert_eq!(alert.acknowledgement.unwrap().by.as_deref(), Some("anna"));

    let rows = audited(&fake, "alert.acknowledge").await;
    let entry = &rows[0].entry;
    assert_eq!(
        (entry.actor.as_deref(), entry.target.as_deref()),
        (Some("anna"), Some("a"))
    );
    assert_eq!(entry.client, "127.0.0.1");
    let refused = audited(&fake, "request.refused").await;
    let actors: Vec<_> = refused.iter().map(|r| r.entry.actor.as_deref()).collect();
    assert!(actors.contains(&Some("wall")) && actors.contains(&None), "{refused:?}");
    fake.stop().await;
}

#[tokio::test]
async fn claims_that_are_posted_again_and_again_share_a_row_of_the_audit_log() {
    let fake = Fake::start(Config::default()).await;
    let claim = r#"{"time":"2026-11-21T08:00:00Z","user":"u","x_m":1,"y_m":1}"#;
    for _ in 0..30 {
        let posted = Client::new().post(fake.url("/v1/claims")).body(claim).send().await;
        assert_eq!(posted.unwrap().status(), StatusCode::OK);
    }
    let rows = audited(&fake, "claims.post").await;
    assert_eq!(rows.len(), 1, "{rows:?}");
    assert_eq!(rows[0].entry.detail.as_deref(), Some("1 accepted, 0 refused"));
    let journal = fake.journal.clone();
    fake.stop().await;
    journal.settled().await;
    let rows = journal.audit_log(None, 100).unwrap();
    let counts: Vec<u64> = rows.iter().map(|r| r.entry.count).collect();
    assert_eq!(
        counts,
        [29, 1],
        "the rest is written when the window ends or the daemon stops"
    );
    assert_eq!(rows[0].entry.detail.as_deref(), Some("29 accepted, 0 refused"));
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
