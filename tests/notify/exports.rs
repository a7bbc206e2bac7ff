//! `[[export]]` against receivers in this process: what syslog gets, and what a slow or lying receiver costs.

use std::path::Path;
use std::sync::{Arc, Mutex};

use oapwatch::export::{self, Export};
use oapwatch::monitor::{AlertEventKind, AlertKind};
use oapwatch::notify::{Clock, Endpoint, EndpointState};
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, PrivateKeyDer};
use rustls::server::WebPkiClientVerifier;
use rustls::{RootCertStore, ServerConfig};
use tokio::io::{AsyncRead, AsyncReadExt};
use tokio::net::{TcpListener, UdpSocket};
use tokio_rustls::TlsAcceptor;

use super::sender::{Daemon, event, life, on_disk, until};

/// Munich.
pub fn world() -> oapwatch::geo::Config {
    toml::from_str("origin = { latitude_deg = 48.0, longitude_deg = 11.0, height_m = 520.0, datum = \"ellipsoid\" }")
        .unwrap()
}

/// An `[[export]]` of these lines.
pub fn load(lines: &str) -> Result<Export, String> {
    let config: export::Config = toml::from_str(lines).map_err(|e| e.to_string())?;
    let loaded = export::load(&[config], &[], &world()).map_err(|e| e.to_string())?;
    Ok(loaded.into_iter().next().expect("one export"))
}

pub fn endpoint(lines: &str) -> Endpoint {
    load(lines).unwrap().endpoint
}

/// What updates come from, without a compute thread.
pub fn context(daemon: &Daemon) -> export::Context {
    export::Context {
        journal: daemon.journal.clone(),
        feed: Arc::new(oapwatch::api::Feed::new(0, 0)),
        commands: tokio::sync::mpsc::channel(1).0,
        clock: Clock::wall(),
    }
}

/// Everything that was read from a receiver's connections, in order.
type Heard = Arc<Mutex<Vec<u8>>>;

fn text(heard: &Heard) -> String {
    String::from_utf8(heard.lock().unwrap().clone()).unwrap()
}

async fn hear(mut stream: impl AsyncRead + Unpin, heard: Heard) {
    let mut bytes = [0; 4096];
    while let Ok(n @ 1..) = stream.read(&mut bytes).await {
        heard.lock().unwrap().extend_from_slice(&bytes[..n]);
    }
}

/// The messages of a stream by their octet counts (RFC 6587, section 3.4.1).
fn counted(text: &str) -> Vec<&str> {
    let (mut rest, mut messages) = (text, Vec::new());
    while let Some((length, after)) = rest.split_once(' ') {
        let length: usize = length.parse().unwrap();
        messages.push(&after[..length]);
        rest = &after[length..];
    }
    assert_eq!(rest, "");
    messages
}

