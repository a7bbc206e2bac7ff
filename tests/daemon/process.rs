//! A daemon of a test's own.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::{TcpListener, TcpStream};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use serde_json::Value;

use crate::port::free_port;

/// A running `oapwatch run` on a free port; killed when dropped.
pub struct Daemon {
    child: Child,
    url: String,
    /// Reads the log as it is written: a pipe that is full stops who writes to it.
    log: JoinHandle<Vec<String>>,
}

impl Daemon {
    pub fn start(dir: &Path, config: &str) -> Self {
        Self::start_as(dir, "run", config)
    }

    /// As another command than `run`.
    pub fn start_as(dir: &Path, command: &str, config: &str) -> Self {
        Self::start_logging_to(Stdio::piped(), dir, command, config)
    }

    /// With its log elsewhere than in what [`Self::end`] gives, unless that is a pipe.
    pub fn start_logging_to(log: Stdio, dir: &Path, command: &str, config: &str) -> Self {
        let port = free_port();
        let file = dir.join("oapwatch.toml");
        std::fs::write(&file, config).unwrap();
        // Figures are to be of the program as it is shipped, whatever the test was built as.
        let program = std::env::var_os("OAPWATCH_PROGRAM").unwrap_or_else(|| env!("CARGO_BIN_EXE_oapwatch").into());
        let mut child = Command::new(program)
            .args([command, "--config"])
            .arg(&file)
            .args(["--listen", &format!("127.0.0.1:{port}")])
            .stderr(log)
            .spawn()
            .unwrap();
        let lines = child.stderr.take().map(|stderr| BufReader::new(stderr).lines());
        let log = std::thread::spawn(move || lines.into_iter().flatten().map_while(Result::ok).collect());
        let url = format!("http://127.0.0.1:{port}");
        Self { child, url, log }
    }

    /// Asks until `accept` takes the answer; fails after 20 s.
    pub fn wait_for(&self, path: &str, what: &str, accept: impl Fn(&Value) -> bool) -> Value {
        let end = Instant::now() + Duration::from_secs(20);
        let mut last = String::new();
        while Instant::now() < end {
            if let Some((200, body)) = request(&self.url, "GET", path, "", "") {
                match serde_json::from_str(&body) {
                    Ok(value) if accept(&value) => return value,
                    _ => last = body,
                }
            }
            std::thread::sleep(Duration::from_millis(50));
        }
        panic!("no {what} within 20 s; {path} last said {last}");
    }

    /// Waits until it answers; fails after 20 s.
    pub fn wait_until_up(&self) {
        let end = Instant::now() + Duration::from_secs(20);
        while !matches!(request(&self.url, "GET", "/readyz", "", ""), Some((200, _))) {
            assert!(Instant::now() < end, "not ready within 20 s");
            std::thread::sleep(Duration::from_millis(50));
        }
    }

    /// Host and port.
    pub fn url(&self) -> &str {
        &self.url
    }

    pub fn address(&self) -> &str {
        self.url.trim_start_matches("http://")
    }

    pub fn get(&self, path: &str) -> (u16, String) {
        self.get_as(path, None)
    }

    pub fn get_as(&self, path: &str, token: Option<&str>) -> (u16, String) {
        let header = token.map_or(String::new(), |t| format!("Authorization: Bearer {t}\r\n"));
        request(&self.url, "GET", path, &header, "").expect("an answer")
    }

    /// Resident memory.
    pub fn resident_mib(&self) -> u64 {
        let status = std::fs::read_to_string(format!("/proc/{}/status", self.child.id())).unwrap();
        let line = status.lines().find_map(|l| l.strip_prefix("VmRSS:")).unwrap();
        let kib: u64 = line.trim_end_matches("kB").trim().parse().unwrap();
        kib / 1024
    }

    pub fn post(&self, path: &str, body: &str) -> (u16, String) {
        request(&self.url, "POST", path, "", body).expect("an answer")
    }

    /// A header of an answer.
    pub fn header(&self, path: &str, name: &str) -> String {
        let (_, head, _) = whole(&self.url, "GET", path, "", "").expect("an answer");
        let line = head
            .lines()
            .find_map(|l| l.split_once(": ").filter(|(n, _)| n.eq_ignore_ascii_case(name)));
        line.unwrap_or_else(|| panic!("no {name} in {head}")).1.to_owned()
    }

