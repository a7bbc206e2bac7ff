//! Clients and logs that never come to an end.

use std::io::Write as _;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};

use tokio::io::{AsyncReadExt, AsyncWriteExt};

use super::super::process::Daemon;
use super::flood::connect;
use super::{FLOOR_US, RATE_HZ, address, compare, runtime, start, status};

#[test]
#[ignore = "minutes; make siege"]
fn siege_a_body_without_end() {
    let dir = tempfile::tempdir().unwrap();
    let daemon = start(dir.path(), RATE_HZ, "");
    let resident = daemon.resident_mib();
    let openings = [
        "POST /v1/claims HTTP/1.1\r\nhost: localhost\r\ntransfer-encoding: chunked\r\n\r\n",
        "POST /v1/claims HTTP/1.1\r\nhost: localhost\r\ncontent-length: 1000000000000\r\n\r\n",
        "GET /healthz HTTP/1.1\r\nhost: localhost\r\nx-endless: ",
    ];
    for opening in openings {
        let (taken, said) = runtime().block_on(async {
            let mut stream = connect(2, address(&daemon)).await.unwrap();
            stream.write_all(opening.as_bytes()).await.unwrap();
            let chunk = match opening.contains("chunked") {
                true => format!("10000\r\n{}\r\n", "x".repeat(0x10000)),
                false => "x".repeat(0x10000),
            };
            let (mut reader, mut writer) = stream.split();
            let mut taken = 0;
            let mut said = vec![0; 256];
            // Until it answers or hangs up; a hundred gigabytes say that it does neither.
            let hung_up = async {
                while taken < 100 << 30 && writer.write_all(chunk.as_bytes()).await.is_ok() {
                    taken += chunk.len();
                }
                // The answer may still be on its way.
                tokio::time::sleep(Duration::from_secs(1)).await;
            };
            let read = tokio::select! {
                biased;
                read = reader.read(&mut said) => read.unwrap_or(0),
                () = hung_up => 0,
            };
            said.truncate(read);
            (
                taken,
                String::from_utf8_lossy(&said)
                    .lines()
                    .next()
                    .unwrap_or_default()
                    .to_owned(),
            )
        });
        println!(
            "{:?}: {} KiB taken, then {said:?}",
            opening.lines().next_back(),
            taken >> 10
        );
        assert!(taken < 16 << 20, "{taken}");
        assert!(
            said.is_empty() || said.contains(" 413 ") || said.contains(" 431 "),
            "{said}"
        );
    }
    println!("resident {resident} MiB before, {} MiB after", daemon.resident_mib());
    assert!(daemon.resident_mib() < resident + 32);
}

#[test]
#[ignore = "minutes; make siege"]
fn siege_slow_loris() {
    let dir = tempfile::tempdir().unwrap();
    let daemon = start(dir.path(), RATE_HZ, "");
    let runtime = Arc::new(runtime());
    let to = address(&daemon);
    let stop = Arc::new(AtomicBool::new(false));
    let held = Arc::new(AtomicU64::new(0));
    let storm = || -> Box<dyn FnOnce()> {
        let tasks: Vec<_> = (0..3000u32)
            .map(|k| {
                let (stop, held) = (stop.clone(), held.clone());
                runtime.spawn(async move {
                    while !stop.load(Ordering::Relaxed) {
                        if let Ok(mut stream) = connect(2, to).await {
                            held.fetch_add(1, Ordering::Relaxed);
                            let _ = stream
                                .write_all(b"GET /v1/positions HTTP/1.1\r\nhost: localhost\r\n")
                                .await;
                            while !stop.load(Ordering::Relaxed) {
                                tokio::time::sleep(Duration::from_millis(2000 + u64::from(k % 100))).await;
                                if stream.write_all(b"x-a: b\r\n").await.is_err() {
                                    break;
                                }
                            }
                        }
                        tokio::time::sleep(Duration::from_millis(500)).await;
                    }
                })
            })
            .collect();
        // Until they have what they can get.
        std::thread::sleep(Duration::from_secs(3));
        let (runtime, stop) = (runtime.clone(), stop.clone());
        Box::new(move || {
            stop.store(true, Ordering::Relaxed);
            for task in tasks {
                runtime.block_on(task).unwrap();
            }
        })
    };
    let [calm, storm] = compare("3,000 slow requests from one address", &daemon, None, storm);
    println!("  {} connections made", held.load(Ordering::Relaxed));
    assert!(storm < 2 * calm.max(FLOOR_US), "{storm} µs against {calm} µs");
}

#[test]
#[ignore = "minutes; make siege"]
fn siege_a_gigabyte_of_garbage_in_the_log() {
    let dir = tempfile::tempdir().unwrap();
    let log = dir.path().join("claims.ndjson");
    let mut file = std::io::BufWriter::new(std::fs::File::create(&log).unwrap());
    let mut state = 1u64;
    let (mut lines, mut bytes) = (0u64, 0u64);
    while bytes < 1 << 30 {
        let mut block = [0u8; 4096];
        for word in block.chunks_exact_mut(8) {
            state ^= state << 13;
            state ^= state >> 7;
            state ^= state << 17;
            word.copy_from_slice(&state.to_le_bytes());
        }
        lines += block.iter().filter(|b| **b == b'\n').count() as u64;
        bytes += block.len() as u64;
        file.write_all(&block).unwrap();
    }
    file.write_all(b"\n").unwrap();
    lines += 1;
    file.flush().unwrap();
    let daemon = start(
        dir.path(),
        RATE_HZ,
        "[claims]\nlog = \"claims.ndjson\"\ntail_bytes = 1073741824\n",
    );
    let began = Instant::now();
    let malformed = |daemon: &Daemon| -> u64 {
        let metrics = daemon.get("/metrics").1;
        let line = metrics
            .lines()
            .find(|l| l.starts_with("oapwatch_claims_total{outcome=\"malformed\"}"));
        line.and_then(|l| l.rsplit(' ').next()?.parse().ok()).unwrap_or(0)
    };
    let (mut most, mut last, mut still) = (0, 0, 0);
    // Until nothing more is refused for three seconds: blank lines are passed over uncounted.
    while still < 6 && began.elapsed() < Duration::from_secs(300) {
        let now = malformed(&daemon);
        still = if now > 0 && now == last { still + 1 } else { 0 };
        last = now;
        most = most.max(daemon.resident_mib());
        std::thread::sleep(Duration::from_millis(500));
    }
    assert!(last as f64 > 0.99 * lines as f64, "{last} of {lines}");
    let took = began.elapsed();
    let seen = status(&daemon, None);
    let claim = format!(
        "{{\"time\":\"{}\",\"user\":\"u-after\",\"x_m\":1,\"y_m\":2}}\n",
        jiff::Timestamp::now()
    );
    std::fs::OpenOptions::new()
        .append(true)
        .open(&log)
        .unwrap()
        .write_all(claim.as_bytes())
        .unwrap();
    daemon.wait_for("/v1/users/u-after/position", "the claim after the garbage", |v| {
        v["claim"].is_object()
    });
    println!(
        "{bytes} bytes, {last} of {lines} lines refused in {took:.1?}; most resident {most} MiB; {} {}",
        seen["frames"], seen["latency"]
    );
    assert!(most < 150, "{most} MiB");
}
