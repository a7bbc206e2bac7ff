//! Headless Chromium over its DevTools protocol: as much of it as a test of one page needs.

use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use base64::Engine;
use futures_util::{SinkExt, StreamExt};
use serde_json::{Value, json};
use tokio::net::TcpStream;
use tokio::time::timeout;
use tokio_tungstenite::tungstenite::Message;
use tokio_tungstenite::{MaybeTlsStream, WebSocketStream, connect_async};

const PATIENCE: Duration = Duration::from_secs(30);

pub struct Browser {
    process: Child,
    socket: WebSocketStream<MaybeTlsStream<TcpStream>>,
    last_id: u64,
    errors: Vec<String>,
}

impl Drop for Browser {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

fn start(profile: &Path, url: &str) -> Option<Child> {
    let names = ["chromium", "chromium-browser", "google-chrome"];
    let started = names.iter().find_map(|name| {
        Command::new(name)
            .args([
                "--headless",
                "--no-sandbox",
                "--disable-gpu",
                "--disable-quic",
                "--no-first-run",
            ])
            .args([
                "--disable-background-networking",
                "--disable-component-update",
                "--disable-sync",
            ])
            .args(["--window-size=1400,900", "--remote-debugging-port=0"])
            .arg(format!("--user-data-dir={}", profile.display()))
            .arg(url)
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .ok()
    });
    if started.is_none() {
        assert!(std::env::var_os("CI").is_none(), "none of {names:?} is installed");
        eprintln!("SKIPPED: the page is not tested, since none of {names:?} is installed");
    }
    started
}

impl Browser {
    /// Opens a page; `None`, and says so, where no browser is installed (an error in CI).
    pub async fn open(profile: &Path, url: &str) -> Option<Self> {
        let process = start(profile, url)?;
        let started = Instant::now();
        let port = loop {
            if let Ok(text) = std::fs::read_to_string(profile.join("DevToolsActivePort"))
                && let Some(port) = text.lines().next().and_then(|p| p.parse::<u16>().ok())
            {
                break port;
            }
            assert!(started.elapsed() < PATIENCE, "the browser does not start");
            tokio::time::sleep(Duration::from_millis(50)).await;
        };
        let target = loop {
            if let Some(target) = page_target(port).await {
                break target;
            }
            assert!(started.elapsed() < PATIENCE, "the browser opens no page");
            tokio::time::sleep(Duration::from_millis(50)).await;
        };
        let (socket, _) = connect_async(target).await.expect("the browser listens");
        let mut browser = Self {
            process,
            socket,
            last_id: 0,
            errors: Vec::new(),
        };
        browser.call("Runtime.enable", json!({})).await;
        Some(browser)
    }

    async fn call(&mut self, method: &str, params: Value) -> Value {
        self.last_id += 1;
        let request = json!({"id": self.last_id, "method": method, "params": params}).to_string();
        self.socket
            .send(Message::Text(request.into()))
            .await
            .expect("the browser listens");
        loop {
            let message = timeout(PATIENCE, self.socket.next())
                .await
                .expect("the browser answers");
            let Message::Text(text) = message.expect("the browser lives").expect("the browser lives") else {
                continue;
            };
            let answer: Value = serde_json::from_str(&text).expect("JSON");
            if answer["method"] == "Runtime.exceptionThrown" {
                self.errors.push(answer["params"]["exceptionDetails"].to_string());
            }
            if answer["id"] == self.last_id {
                return answer["result"].clone();
            }
        }
    }

    /// Value of an expression in the page; null while the page is not there.
    pub async fn eval(&mut self, expression: &str) -> Value {
        let params = json!({"expression": expression, "returnByValue": true});
        self.call("Runtime.evaluate", params).await["result"]["value"].clone()
    }

    /// Exceptions that nothing in the page caught.
    pub fn errors(&self) -> Vec<String> {
        self.errors.clone()
    }

    pub async fn screenshot(&mut self, name: &str) {
        let Some(dir) = super::pictures() else { return };
        let answer = self.call("Page.captureScreenshot", json!({"format": "png"})).await;
        let data = answer["data"].as_str().expect("a picture");
        let png = base64::prelude::BASE64_STANDARD.decode(data).expect("base64");
        std::fs::write(dir.join(format!("{name}.png")), png).expect("the picture is written");
    }
}

/// Asks the browser for its page's address.
async fn page_target(port: u16) -> Option<String> {
    // reqwest is built without a default; a second installation finds the first in place.
    let _ = rustls::crypto::ring::default_provider().install_default();
    let answer = reqwest::get(format!("http://127.0.0.1:{port}/json/list")).await.ok()?;
    let targets: Value = serde_json::from_slice(&answer.bytes().await.ok()?).ok()?;
    let page = targets.as_array()?.iter().find(|t| t["type"] == "page")?;
    page["webSocketDebuggerUrl"].as_str().map(str::to_owned)
}
