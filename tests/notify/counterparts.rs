//! `[[export]]` against the systems themselves: Debian's rsyslog and Alertmanager. `make setup-test` installs them; where one is
//! missing its test is skipped, but not where CI is set.

use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use oapwatch::monitor::{AlertEventKind, AlertKind, AlertState, Severity};
use oapwatch::notify::Clock;
use serde_json::Value;

use super::exports::endpoint;
use super::port::free_port;
use super::sender::{Daemon, event, on_disk, until};

/// A program that ends with the test.
pub struct Running(Child);

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// The first of these programs that is installed.
pub fn installed(what: &str, places: &[&str]) -> Option<PathBuf> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let found = places.iter().map(|place| root.join(place)).find(|path| path.exists());
    if found.is_none() {
        assert!(std::env::var_os("CI").is_none(), "{what} is not installed");
        eprintln!("SKIPPED: {what} is not installed; `make setup-test` installs it");
    }
    found
}

pub fn run(program: &Path, arguments: &[&str]) -> Running {
    let child = Command::new(program)
        .args(arguments)
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn();
    Running(child.expect("the program starts"))
}

async fn until_listening(port: u16) {
    until(|| std::net::TcpStream::connect(("127.0.0.1", port)).is_ok()).await;
}

#[tokio::test]
async fn rsyslog_understands_structured_data_over_udp_tcp_and_tls() {
    let Some(program) = installed("rsyslog", &["/usr/sbin/rsyslogd"]) else {
        return;
    };
    let dir = tempfile::tempdir().unwrap();
    let tls = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/tls");
    let file = |name: &str| tls.join(name).display().to_string();
    let out = dir.path().join("heard.log");
    let [udp, tcp, secure] = [(); 3].map(|()| free_port());
    // Structured data is parsed by rsyslog's own module; what it cannot parse has no such fields.
    let config = format!(
        r#"global(workDirectory="{dir}" DefaultNetstreamDriverCAFile="{authority}" DefaultNetstreamDriverCertFile="{certificate}"
  DefaultNetstreamDriverKeyFile="{key}")
module(load="mmpstrucdata")
module(load="imudp")
input(type="imudp" address="127.0.0.1" port="{udp}")
module(load="imtcp")
input(type="imtcp" address="127.0.0.1" port="{tcp}")
input(type="imtcp" address="127.0.0.1" port="{secure}" streamDriver.name="gtls" streamDriver.mode="1" streamDriver.authMode="x509/certvalid")
template(name="all" type="string" string="%syslogfacility-text%.%syslogseverity-text%|%hostname%|%app-name%|%msgid%|%$!rfc5424-sd!oapwatch@32473!alert%|%$!rfc5424-sd!oapwatch@32473!user%|%msg%\n")
action(type="mmpstrucdata")
action(type="omfile" file="{out}" template="all")
"#,
        dir = dir.path().display(),
        authority = file("client-ca.pem"),
        certificate = file("server.pem"),
        key = file("server.key"),
        out = out.display(),
    );
    let path = dir.path().join("rsyslog.conf");
    std::fs::write(&path, config).unwrap();
    let pid = dir.path().join("pid");
    let _rsyslog = run(
        &program,
        &["-n", "-f", path.to_str().unwrap(), "-i", pid.to_str().unwrap()],
    );
    until_listening(tcp).await;
    until_listening(secure).await;

    let common = "kind = \"syslog\"\nstation = \"ap7\"\n";
    let endpoints = vec![
        endpoint(&format!("{common}name = \"udp\"\naddress = \"udp://127.0.0.1:{udp}\"")),
        endpoint(&format!("{common}name = \"tcp\"\naddress = \"tcp://127.0.0.1:{tcp}\"")),
        endpoint(&format!(
            "{common}name = \"tls\"\naddress = \"tls://localhost:{secure}\"\nca_file = {:?}\nclient_cert_file = {:?}\nclient_key_file = {:?}",
            file("ca.pem"),
            file("client.pem"),
            file("client.key")
        )),
    ];
    let daemon = Daemon::sending_to(&on_disk(dir.path()), endpoints, Clock::wall());
    let mut raised = event(AlertEventKind::Raised, "a", AlertKind::PositionMismatch);
    raised.alert.user = Some("Zoë \"]\\[".to_owned());
    daemon.record(&[raised]);
    let heard = || std::fs::read_to_string(&out).unwrap_or_default();
    until(|| heard().lines().count() == 3).await;
    for line in heard().lines() {
        let fields: Vec<&str> = line.splitn(7, '|').collect();
        assert_eq!(
            fields[..6],
            ["authpriv.crit", "ap7", "oapwatch", "alert.raised", "a", "Zoë \"]\\["],
            "{line}"
        );
        assert!(
            fields[6].contains("alert.raised: position mismatch: user Zoë"),
            "{line}"
        );
    }
    daemon.stop().await;
}

#[tokio::test]
async fn alertmanager_shows_an_alert_by_its_severity_and_then_no_more() {
    let Some(program) = installed("prometheus-alertmanager", &["/usr/bin/prometheus-alertmanager"]) else {
        return;
    };
    let dir = tempfile::tempdir().unwrap();
    let config = dir.path().join("alertmanager.yml");
    std::fs::write(
        &config,
        "route: { receiver: none, group_by: [alertname, instance] }\nreceivers: [{ name: none }]\n",
    )
    .unwrap();
    let port = free_port();
    let _alertmanager = run(
        &program,
        &[
            &format!("--config.file={}", config.display()),
            &format!("--storage.path={}", dir.path().join("data").display()),
            &format!("--web.listen-address=127.0.0.1:{port}"),
            "--cluster.listen-address=",
        ],
    );
    until_listening(port).await;
    let base = format!("http://127.0.0.1:{port}");
    let client = reqwest::Client::builder().no_proxy().build().unwrap();
    let active = async || -> Vec<Value> {
        let answer = client.get(format!("{base}/api/v2/alerts")).send().await.unwrap();
        serde_json::from_slice(&answer.bytes().await.unwrap()).unwrap()
    };
    let until_active = async |expected: &[&str]| {
        for _ in 0..1000 {
            let found = active().await;
            let severities: Vec<&str> = found.iter().filter_map(|a| a["labels"]["severity"].as_str()).collect();
            if severities == expected {
                return found;
            }
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
        panic!("expected {expected:?}, found {:?}", active().await);
    };
    let lines = format!("kind = \"alertmanager\"\nstation = \"ap7\"\naddress = \"{base}\"");
    let daemon = Daemon::sending_to(&on_disk(dir.path()), vec![endpoint(&lines)], Clock::wall());
    let mut step = event(AlertEventKind::Raised, "a", AlertKind::UnclaimedEmitter);
    step.alert.severity = Severity::Warning;
    daemon.record(std::slice::from_ref(&step));
    let found = until_active(&["warning"]).await;
    assert_eq!(found[0]["labels"]["alertname"], "OapwatchUnclaimedEmitter");
    assert_eq!(found[0]["labels"]["instance"], "ap7");
    assert_eq!(found[0]["status"]["state"], "active");
    assert_eq!(found[0]["startsAt"], "2026-11-21T08:00:00.000Z");
    step.event = AlertEventKind::Updated;
    step.alert.severity = Severity::Critical;
    daemon.record(std::slice::from_ref(&step));
    until_active(&["critical"]).await;
    step.event = AlertEventKind::Cleared;
    step.alert.state = AlertState::Cleared;
    step.alert.cleared_at = Some(super::sender::start());
    daemon.record(&[step]);
    until_active(&[]).await;
    assert_eq!(daemon.status().last_error, None);
    daemon.stop().await;
}
