//! A disk that cannot even be read: another process holds every lock of the journal.

use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Command, Stdio};

use axum::http::StatusCode;
use axum::response::IntoResponse;
use oapwatch::monitor::{AlertEventKind, AlertKind};
use oapwatch::notify::{Clock, EndpointState};

use super::receiver::Receiver;
use super::sender::{Daemon, event, life, on_disk, until, webhook};

/// Holds the locks until it is dropped.
struct Locks(Child);

impl Locks {
    fn take(dir: &Path) -> Self {
        // The eight lock bytes of SQLite's WAL index but the last, which every open connection shares.
        let script = "import fcntl, sys\nf = open(sys.argv[1], 'r+b')\nfcntl.lockf(f, fcntl.LOCK_EX, 8, 120)\nprint('locked', flush=True)\nsys.stdin.read()";
        let mut child = Command::new("python3")
            .args(["-c", script])
            .arg(dir.join("a.db-shm"))
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let mut line = String::new();
        BufReader::new(child.stdout.take().unwrap())
            .read_line(&mut line)
            .unwrap();
        assert_eq!(line, "locked\n");
        Self(child)
    }
}

impl Drop for Locks {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

#[tokio::test]
async fn what_cannot_be_read_is_sent_later_and_what_memory_holds_at_once() {
    let dir = tempfile::tempdir().unwrap();
    let receiver = Receiver::start(|k, _| match k {
        0 => StatusCode::INTERNAL_SERVER_ERROR.into_response(),
        _ => StatusCode::OK.into_response(),
    })
    .await;
    let config = [webhook(dir.path(), &receiver.url)];
    let daemon = Daemon::start(&on_disk(dir.path()), &config, Clock::wall());
    daemon.record(&[event(AlertEventKind::Raised, "left behind", AlertKind::UserUnseen)]);
    until(|| daemon.status().state == EndpointState::Failing).await;
    daemon.stop().await;

    let daemon = Daemon::start(&on_disk(dir.path()), &config, Clock::wall());
    let locks = Locks::take(dir.path());
    daemon.record(&life("a"));
    until(|| receiver.accepted().len() == 3).await;
    assert!(receiver.accepted().iter().all(|(alert, _)| alert == "a"));
    drop(locks);
    until(|| receiver.accepted().len() == 4).await;
    assert_eq!(receiver.accepted()[3].0, "left behind");
    until(|| daemon.status().queued == 0).await;
    assert_eq!(receiver.all().len(), 5, "each once, beside the attempt that failed");
    assert_eq!(daemon.status().sent, 4);
    daemon.stop().await;
}
