//! The whole program on the device: what the daemon says of frames from the kernel is what `locate` and `review` say
//! of the recording that it made of them; a camera's settings are read back.

use std::collections::BTreeMap;
use std::fs;
use std::io::{Read, Write};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use jiff::Timestamp;
use metrics_exporter_prometheus::PrometheusHandle;
use oapwatch::frames::v4l2::PixelFormat;
use oapwatch::scene::{Plan, Scene};
use serde_json::Value;

use crate::bit_exact::{corner, image, join, quantised};
use crate::faults::{fault, frames_go_on, running};
use crate::output::Output;
use crate::{CAPTURE, OUTPUT, Outcome, PATIENCE, camera, source, start, v4l2_ctl};

pub const SCENARIOS: &[(&str, fn(&PrometheusHandle) -> Outcome)] = &[
    ("daemon, recording, locate and review agree", |_| agreement()),
    ("gain read back", |_| gain()),
    ("exposure refused", exposure_refused),
];

const ADDRESS: &str = "127.0.0.1:8787";
const FOLDER: &str = "/tmp/daemon";
/// Scene frames, shown one after the other; the camera sees each several times.
const FRAMES: u64 = 80;
const SHOWN: Duration = Duration::from_millis(100);

const SCENE: &str = r#"
rate_hz = 10.0
[link]
integration_time_s = 0.1
[claims]
sigma_m = 0.5
[effects]
fading = { alpha = 4.0, beta = 2.0 }
thermal_noise = {}
[[user]]
name = "u-1"
motion.still = [-60, -40]
[[user]]
name = "u-2"
motion.still = [50, 30]
[[intruder]]
name = "shadow"
motion.still = [-10, 60]
"#;

const RECORD: &str = "[record]\nfolder = \"recordings\"\nsegment_s = 3.0\nbefore_s = 1.0\nafter_s = 1.0\n";

type Found<T> = Result<T, Box<dyn std::error::Error>>;

/// A running `oapwatch run`; killed when dropped.
struct Daemon(Child);

impl Daemon {
    fn start() -> Found<Self> {
        let log = fs::File::create(format!("{FOLDER}/log"))?;
        let daemon = Command::new("oapwatch")
            .args(["run", "--config", &config()])
            .stdout(Stdio::null())
            .stderr(log)
            .spawn()?;
        Ok(Self(daemon))
    }

    /// Ends it as systemd would.
    fn stop(mut self) -> Outcome {
        let began = Instant::now();
        let pid = libc::pid_t::try_from(self.0.id())?;
        // SAFETY: sends a signal to a child that has not been waited for.
        unsafe { libc::kill(pid, libc::SIGTERM) };
        let status = self.0.wait()?;
        match status.success() && began.elapsed() < Duration::from_secs(2) {
            true => Ok(()),
            false => Err(format!("stopped with {status} after {:?}\n{}", began.elapsed(), log()).into()),
        }
    }
}

