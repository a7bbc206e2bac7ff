//! Bytes on the API's socket.

use std::io::{ErrorKind, Read, Write};
use std::net::TcpStream;
use std::sync::LazyLock;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use oapwatch::api::Config;
use tokio::runtime::Runtime;

use super::fake::Fake;

static API: LazyLock<(Runtime, Fake)> = LazyLock::new(|| {
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(1)
        .enable_all()
        .build()
        .expect("a runtime");
    let config = Config {
        requests_per_second: 1_000_000,
        ..Config::default()
    };
    let fake = runtime.block_on(async {
        let fake = Fake::start(config).await;
        fake.step(1);
        fake.alert("a", 1).await;
        fake
    });
    (runtime, fake)
});

/// A request of any bytes: an answer that is not "internal server error", or none; and the API still lives.
pub fn http(bytes: &[u8]) {
    let (_runtime, fake) = &*API;
    let answer = exchange(fake, bytes, Duration::from_millis(50));
    assert!(
        !answer.starts_with(b"HTTP/1.1 500"),
        "{}",
        String::from_utf8_lossy(&answer)
    );
    static REQUESTS: AtomicU64 = AtomicU64::new(0);
    if REQUESTS.fetch_add(1, Ordering::Relaxed).is_multiple_of(64) {
        let health = exchange(
            fake,
            b"GET /healthz HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\n\r\n",
            Duration::from_secs(20),
        );
        assert!(
            health.starts_with(b"HTTP/1.1 200"),
            "{}",
            String::from_utf8_lossy(&health)
        );
    }
}

/// The beginning of the answer; nothing where none comes within `patience`, as to half a request. Our side stays open: a
/// server may take its end for the end of interest in an answer.
fn exchange(fake: &Fake, request: &[u8], patience: Duration) -> Vec<u8> {
    let mut socket = TcpStream::connect(fake.address).expect("the API listens");
    // A reset at the end instead of a port that waits for a minute.
    let _ = socket2::SockRef::from(&socket).set_linger(Some(Duration::ZERO));
    socket.set_read_timeout(Some(patience)).expect("a time-out");
    let _ = socket.write_all(request);
    let mut answer = vec![0; 256];
    loop {
        match socket.read(&mut answer) {
            Ok(n) => break answer[..n].to_vec(),
            Err(e) if e.kind() == ErrorKind::Interrupted => {}
            Err(_) => break Vec::new(),
        }
    }
}
