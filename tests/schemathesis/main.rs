//! The running daemon held to its own description: schemathesis makes requests from /openapi.json, right and wrong ones, and
//! fails on a server error, an answer that is not described, or wrong input that is taken. `make setup-test` installs it.

#[path = "../daemon/port.rs"]
mod port;

use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use port::free_port;

struct Daemon(Child);

impl Drop for Daemon {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

#[test]
fn every_answer_is_as_described() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let installed = root.join("target/schemathesis/bin/schemathesis");
    if !installed.exists() {
        assert!(
            std::env::var_os("CI").is_none(),
            "{} is not installed",
            installed.display()
        );
        eprintln!("SKIPPED: the API is not held to its description; `make setup-test` installs schemathesis");
        return;
    }
    let dir = tempfile::tempdir().expect("a folder");
    let (port, nobody) = (free_port(), free_port());
    let secret = dir.path().join("secret");
    std::fs::write(&secret, "whsec_MDEyMzQ1Njc4OWFiY2RlZjAxMjM0NTY3ODlhYmNkZWY=\n").expect("the secret is written");
    let config = dir.path().join("oapwatch.toml");
    let text = format!(
        "[world]\norigin = {{ latitude_deg = 48.137, longitude_deg = 11.575, height_m = 520.0, datum = \"ellipsoid\" }}\n\
         [api]\nlisten = \"127.0.0.1:{port}\"\nrequests_per_second = 100000\n[journal]\npath = \"journal.db\"\n\
         [[webhook]]\nname = \"soc\"\nurl = \"http://127.0.0.1:{nobody}/\"\nsecret_file = \"secret\"\n"
    );
    std::fs::write(&config, text).expect("the config is written");
    let daemon = Command::new(env!("CARGO_BIN_EXE_oapwatch"))
        .args(["run", "--config"])
        .arg(&config)
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn();
    let _daemon = Daemon(daemon.expect("the daemon starts"));
    let started = Instant::now();
    while std::net::TcpStream::connect(("127.0.0.1", port)).is_err() {
        assert!(
            started.elapsed() < Duration::from_secs(30),
            "the daemon does not listen"
        );
        std::thread::sleep(Duration::from_millis(50));
    }
    let run = Command::new(installed)
        .arg("--config-file")
        .arg(root.join("tests/schemathesis/schemathesis.toml"))
        .args(["run", &format!("http://127.0.0.1:{port}/openapi.json")])
        .args([
            "--checks",
            "all",
            "--max-examples",
            "25",
            "--seed",
            "1",
            "--workers",
            "2",
        ])
        .args(["--request-timeout", "10", "--no-color"])
        .current_dir(dir.path())
        .output()
        .expect("schemathesis runs");
    let said = String::from_utf8_lossy(&run.stdout);
    assert!(run.status.success(), "{said}\n{}", String::from_utf8_lossy(&run.stderr));
    assert!(said.contains("Tested: 40"), "fewer operations than there are: {said}");
}