#[test]
fn an_export_that_cannot_work_is_a_clear_config_error() {
    let dir = tempfile::tempdir().unwrap();
    let empty = dir.path().join("empty");
    std::fs::write(&empty, "\n").unwrap();
    let tls = tls_folder();
    for (lines, expected) in [
        ("kind = \"pigeon\"\naddress = \"udp://a\"", "unknown variant `pigeon`"),
        ("kind = \"syslog\"", "missing field `address`"),
        (
            "kind = \"syslog\"\naddress = \"https://a\"",
            "expected udp://HOST:PORT or tcp://HOST:PORT",
        ),
        ("kind = \"syslog\"\naddress = \"logs:514\"", "expected udp://HOST:PORT"),
        ("kind = \"syslog\"\naddress = \"udp://\"", "expected udp://HOST:PORT"),
        (
            "kind = \"syslog\"\naddress = \"udp://a/path\"",
            "expected udp://HOST:PORT",
        ),
        ("kind = \"alertmanager\"\naddress = \"http://a:9093\"", "allow_http"),
        (
            "kind = \"alertmanager\"\naddress = \"https://a\"\ncool_down_s = 5.0",
            "cool_down_s: only used with",
        ),
        (
            "kind = \"alertmanager\"\naddress = \"https://a\"\nformat = \"cef\"",
            "format: only used with",
        ),
        (
            "kind = \"syslog\"\naddress = \"tls://a\"\ntoken_file = \"t\"",
            "token_file: only used with",
        ),
        (
            "kind = \"syslog\"\naddress = \"tcp://a\"\nca_file = \"t\"",
            "ca_file: only used with",
        ),
        (
            "kind = \"syslog\"\naddress = \"tls://a\"\nca_file = \"no-such\"",
            "ca_file: no-such: expected certificates",
        ),
        (
            &format!("kind = \"syslog\"\naddress = \"tls://a\"\nca_file = {empty:?}"),
            "found: none",
        ),
        (
            &format!(
                "kind = \"syslog\"\naddress = \"tls://a\"\nclient_cert_file = {:?}",
                tls.join("client.pem")
            ),
            "expected client_key_file beside it",
        ),
        (
            &format!("kind = \"alertmanager\"\naddress = \"https://a\"\ntoken_file = {empty:?}"),
            "expected a token on one line",
        ),
        (
            "kind = \"syslog\"\naddress = \"udp://a\"\nstation = \"a b\"",
            "station: expected",
        ),
        (
            "kind = \"syslog\"\naddress = \"udp://a\"\nkinds = []",
            "kinds: an empty list",
        ),
        (
            "kind = \"syslog\"\naddress = \"udp://a\"\ntimeout_s = 0.0",
            "timeout_s: expected 1 to 120",
        ),
        (
            "kind = \"syslog\"\naddress = \"udp://a\"\nname = \"a b\"",
            "name: expected",
        ),
    ] {
        let error = load(lines).expect_err(lines);
        assert!(error.contains(expected), "{lines}: {error}");
    }
    let one: export::Config = toml::from_str("kind = \"syslog\"\naddress = \"udp://logs.example\"").unwrap();
    let twice = export::load(&[one.clone(), one], &[], &world())
        .unwrap_err()
        .to_string();
    assert!(
        twice.starts_with("[[export]] 2: name: `syslog-logs-example-"),
        "{twice}"
    );
}

#[tokio::test]
async fn a_syslog_datagram_is_one_message_of_rfc_5424() {
    let dir = tempfile::tempdir().unwrap();
    let socket = UdpSocket::bind("127.0.0.1:0").await.unwrap();
    let lines = format!(
        "kind = \"syslog\"\naddress = \"udp://{}\"\nstation = \"ap7\"",
        socket.local_addr().unwrap()
    );
    let daemon = Daemon::sending_to(&on_disk(dir.path()), vec![endpoint(&lines)], Clock::wall());
    let mut raised = event(AlertEventKind::Raised, "a", AlertKind::PositionMismatch);
    raised.alert.user = Some("Zoë \"]\\[".to_owned());
    raised.alert.cov_m2 = Some([[4.0, 0.0], [0.0, 1.0]]);
    daemon.record(&[raised.clone()]);
    let mut bytes = [0; 65536];
    let mut next = async || {
        let length = socket.recv(&mut bytes).await.unwrap();
        String::from_utf8(bytes[..length].to_vec()).unwrap()
    };
    let pid = std::process::id();
    let journal = daemon.journal.id().to_owned();
    assert_eq!(
        next().await,
        format!(
            "<82>1 2026-11-21T08:00:00.000000Z ap7 oapwatch {pid} alert.raised [oapwatch@32473 event=\"msg_{journal}_1\" alert=\"a\" \
             kind=\"position_mismatch\" severity=\"critical\" state=\"open\" raised_at=\"2026-11-21T08:00:00.000000Z\" \
             user=\"Zoë \\\"\\]\\\\[\" x_m=\"1.500\" y_m=\"-2.500\" sigma_m=\"2.000\"] \
             \u{feff}alert.raised: position mismatch: user Zoë \"]\\[ at x 1.50 m, y -2.50 m (± 2.00 m)"
        )
    );
    // An acknowledgement is told too, and the end is a notice.
    daemon.record(&[AlertEventKind::Acknowledged, AlertEventKind::Cleared].map(|kind| {
        let mut next = event(kind, "a", AlertKind::SensorLost);
        (next.alert.x_m, next.alert.y_m) = (None, None);
        next
    }));
    let acknowledged = next().await;
    assert!(
        acknowledged.starts_with("<82>1 ") && acknowledged.contains(" alert.acknowledged ["),
        "{acknowledged}"
    );
    let cleared = next().await;
    assert!(cleared.starts_with("<85>1 "), "{cleared}");
    assert!(cleared.ends_with("] alert.cleared: sensor lost"), "{cleared}");
    // A name of the longest kind leaves a datagram within bounds.
    raised.alert.user = Some("\u{1f681}".repeat(256));
    raised.alert.id = "b".to_owned();
    daemon.record(&[raised]);
    assert!((1024..=2048).contains(&next().await.len()));
    let outcome = daemon.notifier.test(&daemon.status().name).await.unwrap();
    assert!(outcome.delivered && outcome.status.is_none(), "{outcome:?}");
    let test = next().await;
    assert!(
        test.starts_with("<86>1 ") && test.contains(" test [") && test.contains("alert=\"test\""),
        "{test}"
    );
    daemon.stop().await;
}

