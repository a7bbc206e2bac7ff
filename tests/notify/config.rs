//! What a `[[webhook]]` may say, and whom it trusts.

use std::path::Path;
use std::sync::{Arc, Mutex};

use axum::Router;
use axum::http::StatusCode;
use axum::response::IntoResponse;
use oapwatch::monitor::{AlertEventKind, AlertKind};
use oapwatch::notify::{self, Clock};

use super::receiver::{Answer, Seen, take};
use super::sender::{Daemon, event, on_disk, until, webhook};

#[test]
fn a_host_without_authorities_is_named_and_needs_none_for_plain_http() {
    let dir = tempfile::tempdir().unwrap();
    std::fs::write(dir.path().join("secret"), "whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw").unwrap();
    let check = |url: &str| {
        let file = dir.path().join("oapwatch.toml");
        std::fs::write(&file, format!("[[webhook]]\nurl = {url:?}\nsecret_file = \"secret\"\n")).unwrap();
        let mut program = std::process::Command::new(env!("CARGO_BIN_EXE_oapwatch"));
        let nothing = dir.path().join("nothing");
        program
            .arg("check")
            .arg(&file)
            .env("SSL_CERT_FILE", &nothing)
            .env("SSL_CERT_DIR", &nothing);
        let said = program.output().unwrap();
        (said.status.code(), String::from_utf8(said.stderr).unwrap())
    };
    let (code, told) = check("https://hooks.example.org/in");
    assert_eq!(code, Some(2), "{told}");
    assert!(
        told.contains("[[webhook]] 1: url: ") && told.contains("ca-certificates") && !told.contains("builder error"),
        "{told}"
    );
    let (code, told) = check("http://127.0.0.1:9/in");
    assert_eq!(code, Some(0), "{told}");
}

#[test]
fn a_webhook_that_cannot_work_is_a_clear_config_error() {
    let dir = tempfile::tempdir().unwrap();
    let good = webhook(dir.path(), "https://hooks.example.org/in?token=hunter2");
    assert_eq!(
        notify::load(std::slice::from_ref(&good)).unwrap()[0].shown_url,
        "https://hooks.example.org/in"
    );
    let message = |config: notify::Config| notify::load(&[config]).unwrap_err().to_string();
    let with = |change: &dyn Fn(&mut notify::Config)| {
        let mut config = good.clone();
        change(&mut config);
        message(config)
    };
    assert!(with(&|c| c.url = "hooks.example.org".to_owned()).contains("url"));
    assert!(with(&|c| c.url = "ftp://example.org/".to_owned()).contains("ftp://"));
    assert!(with(&|c| c.url = "http://example.org/?token=hunter2".to_owned()).contains("allow_http"));
    assert!(!with(&|c| c.url = "http://example.org/?token=hunter2".to_owned()).contains("hunter2"));
    assert!(with(&|c| c.secret_file = dir.path().join("none")).contains("none"));
    std::fs::write(dir.path().join("bad"), "# comment\nhunter2\n").unwrap();
    let bad = with(&|c| c.secret_file = dir.path().join("bad"));
    assert!(
        bad.contains("line 2") && bad.contains("whsec_") && !bad.contains("hunter2"),
        "{bad}"
    );
    assert!(with(&|c| c.kinds = Some(vec![])).contains("kinds"));
    assert!(with(&|c| c.timeout_s = 0.0).contains("timeout_s"));
    assert!(with(&|c| c.cool_down_s = -1.0).contains("cool_down_s"));
    assert!(with(&|c| c.cool_down_s = f64::NAN).contains("cool_down_s"));
    assert!(with(&|c| c.timeout_s = f64::NAN).contains("timeout_s"));
    assert!(with(&|c| c.name = Some("a b".to_owned())).contains("name"));
    assert!(with(&|c| c.ca_file = Some(dir.path().join("bad"))).contains("ca_file"));
    let twice = notify::load(&[good.clone(), good.clone()]).unwrap_err().to_string();
    assert!(twice.contains("[[webhook]] 2") && !twice.contains("hunter2"), "{twice}");
    for url in ["http://localhost:9/", "http://127.8.0.1/", "http://[::1]:80/"] {
        let mut local = good.clone();
        local.url = url.to_owned();
        notify::load(&[local]).unwrap();
    }
}

#[tokio::test]
async fn https_is_verified_against_the_authority_that_is_named() {
    let dir = tempfile::tempdir().unwrap();
    let tls = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/tls");
    let _ = rustls::crypto::ring::default_provider().install_default();
    let server = axum_server::tls_rustls::RustlsConfig::from_pem_file(tls.join("server.pem"), tls.join("server.key"))
        .await
        .unwrap();
    let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    listener.set_nonblocking(true).unwrap();
    let port = listener.local_addr().unwrap().port();
    let seen: Arc<Mutex<Vec<Seen>>> = Arc::default();
    let answer: Arc<Answer> = Arc::new(|_, _: &Seen| StatusCode::OK.into_response());
    let app = Router::new().fallback(take).with_state((seen.clone(), answer));
    let served = axum_server::from_tcp_rustls(listener, server)
        .unwrap()
        .serve(app.into_make_service());
    let task = tokio::spawn(served);

    let mut trusting = webhook(dir.path(), &format!("https://localhost:{port}/hook"));
    trusting.name = Some("trusting".to_owned());
    trusting.ca_file = Some(tls.join("ca.pem"));
    let mut wary = webhook(dir.path(), &format!("https://localhost:{port}/hook"));
    wary.name = Some("wary".to_owned());
    let daemon = Daemon::start(&on_disk(dir.path()), &[trusting, wary], Clock::wall());
    daemon.record(&[event(AlertEventKind::Raised, "a", AlertKind::UserUnseen)]);
    until(|| {
        daemon
            .notifier
            .status()
            .iter()
            .all(|s| s.sent > 0 || s.last_error.is_some())
    })
    .await;
    let status = daemon.notifier.status();
    assert_eq!((status[0].sent, &status[0].last_error), (1, &None));
    assert_eq!(status[1].sent, 0);
    assert!(
        status[1].last_error.as_ref().unwrap().contains("certificate"),
        "{:?}",
        status[1].last_error
    );
    assert_eq!(seen.lock().unwrap().len(), 1);
    daemon.stop().await;
    task.abort();
}
