//! A real NATS server, and stations and a hub that use it.

use std::ffi::OsString;
use std::net::TcpStream;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use crate::port::free_port;
use crate::process::Daemon;

/// A NATS server with JetStream; killed when dropped.
pub struct Server {
    child: Child,
    pub port: u16,
}

impl Server {
    /// `None` where there is no nats-server; never in CI.
    pub fn start(dir: &Path, port: Option<u16>) -> Option<Self> {
        let store = dir.join("nats");
        Self::start_with(port, |port| {
            vec![
                "-js".into(),
                "-a".into(),
                "127.0.0.1".into(),
                "-p".into(),
                port.to_string().into(),
                "-sd".into(),
                store.into(),
            ]
        })
    }

    /// With other arguments, which are given the port.
    pub fn start_with(port: Option<u16>, arguments: impl FnOnce(u16) -> Vec<OsString>) -> Option<Self> {
        let port = port.unwrap_or_else(free_port);
        let child = Command::new("nats-server")
            .args(arguments(port))
            .stderr(Stdio::null())
            .spawn();
        let child = match child {
            Ok(child) => child,
            Err(error) if std::env::var_os("CI").is_none() => {
                eprintln!("skipped: nats-server cannot be started ({error}); `make setup-test` installs it");
                return None;
            }
            Err(error) => panic!("nats-server: {error}"),
        };
        let end = Instant::now() + Duration::from_secs(20);
        while TcpStream::connect(("127.0.0.1", port)).is_err() {
            assert!(Instant::now() < end, "nats-server does not listen");
            std::thread::sleep(Duration::from_millis(20));
        }
        Some(Self { child, port })
    }

    /// Its process.
    pub fn id(&self) -> u32 {
        self.child.id()
    }

    pub fn signal(&self, name: &str) {
        let status = Command::new("kill").args([name, &self.child.id().to_string()]).status();
        assert!(status.unwrap().success());
    }

    /// Kills it as the kernel would.
    pub fn end(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }

    /// As [`Server::end`]; gives the port for the next one.
    pub fn kill(mut self) -> u16 {
        self.end();
        self.port
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        self.end();
    }
}

pub fn station(dir: &Path, name: &str, scene: &str, port: u16) -> Daemon {
    station_with(dir, name, scene, port, "")
}

/// `more` is the rest of its config: keys of `[fleet]`, then other tables.
pub fn station_with(dir: &Path, name: &str, scene: &str, port: u16, more: &str) -> Daemon {
    let scene = format!("{}/config/scenes/{scene}.toml", env!("CARGO_MANIFEST_DIR"));
    station_of(dir, name, Path::new(&scene), port, more)
}

/// As [`station_with`], with a scene of its own.
pub fn station_of(dir: &Path, name: &str, scene: &Path, port: u16, more: &str) -> Daemon {
    let dir = dir.join(name);
    std::fs::create_dir_all(&dir).unwrap();
    let config = format!(
        "[source]\nkind = \"simulator\"\nscene = {scene:?}\n[journal]\npath = \"journal.db\"\n\
         [fleet]\nurl = \"nats://127.0.0.1:{port}\"\nsite = \"harbour\"\nstation = {name:?}\n{more}"
    );
    Daemon::start(&dir, &config)
}

pub fn hub(dir: &Path, port: u16) -> Daemon {
    hub_with(dir, port, "")
}

/// As [`station_with`].
pub fn hub_with(dir: &Path, port: u16, more: &str) -> Daemon {
    let dir = dir.join("hub");
    std::fs::create_dir_all(&dir).unwrap();
    let config = format!(
        "[journal]\npath = \"journal.db\"\n[fleet]\nurl = \"nats://127.0.0.1:{port}\"\nlost_after_s = 2.0\n{more}"
    );
    Daemon::start_as(&dir, "fleet", &config)
}
