//! Load: requests at a given rate over a few connections that stay open.

use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;

use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpSocket, TcpStream};

const CONNECTIONS: u32 = 40;
const BEAT: Duration = Duration::from_millis(20);

/// Requests sent, and answers by status.
#[derive(Debug, Default)]
pub struct Count {
    pub sent: AtomicU64,
    /// 2xx, 4xx other than 401 and 429, 401, 429, 5xx.
    pub answers: [AtomicU64; 5],
    pub connections_lost: AtomicU64,
}

impl Count {
    pub fn of(&self, kind: usize) -> u64 {
        self.answers[kind].load(Ordering::Relaxed)
    }

    pub fn total(&self) -> u64 {
        (0..self.answers.len()).map(|k| self.of(k)).sum()
    }

    fn note(&self, status: &[u8]) {
        let kind = match status {
            b"401" => 2,
            b"429" => 3,
            [b'2', ..] => 0,
            [b'5', ..] => 4,
            _ => 1,
        };
        self.answers[kind].fetch_add(1, Ordering::Relaxed);
    }
}

/// A connection that comes from another address than the observer's, so that its share of requests is its own.
pub async fn connect(from: u8, to: SocketAddr) -> std::io::Result<TcpStream> {
    let socket = TcpSocket::new_v4()?;
    socket.bind(SocketAddr::new(IpAddr::V4(Ipv4Addr::new(127, 0, 0, from)), 0))?;
    socket.connect(to).await
}

/// Sends what `request` makes of a running number, `per_second` in all, until `stop`; a lost connection is made anew.
pub async fn flood(
    to: SocketAddr,
    per_second: u32,
    stop: Arc<AtomicBool>,
    count: Arc<Count>,
    request: impl Fn(u64) -> String + Clone + Send + Sync + 'static,
) {
    let each = (per_second / CONNECTIONS).max(1);
    let tasks: Vec<_> = (0..CONNECTIONS)
        .map(|_| {
            let (stop, count, request) = (stop.clone(), count.clone(), request.clone());
            tokio::spawn(async move {
                while !stop.load(Ordering::Relaxed) {
                    if let Ok(stream) = connect(2, to).await {
                        ask(stream, each, &stop, &count, &request).await;
                    }
                    if !stop.load(Ordering::Relaxed) {
                        count.connections_lost.fetch_add(1, Ordering::Relaxed);
                        tokio::time::sleep(BEAT).await;
                    }
                }
            })
        })
        .collect();
    for task in tasks {
        let _ = task.await;
    }
}

/// One connection's requests, several under way at a time, until it is lost.
async fn ask(
    stream: TcpStream,
    per_second: u32,
    stop: &Arc<AtomicBool>,
    count: &Arc<Count>,
    request: &impl Fn(u64) -> String,
) {
    let _ = stream.set_nodelay(true);
    let (mut reader, mut writer) = stream.into_split();
    let answers = tokio::spawn({
        let count = count.clone();
        async move {
            let mut buffer = vec![0; 64 << 10];
            // What may be the beginning of a status line that the next read completes.
            let mut rest = Vec::new();
            while let Ok(n @ 1..) = reader.read(&mut buffer).await {
                rest.extend_from_slice(&buffer[..n]);
                let mut from = 0;
                while let Some(at) = find(&rest[from..]) {
                    let line = from + at;
                    if line + 12 > rest.len() {
                        break;
                    }
                    count.note(&rest[line + 9..line + 12]);
                    from = line + 12;
                }
                let keep = rest.len().saturating_sub(11).max(from);
                rest.drain(..keep);
            }
        }
    });
    let mut beat = tokio::time::interval(BEAT);
    let per_beat = per_second as f64 * BEAT.as_secs_f64();
    let mut due = 0.0;
    while !stop.load(Ordering::Relaxed) && !answers.is_finished() {
        beat.tick().await;
        due += per_beat;
        let mut text = String::new();
        while due >= 1.0 {
            text += &request(count.sent.fetch_add(1, Ordering::Relaxed));
            due -= 1.0;
        }
        if writer.write_all(text.as_bytes()).await.is_err() {
            break;
        }
    }
    // The answers to what is still under way.
    let _ = tokio::time::timeout(Duration::from_millis(500), answers).await;
}

fn find(bytes: &[u8]) -> Option<usize> {
    bytes.windows(9).position(|w| w == b"HTTP/1.1 ")
}
