//! Webhooks against real receivers on the loopback address. The worker's clock runs fast where a test spans hours.

use std::collections::HashMap;
use std::path::Path;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use axum::Router;
use axum::body::{Body, Bytes};
use axum::extract::State;
use axum::http::{HeaderMap, StatusCode};
use axum::response::{IntoResponse, Response};
use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use hmac::{Hmac, KeyInit, Mac};
use jiff::{SignedDuration, Timestamp};
use oapwatch::journal::{self, Journal};
use oapwatch::monitor::{Alert, AlertEvent, AlertEventKind, AlertKind, AlertSource, AlertState, Severity};
use oapwatch::notify::{self, Clock, Endpoint, EndpointState, EndpointStatus, Notifier};
use serde_json::Value;
use tokio::sync::oneshot;

const KEY: &[u8] = b"a key of at least twenty-four bytes";

fn start() -> Timestamp {
    "2026-11-21T08:00:00Z".parse().unwrap()
}

fn event(event: AlertEventKind, id: &str, kind: AlertKind) -> AlertEvent {
    let state = match event {
        AlertEventKind::Cleared => AlertState::Cleared,
        AlertEventKind::Acknowledged => AlertState::Acknowledged,
        _ => AlertState::Open,
    };
    let alert = Alert {
        id: id.to_owned(),
        kind,
        severity: Severity::Critical,
        state,
        raised_at: start(),
        cleared_at: None,
        user: None,
        x_m: Some(1.5),
        y_m: Some(-2.5),
        cov_m2: None,
        claimed: None,
        evidence: serde_json::json!({"log_likelihood_ratio": 12.5}),
        source: AlertSource {
            kind: "replay".to_owned(),
            frame: 7,
            file: None,
        },
    };
    AlertEvent { event, alert }
}

fn life(id: &str) -> [AlertEvent; 3] {
    use AlertEventKind::*;
    [Raised, Updated, Cleared].map(|kind| event(kind, id, AlertKind::UnclaimedEmitter))
}

/// A request as the receiver saw it.
#[derive(Clone, Debug)]
struct Seen {
    headers: HashMap<String, String>,
    body: Vec<u8>,
    accepted: bool,
}

impl Seen {
    fn json(&self) -> Value {
        serde_json::from_slice(&self.body).unwrap()
    }

    fn what(&self) -> (String, String) {
        let json = self.json();
        (
            json["alert"]["id"].as_str().unwrap().to_owned(),
            json["type"].as_str().unwrap().to_owned(),
        )
    }
}

type Answer = dyn Fn(usize, &Seen) -> Response + Send + Sync;

struct Receiver {
    url: String,
    seen: Arc<Mutex<Vec<Seen>>>,
    task: tokio::task::JoinHandle<()>,
}

impl Drop for Receiver {
    fn drop(&mut self) {
        self.task.abort();
    }
}

impl Receiver {
    /// Answers the k-th request, from 0, with `answer(k, request)`.
    async fn start(answer: impl Fn(usize, &Seen) -> Response + Send + Sync + 'static) -> Self {
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
        Self::on(listener, answer)
    }

    fn on(
        listener: tokio::net::TcpListener,
        answer: impl Fn(usize, &Seen) -> Response + Send + Sync + 'static,
    ) -> Self {
        let url = format!("http://{}/hook", listener.local_addr().unwrap());
        let seen: Arc<Mutex<Vec<Seen>>> = Arc::default();
        let answer: Arc<Answer> = Arc::new(answer);
        let app = Router::new().fallback(take).with_state((seen.clone(), answer));
        let task = tokio::spawn(async move { axum::serve(listener, app).await.unwrap() });
        Self { url, seen, task }
    }

    async fn accepting() -> Self {
        Self::start(|_, _| StatusCode::NO_CONTENT.into_response()).await
    }

    fn all(&self) -> Vec<Seen> {
        self.seen.lock().unwrap().clone()
    }

    fn accepted(&self) -> Vec<(String, String)> {
        self.all().iter().filter(|s| s.accepted).map(Seen::what).collect()
    }
}

async fn take(
    State((seen, answer)): State<(Arc<Mutex<Vec<Seen>>>, Arc<Answer>)>,
    headers: HeaderMap,
    body: Bytes,
) -> Response {
    let text = |(name, value): (&axum::http::HeaderName, &axum::http::HeaderValue)| {
        (name.to_string(), value.to_str().unwrap().to_owned())
    };
    let mut request = Seen {
        headers: headers.iter().map(text).collect(),
        body: body.to_vec(),
        accepted: false,
    };
    let mut seen = seen.lock().unwrap();
    let response = answer(seen.len(), &request);
    request.accepted = response.status().is_success();
    seen.push(request);
    response
}

