//! The guest program of `make test-v4l2`: runs inside the test machine, as root, on vivid's capture and output
//! nodes. It feeds frames through the kernel and holds what comes out to what went in, then provokes every fault
//! that the virtual camera offers.

mod bit_exact;
mod daemon;
mod faults;
mod first_camera;
mod output;

use std::os::unix::fs::PermissionsExt;
use std::process::{Command, ExitCode};
use std::time::{Duration, Instant};

use metrics_exporter_prometheus::{PrometheusBuilder, PrometheusHandle};
use oapwatch::frame::Frame;
use oapwatch::frames::{self, Capture, Next, SourceKind};
use oapwatch::optics::{self, Camera};

pub const CAPTURE: &str = "/dev/video0";
pub const OUTPUT: &str = "/dev/video1";
/// Emulated time; generous, because the host may be busy.
pub const PATIENCE: Duration = Duration::from_secs(60);

pub type Outcome = Result<(), Box<dyn std::error::Error>>;
type Scenario = (&'static str, fn(&PrometheusHandle) -> Outcome);

fn main() -> ExitCode {
    let recorder = PrometheusBuilder::new().build_recorder();
    let metrics = recorder.handle();
    metrics::set_global_recorder(recorder).expect("the first recorder");
    tracing_subscriber::fmt()
        .with_writer(std::io::stdout)
        .with_target(false)
        .with_ansi(false)
        .without_time()
        .init();

    let scenarios: Vec<Scenario> = [
        bit_exact::SCENARIOS,
        faults::SCENARIOS,
        first_camera::SCENARIOS,
        daemon::SCENARIOS,
    ]
    .concat();
    let chosen: Vec<String> = std::env::args().skip(1).collect();
    let (mut passed, mut failed) = (0, 0);
    for (name, run) in scenarios {
        if !chosen.is_empty() && !chosen.iter().any(|c| name.contains(c.as_str())) {
            continue;
        }
        let began = Instant::now();
        match run(&metrics) {
            Ok(()) => {
                passed += 1;
                println!("scenario {name} ... ok ({:.1} s)", began.elapsed().as_secs_f64());
            }
            Err(error) => {
                failed += 1;
                println!("scenario {name} ... FAILED: {error}");
            }
        }
    }
    println!("{passed} passed, {failed} failed");
    match failed {
        0 if passed > 0 => ExitCode::SUCCESS,
        _ => ExitCode::FAILURE,
    }
}

/// Who may open the first camera's capture node: what udev decides elsewhere.
pub fn allow(everybody: bool) -> Outcome {
    allow_on(CAPTURE, everybody)
}

pub fn allow_on(node: &str, everybody: bool) -> Outcome {
    let mode = if everybody { 0o666 } else { 0o600 };
    Ok(std::fs::set_permissions(node, std::fs::Permissions::from_mode(mode))?)
}

/// Runs v4l2-ctl on a node.
pub fn v4l2_ctl(node: &str, arguments: &[&str]) -> Outcome {
    let done = Command::new("v4l2-ctl").arg("-d").arg(node).args(arguments).output()?;
    match done.status.success() {
        true => Ok(()),
        false => Err(format!(
            "v4l2-ctl {arguments:?}: {}{}",
            String::from_utf8_lossy(&done.stdout),
            String::from_utf8_lossy(&done.stderr)
        )
        .into()),
    }
}

pub fn camera(pixels: [usize; 2], joules_per_count: f64) -> Camera {
    let optics = optics::Config {
        pixels,
        joules_per_count: Some(joules_per_count),
        ..optics::Config::default()
    };
    optics.camera().expect("a camera")
}

pub fn source(change: impl FnOnce(&mut frames::v4l2::Config)) -> frames::Config {
    let mut config = frames::Config {
        kind: SourceKind::V4l2,
        device: Some(CAPTURE.into()),
        rate_hz: Some(60.0),
        ..frames::Config::default()
    };
    change(&mut config.v4l2);
    config
}

/// A capture whose thread has no more rights on files than anybody.
pub fn start(config: &frames::Config, camera: &Camera) -> Result<Capture, Box<dyn std::error::Error>> {
    const NOBODY: libc::uid_t = 65534;
    let source = frames::open(config, camera)?;
    std::thread::scope(|scope| {
        let starter = scope.spawn(|| {
            // SAFETY: changes a credential of this thread only; the capture thread inherits it.
            unsafe { libc::setfsuid(NOBODY) };
            Capture::start(source)
        });
        Ok(starter.join().expect("no panic")?)
    })
}

/// The next thing of interest.
pub fn wait_for<T>(
    capture: &Capture,
    what: &str,
    mut pick: impl FnMut(Next) -> Option<T>,
) -> Result<T, Box<dyn std::error::Error>> {
    let deadline = Instant::now() + PATIENCE;
    let mut last = None;
    while Instant::now() < deadline {
        let next = capture.next(Duration::from_millis(100)).next;
        match &next {
            Next::End => return Err("the capture thread ended".into()),
            Next::Unusable { reason, .. } => last = Some(reason.clone()),
            _ => {}
        }
        if let Some(found) = pick(next) {
            return Ok(found);
        }
    }
    Err(format!("waited in vain for {what}; the last trouble was {last:?}").into())
}

pub fn frame(next: Next) -> Option<Frame> {
    match next {
        Next::Frame(frame, _) => Some(frame),
        _ => None,
    }
}