impl Drop for Daemon {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn config() -> String {
    format!("{FOLDER}/oapwatch.toml")
}

fn log() -> String {
    fs::read_to_string(format!("{FOLDER}/log")).unwrap_or_default()
}

/// A fresh folder with a config for the device and, where there are users, their claims.
fn configure(joules_per_count: f64, more: &str) -> Outcome {
    let _ = fs::remove_dir_all(FOLDER);
    fs::create_dir_all(FOLDER)?;
    let [x, y] = corner(1);
    Ok(fs::write(
        config(),
        format!(
            "[optics]\npixels = [64, 64]\njoules_per_count = {joules_per_count:e}\n\
             [journal]\npath = \"journal.db\"\n[claims]\nlog = \"claims.ndjson\"\n\
             [source]\nkind = \"v4l2\"\ndevice = \"{CAPTURE}\"\nrate_hz = 60.0\n\
             [source.v4l2]\npixel_format = \"Y16\"\nroi = [{x}, {y}, 64, 64]\n{more}"
        ),
    )?)
}

/// The body of a good answer.
fn ask(path: &str) -> Found<String> {
    let mut stream = TcpStream::connect(ADDRESS)?;
    stream.set_read_timeout(Some(PATIENCE))?;
    write!(
        stream,
        "GET {path} HTTP/1.1\r\nHost: {ADDRESS}\r\nConnection: close\r\n\r\n"
    )?;
    let mut answer = String::new();
    stream.read_to_string(&mut answer)?;
    let (head, body) = answer.split_once("\r\n\r\n").ok_or("no body")?;
    match head.starts_with("HTTP/1.1 200") {
        true => Ok(body.to_owned()),
        false => Err(head.lines().next().unwrap_or_default().into()),
    }
}

fn get(path: &str) -> Found<Value> {
    Ok(serde_json::from_str(&ask(path)?)?)
}

fn is_ready() -> bool {
    ask("/readyz").is_ok()
}

fn agreement() -> Outcome {
    join(PixelFormat::Y16)?;
    let scene: Scene = toml::from_str(SCENE)?;
    let plan = Plan::compile(&scene, 7)?.starting_at(Timestamp::now());
    let made = plan.frames(0, FRAMES);
    let brightest = made
        .iter()
        .flat_map(|m| &m.frame.pixels)
        .fold(0.0, |a: f64, b| a.max(*b));
    let joules_per_count = brightest / (0.9 * f64::from(PixelFormat::Y16.full_scale()));
    let images: Vec<_> = made
        .iter()
        .map(|m| {
            let counts = quantised(&m.frame.pixels, joules_per_count, PixelFormat::Y16, 1);
            image(&counts, PixelFormat::Y16, 1)
        })
        .collect();
    // The default estimator takes a second a frame where floating point is emulated.
    configure(
        joules_per_count,
        &format!("[estimator]\nname = \"greedy-fit\"\n{RECORD}"),
    )?;
    let mut claims = fs::File::create(format!("{FOLDER}/claims.ndjson"))?;

    let mut output = Output::open(OUTPUT, false)?;
    output.show(&images[0])?;
    let daemon = Daemon::start()?;
    let ready = Instant::now();
    while !is_ready() {
        if ready.elapsed() > PATIENCE {
            return Err(format!("never ready\n{}", log()).into());
        }
        std::thread::sleep(Duration::from_millis(50));
    }
    let mut seen: BTreeMap<u64, Value> = BTreeMap::new();
    for (k, image) in images.iter().enumerate() {
        output.show(image)?;
        if k % 10 == 0 {
            for user in &scene.user {
                let [x, y] = made[k]
                    .truth
                    .emitters
                    .iter()
                    .find(|e| e.user.as_deref() == Some(&user.name))
                    .map_or([0.0; 2], |e| [e.x_m, e.y_m]);
                let now = Timestamp::now();
                writeln!(
                    claims,
                    r#"{{"time":"{now}","user":"{}","x_m":{x},"y_m":{y},"sigma_m":0.5}}"#,
                    user.name
                )?;
            }
        }
        let until = Instant::now() + SHOWN;
        while Instant::now() < until {
            let positions = get("/v1/positions")?;
            seen.insert(positions["frame"].as_u64().ok_or("no frame number")?, positions);
            std::thread::sleep(Duration::from_millis(20));
        }
    }
    let alerts = get("/v1/alerts?limit=100")?;
    daemon.stop()?;

    let compared = same_as_located(&seen)?;
    let raised = same_as_reviewed(&alerts)?;
    evidence_of(&alerts)?;
    println!(
        "{compared} emitters in {} frames agree, and {raised} alerts",
        seen.len()
    );
    Ok(())
}

/// Files of the recording, oldest first.
fn recordings(folder: &Path) -> Found<Vec<PathBuf>> {
    let mut found: Vec<PathBuf> = fs::read_dir(folder)?
        .filter_map(|e| Some(e.ok()?.path()))
        .filter(|p| p.extension().is_some_and(|e| e == "npy"))
        .collect();
    found.sort();
    match found.is_empty() {
        false => Ok(found),
        true => Err(format!("no recording in {}\n{}", folder.display(), log()).into()),
    }
}

fn stdout_of(arguments: &[&str]) -> Found<String> {
    let done = Command::new("oapwatch").args(arguments).output()?;
    match done.status.success() {
        true => Ok(String::from_utf8(done.stdout)?),
        false => Err(format!("oapwatch {arguments:?}: {}", String::from_utf8_lossy(&done.stderr)).into()),
    }
}

fn lines(text: &str) -> Found<Vec<Value>> {
    Ok(text.lines().map(serde_json::from_str).collect::<Result<_, _>>()?)
}

/// Every emitter that the daemon told of is one of `locate`'s in the same frame of the recording: the same energy to
/// the last bit, and a position (the daemon's is smoothed over frames) within 5 σ of a located one.
fn same_as_located(seen: &BTreeMap<u64, Value>) -> Found<usize> {
    let mut located: BTreeMap<u64, Value> = BTreeMap::new();
    for file in recordings(&Path::new(FOLDER).join("recordings"))? {
        let name = file.to_str().ok_or("a path of other than UTF-8")?;
        let index = lines(&fs::read_to_string(file.with_extension("frames.ndjson"))?)?;
        // The first line is the head; what was unusable has no frame.
        let numbers: Vec<u64> = index[1..]
            .iter()
            .filter(|e| e["unusable"].is_null())
            .filter_map(|e| e["index"].as_u64())
            .collect();
        let found = lines(&stdout_of(&["locate", "--config", &config(), name])?)?;
        if found.len() != numbers.len() {
            return Err(format!("{name}: {} frames, {} lines in its index", found.len(), numbers.len()).into());
        }
        located.extend(numbers.into_iter().zip(found));
    }
    let number = |v: &Value, key: &str| v[key].as_f64().ok_or(format!("no {key} in {v}"));
    let mut compared = 0;
    for (frame, positions) in seen {
        let there = located.get(frame).ok_or(format!("frame {frame} was not recorded"))?;
        let candidates = there["emitters"].as_array().ok_or(format!("frame {frame}: {there}"))?;
        for emitter in positions["emitters"].as_array().ok_or("no emitters")? {
            let energy = number(emitter, "energy_j")?;
            let same = candidates
                .iter()
                .find(|c| c["energy_j"].as_f64() == Some(energy))
                .ok_or_else(|| format!("frame {frame}: {emitter} is none of {there}"))?;
            for (axis, key) in ["x_m", "y_m"].into_iter().enumerate() {
                let variance = same["cov_m2"][axis][axis].as_f64().ok_or("no covariance")?;
                let off = (number(emitter, key)? - number(same, key)?).abs();
                // 5 cm is the least that the monitor takes for a position's error.
                if off > 5.0 * (variance.sqrt() + 0.05) {
                    return Err(format!("frame {frame}: {emitter} is {off} m from {same}").into());
                }
            }
            compared += 1;
        }
    }
    match compared {
        100.. => Ok(compared),
        few => Err(format!("only {few} emitters in {} frames to compare\n{}", seen.len(), log()).into()),
    }
}

/// What the recording, reviewed, raises is what the daemon raised, at the same frames and places.
fn same_as_reviewed(alerts: &Value) -> Found<usize> {
    let alerts = alerts["alerts"].as_array().ok_or("no alerts")?;
    let essence = |alert: &Value| {
        ["kind", "raised_at", "user", "claimed"]
            .map(|key| alert[key].to_string())
            .join(" ")
            + &format!(" frame {}", alert["source"]["frame"])
    };
    let mut raised: Vec<String> = alerts.iter().map(essence).collect();
    if !raised.iter().any(|a| a.contains("unclaimed_emitter")) {
        return Err(format!("the eavesdropper was not alerted: {raised:?}\n{}", log()).into());
    }
    let review = format!("{FOLDER}/review.toml");
    let text = fs::read_to_string(config())?
        .replace("kind = \"v4l2\"", "kind = \"replay\"\nframes = \"recordings\"")
        .replace("log = \"claims.ndjson\"", "")
        .replace(RECORD, "");
    fs::write(&review, text)?;
    let events = lines(&stdout_of(&["review", "--config", &review])?)?;
    let mut again: Vec<String> = events
        .iter()
        .filter(|e| e["event"] == "alert.raised")
        .map(|e| essence(&e["alert"]))
        .collect();
    raised.sort();
    again.sort();
    match raised == again {
        true => Ok(raised.len()),
        false => Err(format!("the daemon raised {raised:#?}, the review {again:#?}").into()),
    }
}

/// Around the eavesdropper's alert lies its evidence, a whole recording of its own.
fn evidence_of(alerts: &Value) -> Outcome {
    let id = alerts["alerts"]
        .as_array()
        .and_then(|a| a.iter().find(|a| a["kind"] == "unclaimed_emitter")?["id"].as_str())
        .ok_or("no alert with an id")?;
    let folder = Path::new(FOLDER).join("recordings/evidence");
    let files = recordings(&folder)?;
    let file = files
        .iter()
        .find(|f| f.to_string_lossy().contains(id))
        .ok_or_else(|| format!("no evidence of {id} in {files:?}"))?;
    let found = lines(&stdout_of(&["locate", "--config", &config(), &file.to_string_lossy()])?)?;
    match found.len() {
        10.. => Ok(()),
        few => Err(format!("{}: only {few} frames", file.display()).into()),
    }
}

/// The gain is set by hand, read back from the driver and logged.
fn gain() -> Outcome {
    drop(running()?);
    v4l2_ctl(CAPTURE, &["-c", "gain_automatic=1"])?;
    configure(1e-9, "gain = 77\n")?;
    fs::write(format!("{FOLDER}/claims.ndjson"), "")?;
    let daemon = Daemon::start()?;
    let began = Instant::now();
    while !(log().contains("the device is set up") && is_ready()) {
        if began.elapsed() > PATIENCE {
            return Err(format!("the device was never set up\n{}", log()).into());
        }
        std::thread::sleep(Duration::from_millis(50));
    }
    daemon.stop()?;
    let controls = Command::new("v4l2-ctl")
        .args(["-d", CAPTURE, "-C", "gain,gain_automatic"])
        .output()?;
    let controls = String::from_utf8(controls.stdout)?;
    let log = log();
    let line = log
        .lines()
        .find(|l| l.contains("the device is set up"))
        .unwrap_or_default();
    match controls.contains("gain: 77") && controls.contains("gain_automatic: 0") && line.contains(r#""gain":77"#) {
        true => Ok(()),
        false => Err(format!("the driver says {controls}, the log {line}").into()),
    }
}

/// The virtual camera has no exposure control: that is counted, and frames come all the same.
fn exposure_refused(metrics: &PrometheusHandle) -> Outcome {
    drop(running()?);
    let before = fault(metrics, "control_refused");
    let config = source(|v4l2| {
        v4l2.pixel_format = Some(PixelFormat::Y16);
        v4l2.roi = Some([0, 0, 320, 320]);
        v4l2.exposure_us = Some(5000.0);
    });
    let capture = start(&config, &camera([32, 32], 1e-9))?;
    frames_go_on(&capture)?;
    match fault(metrics, "control_refused") - before {
        0 => Err("the refusal was not counted".into()),
        _ => Ok(()),
    }
}