struct Daemon {
    journal: Journal,
    notifier: Notifier,
    stop: Option<oneshot::Sender<()>>,
    task: tokio::task::JoinHandle<()>,
}

impl Daemon {
    fn start(journal: &journal::Config, webhooks: &[notify::Config], clock: Clock) -> Self {
        let endpoints = notify::load(webhooks).unwrap();
        let journal = Journal::open(journal, endpoints.iter().map(Endpoint::subscription).collect()).unwrap();
        let (stop, stopped) = oneshot::channel::<()>();
        let (notifier, task) = notify::spawn(endpoints, journal.clone(), clock, 42, async {
            let _ = stopped.await;
        });
        Self {
            journal,
            notifier,
            stop: Some(stop),
            task,
        }
    }

    fn record(&self, events: &[AlertEvent]) {
        self.journal.record(events, start(), start()).unwrap();
    }

    fn status(&self) -> EndpointStatus {
        self.notifier.status().remove(0)
    }

    async fn stop(mut self) {
        let _ = self.stop.take().unwrap().send(());
        self.task.await.unwrap();
    }
}

/// Waits for a condition that must come true; the bound only keeps a failing test from hanging.
async fn until(mut holds: impl FnMut() -> bool) {
    let started = Instant::now();
    while !holds() {
        assert!(started.elapsed() < Duration::from_secs(20), "waited in vain");
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
}

fn webhook(dir: &Path, url: &str) -> notify::Config {
    let secret_file = dir.join("secret");
    std::fs::write(&secret_file, format!("whsec_{}\n", BASE64_STANDARD.encode(KEY))).unwrap();
    notify::Config {
        name: None,
        url: url.to_owned(),
        secret_file,
        kinds: None,
        allow_http: false,
        ca_file: None,
        timeout_s: 20.0,
    }
}

fn on_disk(dir: &Path) -> journal::Config {
    journal::Config {
        path: Some(dir.join("a.db")),
        ..journal::Config::default()
    }
}

#[tokio::test]
async fn a_delivery_is_signed_and_carries_the_alert_in_both_forms() {
    let dir = tempfile::tempdir().unwrap();
    let receiver = Receiver::accepting().await;
    let daemon = Daemon::start(
        &on_disk(dir.path()),
        &[webhook(dir.path(), &receiver.url)],
        Clock::wall(),
    );
    let raised = event(AlertEventKind::Raised, "a", AlertKind::UnclaimedEmitter);
    daemon.record(std::slice::from_ref(&raised));
    until(|| receiver.all().len() == 1).await;

    let seen = &receiver.all()[0];
    let json = seen.json();
    let alert = serde_json::to_value(&raised.alert).unwrap();
    assert_eq!(json["type"], "alert.raised");
    assert_eq!(json["timestamp"], "2026-11-21T08:00:00Z");
    assert_eq!(json["data"], alert);
    assert_eq!((&json["event"], &json["alert"]), (&json["type"], &alert));
    assert_eq!(seen.headers["content-type"], "application/json");

    let (id, sent) = (&seen.headers["webhook-id"], &seen.headers["webhook-timestamp"]);
    assert!(id.starts_with("msg_") && !id.contains('.'));
    let age = Timestamp::now().as_second() - sent.parse::<i64>().unwrap();
    assert!((0..=20).contains(&age), "the time of the attempt, not of the event");
    let mut mac = Hmac::<sha2::Sha256>::new_from_slice(KEY).unwrap();
    mac.update(format!("{id}.{sent}.").as_bytes());
    mac.update(&seen.body);
    let expected = format!("v1,{}", BASE64_STANDARD.encode(mac.finalize().into_bytes()));
    assert_eq!(seen.headers["webhook-signature"], expected);

    until(|| daemon.status().queued == 0).await;
    let status = daemon.status();
    assert_eq!(
        (status.sent, status.failed, status.state),
        (1, 0, EndpointState::Working)
    );
    assert_eq!(status.last_error, None);
    daemon.stop().await;
}

#[tokio::test]
async fn an_endpoint_gets_the_kinds_it_asked_for_and_no_acknowledgement() {
    let dir = tempfile::tempdir().unwrap();
    let receiver = Receiver::accepting().await;
    let mut config = webhook(dir.path(), &receiver.url);
    config.kinds = Some(vec![AlertKind::SensorLost]);
    let daemon = Daemon::start(&on_disk(dir.path()), &[config], Clock::wall());
    daemon.record(&life("other"));
    use AlertEventKind::*;
    daemon.record(&[Raised, Acknowledged, Cleared].map(|kind| event(kind, "lost", AlertKind::SensorLost)));
    until(|| receiver.all().len() == 2).await;
    let got = receiver.accepted();
    assert_eq!(
        got,
        [("lost", "alert.raised"), ("lost", "alert.cleared")].map(|(a, b)| (a.to_owned(), b.to_owned()))
    );
    daemon.stop().await;
}

#[tokio::test]
async fn a_receiver_that_was_down_for_a_day_gets_everything_in_order_on_return() {
    let dir = tempfile::tempdir().unwrap();
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap();
    drop(listener);
    let config = webhook(dir.path(), &format!("http://{address}/hook?token=hunter2"));
    // An hour in a tenth of a second.
    let clock = Clock::fast(start(), 36_000.0);
    let daemon = Daemon::start(&on_disk(dir.path()), &[config], clock);
    for k in 0..20 {
        daemon.record(&life(&format!("a{k}")));
    }
    until(|| daemon.status().state == EndpointState::Failing).await;
    let status = daemon.status();
    let error = status.last_error.unwrap();
    assert!(error.to_lowercase().contains("refused"), "{error}");
    assert!(
        !error.contains("hunter2") && !status.url.contains("hunter2"),
        "{error} {}",
        status.url
    );

    until(|| clock.now() > start() + SignedDuration::from_hours(25)).await;
    assert_eq!(daemon.status().queued, 60);
    assert_eq!(daemon.status().failed, 0);
    let receiver = Receiver::on(tokio::net::TcpListener::bind(address).await.unwrap(), |_, _| {
        StatusCode::OK.into_response()
    });
    until(|| daemon.status().queued == 0).await;
    let got = receiver.accepted();
    assert_eq!(got.len(), 60);
    for k in 0..20 {
        let id = format!("a{k}");
        let types: Vec<&str> = got.iter().filter(|(a, _)| *a == id).map(|(_, t)| t.as_str()).collect();
        assert_eq!(types, ["alert.raised", "alert.updated", "alert.cleared"]);
    }
    daemon.stop().await;
}

#[tokio::test]
async fn retries_carry_the_same_id_and_a_new_signature() {
    let dir = tempfile::tempdir().unwrap();
    let receiver = Receiver::start(|k, _| match k {
        0 => StatusCode::INTERNAL_SERVER_ERROR.into_response(),
        1 => StatusCode::NOT_FOUND.into_response(),
        _ => StatusCode::OK.into_response(),
    })
    .await;
    let daemon = Daemon::start(
        &on_disk(dir.path()),
        &[webhook(dir.path(), &receiver.url)],
        Clock::fast(start(), 600.0),
    );
    daemon.record(&[event(AlertEventKind::Raised, "a", AlertKind::UserUnseen)]);
    until(|| daemon.status().sent == 1).await;
    let all = receiver.all();
    assert_eq!(all.len(), 3);
    assert!(
        all.iter()
            .all(|s| s.headers["webhook-id"] == all[0].headers["webhook-id"])
    );
    assert!(all.iter().all(|s| s.body == all[0].body));
    assert_ne!(all[0].headers["webhook-signature"], all[2].headers["webhook-signature"]);
    let sent = |k: usize| all[k].headers["webhook-timestamp"].parse::<i64>().unwrap();
    assert!(sent(1) - sent(0) >= 4, "5 s, in whole seconds");
    assert!(daemon.status().last_error.unwrap().contains("404"));
    daemon.stop().await;
}

#[tokio::test]
async fn redirects_are_not_followed() {
    let dir = tempfile::tempdir().unwrap();
    let trap = Receiver::accepting().await;
    let to = trap.url.clone();
    let receiver = Receiver::start(move |k, _| match k {
        0 => (StatusCode::TEMPORARY_REDIRECT, [("location", to.clone())]).into_response(),
        _ => StatusCode::OK.into_response(),
    })
    .await;
    let daemon = Daemon::start(
        &on_disk(dir.path()),
        &[webhook(dir.path(), &receiver.url)],
        Clock::fast(start(), 600.0),
    );
    daemon.record(&[event(AlertEventKind::Raised, "a", AlertKind::UserUnseen)]);
    until(|| daemon.status().sent == 1).await;
    assert_eq!(receiver.all().len(), 2);
    assert!(trap.all().is_empty());
    assert!(daemon.status().last_error.unwrap().contains("redirect"));
    daemon.stop().await;
}

#[tokio::test]
async fn retry_after_is_honoured() {
    let dir = tempfile::tempdir().unwrap();
    let receiver = Receiver::start(|k, _| match k {
        0 => (StatusCode::SERVICE_UNAVAILABLE, [("retry-after", "240")]).into_response(),
        _ => StatusCode::OK.into_response(),
    })
    .await;
    let daemon = Daemon::start(
        &on_disk(dir.path()),
        &[webhook(dir.path(), &receiver.url)],
        Clock::fast(start(), 600.0),
    );
    daemon.record(&[event(AlertEventKind::Raised, "a", AlertKind::UserUnseen)]);
    until(|| daemon.status().state == EndpointState::Failing).await;
    // Another alert's first attempt waits as well.
    daemon.record(&[event(AlertEventKind::Raised, "b", AlertKind::UserUnseen)]);
    until(|| daemon.status().sent == 2).await;
    let all = receiver.all();
    let sent = |k: usize| all[k].headers["webhook-timestamp"].parse::<i64>().unwrap();
    assert!(sent(1) - sent(0) >= 239, "{} s", sent(1) - sent(0));
    assert_eq!(all.len(), 3);
    daemon.stop().await;
}

#[tokio::test]
async fn a_receiver_that_is_gone_is_left_alone_until_enabled_also_over_a_restart() {
    let dir = tempfile::tempdir().unwrap();
    let receiver = Receiver::start(|k, _| match k {
        0 => StatusCode::GONE.into_response(),
        _ => StatusCode::OK.into_response(),
    })
    .await;
    let configs = [webhook(dir.path(), &receiver.url)];
    let daemon = Daemon::start(&on_disk(dir.path()), &configs, Clock::wall());
    daemon.record(&life("a"));
    until(|| daemon.status().state == EndpointState::Disabled).await;
    daemon.record(&life("b"));
    until(|| daemon.status().queued == 6).await;
    daemon.stop().await;

    let daemon = Daemon::start(&on_disk(dir.path()), &configs, Clock::wall());
    until(|| daemon.status().queued == 6).await;
    assert_eq!(daemon.status().state, EndpointState::Disabled);
    assert_eq!(receiver.all().len(), 1);
    daemon.notifier.enable(&daemon.status().name).await.unwrap();
    until(|| daemon.status().sent == 6).await;
    assert_eq!(daemon.status().state, EndpointState::Working);
    assert!(daemon.notifier.enable("nobody").await.is_err());
    daemon.stop().await;

    let daemon = Daemon::start(&on_disk(dir.path()), &configs, Clock::wall());
    until(|| daemon.status().sent == 6).await;
    assert_eq!(daemon.status().state, EndpointState::Working);
    daemon.stop().await;
}

#[tokio::test]
async fn what_is_given_up_is_kept_and_can_be_replayed() {
    let dir = tempfile::tempdir().unwrap();
    let open = Arc::new(std::sync::atomic::AtomicBool::new(false));
    let gate = open.clone();
    let receiver = Receiver::start(move |_, _| match gate.load(std::sync::atomic::Ordering::SeqCst) {
        true => StatusCode::OK.into_response(),
        false => StatusCode::BAD_REQUEST.into_response(),
    })
    .await;
    // The 75 hours of the schedule in under two seconds.
    let daemon = Daemon::start(
        &on_disk(dir.path()),
        &[webhook(dir.path(), &receiver.url)],
        Clock::fast(start(), 300_000.0),
    );
    daemon.record(&[event(AlertEventKind::Raised, "a", AlertKind::UserUnseen)]);
    until(|| daemon.status().failed == 1).await;
    assert_eq!(daemon.status().queued, 0);
    let name = daemon.status().name;
    daemon.journal.settled().await;
    let dead = daemon.notifier.dead_letters(&name, 10).unwrap();
    assert_eq!((dead.len(), dead[0].alert.as_str()), (1, "a"));
    assert!(dead[0].error.contains("400"));
    assert!(dead[0].given_up_at > start() + SignedDuration::from_hours(75));

    open.store(true, std::sync::atomic::Ordering::SeqCst);
    assert_eq!(daemon.notifier.replay(&name, Some(999)).await.unwrap(), 0);
    assert_eq!(daemon.notifier.replay(&name, None).await.unwrap(), 1);
    until(|| daemon.status().sent == 1).await;
    assert_eq!((daemon.status().failed, daemon.status().queued), (0, 0));
    daemon.journal.settled().await;
    assert!(daemon.notifier.dead_letters(&name, 10).unwrap().is_empty());
    daemon.stop().await;
}

#[tokio::test]
async fn a_slow_receiver_holds_up_neither_others_nor_the_daemon() {
    let dir = tempfile::tempdir().unwrap();
    // Takes connections and never answers.
    let silent = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let mut slow = webhook(dir.path(), &format!("http://{}/", silent.local_addr().unwrap()));
    slow.timeout_s = 1.0;
    let quick = Receiver::accepting().await;
    let configs = [slow, webhook(dir.path(), &quick.url)];
    let daemon = Daemon::start(&on_disk(dir.path()), &configs, Clock::wall());
    for k in 0..30 {
        daemon.record(&life(&format!("a{k}")));
    }
    until(|| quick.accepted().len() == 90).await;
    until(|| daemon.status().last_error.as_deref() == Some("no answer in time")).await;
    assert_eq!(daemon.status().queued, 90);
    let stopping = Instant::now();
    daemon.stop().await;
    assert!(stopping.elapsed() < Duration::from_secs(4));
}

#[tokio::test]
async fn an_answer_without_end_is_not_read() {
    let dir = tempfile::tempdir().unwrap();
    let receiver = Receiver::start(|_, _| {
        let drops = futures_util::stream::repeat_with(|| Ok::<_, std::io::Error>(Bytes::from_static(&[b'x'; 1024])));
        Response::new(Body::from_stream(drops))
    })
    .await;
    let daemon = Daemon::start(
        &on_disk(dir.path()),
        &[webhook(dir.path(), &receiver.url)],
        Clock::wall(),
    );
    let started = Instant::now();
    daemon.record(&life("a"));
    until(|| daemon.status().sent == 3).await;
    assert!(started.elapsed() < Duration::from_secs(10));
    daemon.stop().await;
}

#[tokio::test]
async fn what_was_not_confirmed_goes_out_after_a_restart() {
    let dir = tempfile::tempdir().unwrap();
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap();
    drop(listener);
    let configs = [webhook(dir.path(), &format!("http://{address}/"))];
    let daemon = Daemon::start(&on_disk(dir.path()), &configs, Clock::wall());
    daemon.record(&life("a"));
    until(|| daemon.status().state == EndpointState::Failing).await;
    daemon.stop().await;

    let receiver = Receiver::on(tokio::net::TcpListener::bind(address).await.unwrap(), |_, _| {
        StatusCode::OK.into_response()
    });
    let daemon = Daemon::start(&on_disk(dir.path()), &configs, Clock::wall());
    until(|| receiver.accepted().len() == 3).await;
    let types: Vec<String> = receiver.accepted().into_iter().map(|(_, t)| t).collect();
    assert_eq!(types, ["alert.raised", "alert.updated", "alert.cleared"]);
    daemon.stop().await;
}

#[test]
fn a_webhook_that_cannot_work_is_a_clear_config_error() {
    let dir = tempfile::tempdir().unwrap();
    let good = webhook(dir.path(), "https://hooks.example.org/in?token=hunter2");
    assert_eq!(
        notify::load(std::slice::from_ref(&good)).unwrap()[0].shown_url(),
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

#[tokio::test]
async fn events_are_sent_while_the_disk_refuses_them_and_not_again_after() {
    let dir = tempfile::tempdir().unwrap();
    let receiver = Receiver::accepting().await;
    let daemon = Daemon::start(
        &on_disk(dir.path()),
        &[webhook(dir.path(), &receiver.url)],
        Clock::wall(),
    );
    let other = rusqlite::Connection::open(dir.path().join("a.db")).unwrap();
    other.execute_batch("BEGIN IMMEDIATE").unwrap();
    daemon.record(&life("a"));
    until(|| receiver.accepted().len() == 3).await;
    assert!(!daemon.journal.health().writable);
    other.execute_batch("ROLLBACK").unwrap();
    until(|| daemon.journal.health().writable && daemon.journal.health().unwritten == 0).await;
    daemon.stop().await;

    let daemon = Daemon::start(
        &on_disk(dir.path()),
        &[webhook(dir.path(), &receiver.url)],
        Clock::wall(),
    );
    until(|| daemon.status().sent == 3).await;
    assert_eq!(daemon.status().queued, 0);
    assert_eq!(receiver.all().len(), 3);
    daemon.stop().await;
}