#[tokio::test]
async fn a_stream_is_counted_and_opened_again_when_the_receiver_closes_it() {
    let dir = tempfile::tempdir().unwrap();
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let lines = format!(
        "kind = \"syslog\"\nformat = \"cef\"\nstation = \"ap7\"\nkinds = [\"unclaimed_emitter\"]\naddress = \"tcp://{}\"",
        listener.local_addr().unwrap()
    );
    let daemon = Daemon::sending_to(&on_disk(dir.path()), vec![endpoint(&lines)], Clock::wall());
    for id in ["a", "b"] {
        let heard = Heard::default();
        daemon.record(&life(id));
        daemon.record(&life("other").map(|mut event| {
            event.alert.kind = AlertKind::SensorLost;
            event
        }));
        let (stream, _) = listener.accept().await.unwrap();
        let reading = tokio::spawn(hear(stream, heard.clone()));
        until(|| text(&heard).contains("act=alert.cleared")).await;
        let text = text(&heard);
        let messages = counted(&text);
        assert_eq!(messages.len(), 3);
        let (header, cef) = messages[0].split_once(" - CEF:0|").unwrap();
        assert!(header.ends_with("alert.raised"), "{header}");
        assert_eq!(
            cef,
            format!(
                "oapwatch|oapwatch|{}|unclaimed_emitter|unclaimed emitter|9|rt=1795248000000 dvchost=ap7 externalId={id} \
                 act=alert.raised cat=unclaimed_emitter start=1795248000000 cs1Label=state cs1=open cfp1Label=x_m cfp1=1.500 \
                 cfp2Label=y_m cfp2=-2.500",
                env!("CARGO_PKG_VERSION")
            )
        );
        // The receiver goes away; the next event opens another connection.
        reading.abort();
        let _ = reading.await;
    }
    until(|| daemon.status().sent == 6).await;
    daemon.stop().await;
}

fn tls_folder() -> std::path::PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/tls")
}

/// A server that asks for a certificate of our test clients.
fn acceptor() -> TlsAcceptor {
    let chain = |name: &str| {
        CertificateDer::pem_file_iter(tls_folder().join(name))
            .unwrap()
            .collect::<Result<Vec<_>, _>>()
            .unwrap()
    };
    let mut clients = RootCertStore::empty();
    clients.add(chain("client-ca.pem").remove(0)).unwrap();
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let verifier = WebPkiClientVerifier::builder_with_provider(Arc::new(clients), provider.clone());
    let config = ServerConfig::builder_with_provider(provider)
        .with_safe_default_protocol_versions()
        .unwrap()
        .with_client_cert_verifier(verifier.build().unwrap())
        .with_single_cert(
            chain("server.pem"),
            PrivateKeyDer::from_pem_file(tls_folder().join("server.key")).unwrap(),
        );
    TlsAcceptor::from(Arc::new(config.unwrap()))
}

