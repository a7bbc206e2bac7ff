//! Tokens: what they open, how they change, and what the audit log keeps of them.

use std::path::Path;
use std::time::{Duration, Instant};

use futures_util::StreamExt;
use oapwatch::api::{Config, Server};
use reqwest::{Client, Method, StatusCode, header};
use tokio_tungstenite::tungstenite::client::IntoClientRequest;

use crate::fake::{Fake, PATIENCE, audited};

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