    /// As [`Daemon::send`], where it may be gone.
    pub fn ask(&self, method: &str, path: &str) -> Option<(u16, String)> {
        request(&self.url, method, path, "", "")
    }

    /// Time on a processor so far, s.
    pub fn cpu_s(&self) -> f64 {
        cpu_s(self.child.id())
    }

    /// Any request; `header` lines end with CRLF.
    pub fn send(&self, method: &str, path: &str, header: &str, body: &str) -> (u16, String) {
        request(&self.url, method, path, header, body).expect("an answer")
    }

    pub fn signal(&self, name: &str) {
        let status = Command::new("kill").args([name, &self.child.id().to_string()]).status();
        assert!(status.unwrap().success());
    }

    /// Waits for the end; gives the exit code and the log.
    pub fn end(mut self) -> (Option<i32>, Vec<String>) {
        let code = self.child.wait().unwrap().code();
        (code, self.take_log())
    }

    /// Of a process that has ended.
    fn take_log(&mut self) -> Vec<String> {
        let log = std::mem::replace(&mut self.log, std::thread::spawn(Vec::new));
        log.join().unwrap_or_default()
    }
}

impl Drop for Daemon {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
        if std::thread::panicking() {
            let log = self.take_log();
            let last = &log[log.len().saturating_sub(20)..];
            eprintln!("the log of {}, its end:\n{}", self.url, last.join("\n"));
        }
    }
}

/// Time that a process has spent on a processor, s; a second of `/proc` has 100 ticks.
pub fn cpu_s(process: u32) -> f64 {
    let stat = std::fs::read_to_string(format!("/proc/{process}/stat")).unwrap();
    // The second field, the name in brackets, may hold spaces.
    let fields: Vec<&str> = stat.rsplit(')').next().unwrap().split_whitespace().collect();
    let ticks = |k: usize| fields[k].parse::<f64>().unwrap();
    (ticks(11) + ticks(12)) / 100.0
}

/// Status and body of an answer.
fn request(url: &str, method: &str, path: &str, header: &str, body: &str) -> Option<(u16, String)> {
    whole(url, method, path, header, body).map(|(status, _, body)| (status, body))
}

/// Status, head and body of an answer.
fn whole(url: &str, method: &str, path: &str, header: &str, body: &str) -> Option<(u16, String, String)> {
    let address = url.strip_prefix("http://")?;
    let mut stream = TcpStream::connect(address).ok()?;
    stream.set_read_timeout(Some(Duration::from_secs(10))).ok()?;
    let length = body.len();
    write!(
        stream,
        "{method} {path} HTTP/1.0\r\nHost: {address}\r\nContent-Length: {length}\r\n{header}Connection: close\r\n\r\n{body}"
    )
    .ok()?;
    let mut answer = String::new();
    stream.read_to_string(&mut answer).ok()?;
    let (head, body) = answer.split_once("\r\n\r\n")?;
    Some((head.split(' ').nth(1)?.parse().ok()?, head.to_owned(), body.to_owned()))
}

pub fn alerts(value: &Value) -> &[Value] {
    value["alerts"].as_array().map_or(&[], Vec::as_slice)
}

/// A webhook receiver that answers `first` once, then 204; gives its port and the requests so far.
pub fn receiver(first: &'static str) -> (u16, Arc<Mutex<Vec<String>>>) {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let port = listener.local_addr().unwrap().port();
    let requests: Arc<Mutex<Vec<String>>> = Arc::default();
    let seen = requests.clone();
    std::thread::spawn(move || {
        let answers = std::iter::once(first).chain(std::iter::repeat("204 No Content"));
        for (stream, status) in listener.incoming().zip(answers) {
            let Ok(mut stream) = stream else { return };
            let mut request = Vec::new();
            let mut buffer = [0; 4096];
            // The body's end is the last brace: it is JSON.
            while !request.ends_with(b"}") {
                match stream.read(&mut buffer) {
                    Ok(n) if n > 0 => request.extend_from_slice(&buffer[..n]),
                    _ => break,
                }
            }
            let request = String::from_utf8_lossy(&request).into_owned();
            seen.lock().unwrap().push(request);
            let _ = write!(
                stream,
                "HTTP/1.1 {status}\r\ncontent-length: 0\r\nconnection: close\r\n\r\n"
            );
        }
    });
    (port, requests)
}