#[tokio::test]
async fn tls_verifies_the_receiver_and_shows_our_certificate() {
    let dir = tempfile::tempdir().unwrap();
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = format!(
        "kind = \"syslog\"\naddress = \"tls://localhost:{}\"",
        listener.local_addr().unwrap().port()
    );
    let file = |key: &str, name: &str| format!("\n{key} = {:?}", tls_folder().join(name));
    let stranger = address.clone() + "\nname = \"stranger\"";
    let nameless = address.clone() + "\nname = \"nameless\"" + &file("ca_file", "ca.pem");
    let known = address
        + "\nname = \"known\""
        + &file("ca_file", "ca.pem")
        + &file("client_cert_file", "client.pem")
        + &file("client_key_file", "client.key");
    let heard = Heard::default();
    let acceptor = acceptor();
    let accepting = {
        let heard = heard.clone();
        tokio::spawn(async move {
            loop {
                let (stream, _) = listener.accept().await.unwrap();
                let (acceptor, heard) = (acceptor.clone(), heard.clone());
                tokio::spawn(async move {
                    if let Ok(stream) = acceptor.accept(stream).await {
                        hear(stream, heard).await;
                    }
                });
            }
        })
    };
    let endpoints = [stranger, nameless, known].map(|lines| endpoint(&lines)).into();
    let daemon = Daemon::sending_to(&on_disk(dir.path()), endpoints, Clock::wall());
    daemon.record(&[event(AlertEventKind::Raised, "a", AlertKind::SensorLost)]);
    let status = |name: &str| daemon.notifier.status().into_iter().find(|s| s.name == name).unwrap();
    until(|| status("known").sent == 1 && status("stranger").state == EndpointState::Failing).await;
    let error = status("stranger").last_error.unwrap();
    assert!(
        error.contains("certificate") || error.contains("UnknownIssuer"),
        "{error}"
    );
    until(|| counted(&text(&heard)).len() == 1).await;
    assert!(text(&heard).contains("alert=\"a\""));
    // Whoever shows no certificate was heard by nobody, whatever the handshake said (TLS 1.3 refuses after it).
    let again = daemon.notifier.test("nameless").await.unwrap();
    assert!(again.delivered || again.error.is_some());
    assert_eq!(counted(&text(&heard)).len(), 1);
    accepting.abort();
    daemon.stop().await;
}

#[tokio::test]
async fn a_receiver_that_never_reads_holds_up_nobody_else() {
    let dir = tempfile::tempdir().unwrap();
    let silent = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let socket = UdpSocket::bind("127.0.0.1:0").await.unwrap();
    // The handshake is never answered.
    let stuck = format!(
        "kind = \"syslog\"\nname = \"stuck\"\ntimeout_s = 1.0\naddress = \"tls://{}\"",
        silent.local_addr().unwrap()
    );
    let well = format!(
        "kind = \"syslog\"\nname = \"well\"\naddress = \"udp://{}\"",
        socket.local_addr().unwrap()
    );
    let endpoints = vec![endpoint(&stuck), endpoint(&well)];
    let daemon = Daemon::sending_to(&on_disk(dir.path()), endpoints, Clock::wall());
    for k in 0..50 {
        daemon.record(&[event(AlertEventKind::Raised, &format!("a{k}"), AlertKind::SensorLost)]);
    }
    let mut bytes = [0; 4096];
    for _ in 0..50 {
        socket.recv(&mut bytes).await.unwrap();
    }
    until(|| daemon.status().last_error.is_some()).await;
    let status = daemon.status();
    assert_eq!((status.name.as_str(), status.queued, status.sent), ("stuck", 50, 0));
    assert_eq!(status.last_error.as_deref(), Some("no answer in time"));
    daemon.stop().await;
}
