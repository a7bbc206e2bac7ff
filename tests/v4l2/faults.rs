//! Every fault that the virtual camera offers: it must be counted, and frames must come again.

use std::fs;
use std::io::Read;
use std::process::Command;
use std::time::{Duration, Instant};

use metrics_exporter_prometheus::PrometheusHandle;
use oapwatch::frames::v4l2::PixelFormat;
use oapwatch::frames::{Capture, Next};

use crate::{CAPTURE, Outcome, PATIENCE, allow, camera, frame, source, start, v4l2_ctl, wait_for};

pub const SCENARIOS: &[(&str, fn(&PrometheusHandle) -> Outcome)] = &[
    ("devices are listed", |_| devices_are_listed()),
    ("dropped buffers", dropped_buffers),
    ("error flag", error_flag),
    ("failed VIDIOC_QBUF", |m| button(m, "inject_vidioc_qbuf_error", "io")),
    ("fatal streaming error", |m| {
        button(m, "inject_fatal_streaming_error", "io")
    }),
    ("failed VIDIOC_REQBUFS", |m| {
        failed_start(m, "inject_vidioc_reqbufs_error")
    }),
    ("failed VIDIOC_STREAMON", |m| {
        failed_start(m, "inject_vidioc_streamon_error")
    }),
    ("disconnect", |m| button(m, "disconnect", "gone")),
    ("unplug and replug", replug),
    ("starvation", starvation),
    ("signals", signals),
    ("time stamps that wrap", timestamps_wrap),
    ("sequence numbers that wrap", sequence_wraps),
    ("device busy", busy),
    ("format refused", format_refused),
    ("format change", format_change),
];

const CONNECTED: &str = "oapwatch_source_connected";

fn devices_are_listed() -> Outcome {
    let done = Command::new("oapwatch").arg("devices").output()?;
    let text = String::from_utf8(done.stdout)?;
    let expected = [
        "/dev/video0: vivid",
        "best: Y16 ",
        "Y16_BE",
        "Y10 ",
        "GREY ",
        "does not capture video by streaming",
    ];
    match expected.iter().find(|e| !text.contains(**e)) {
        None => Ok(()),
        Some(missing) => Err(format!("{missing:?} is not in:\n{text}").into()),
    }
}

/// A running capture of the camera's test image.
pub fn running() -> Result<Capture, Box<dyn std::error::Error>> {
    allow(true)?;
    v4l2_ctl(CAPTURE, &["-c", "percentage_of_dropped_buffers=0"])?;
    resize(640, 480)?;
    let config = source(|v4l2| {
        v4l2.pixel_format = Some(PixelFormat::Y16);
        v4l2.roi = Some([0, 0, 320, 320]);
        v4l2.stall_s = 2.0;
    });
    let capture = start(&config, &camera([32, 32], 1e-9))?;
    frames_go_on(&capture)?;
    Ok(capture)
}

fn resize(width: u32, height: u32) -> Outcome {
    let format = format!("width={width},height={height},pixelformat=Y16 ");
    v4l2_ctl(CAPTURE, &["--set-fmt-video", &format])
}

/// Twenty frames, numbered upwards, at times that grow.
pub fn frames_go_on(capture: &Capture) -> Outcome {
    let mut last = wait_for(capture, "a frame", frame)?;
    for _ in 0..20 {
        let next = wait_for(capture, "more frames", frame)?;
        if next.index <= last.index || next.time <= last.time {
            return Err(format!(
                "frame {} at {} after {} at {}",
                next.index, next.time, last.index, last.time
            )
            .into());
        }
        last = next;
    }
    Ok(())
}

fn value(metrics: &PrometheusHandle, name: &str) -> u64 {
    let text = metrics.render();
    let line = text.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(' '));
    line.and_then(|v| v.parse().ok()).unwrap_or(0)
}

pub fn fault(metrics: &PrometheusHandle, fault: &str) -> u64 {
    value(metrics, &format!("oapwatch_source_faults_total{{fault=\"{fault}\"}}"))
}

/// Provokes something and waits until it is counted.
fn provoke(metrics: &PrometheusHandle, capture: &Capture, name: &str, act: impl FnOnce() -> Outcome) -> Outcome {
    let before = fault(metrics, name);
    act()?;
    let deadline = Instant::now() + PATIENCE;
    while fault(metrics, name) == before {
        if Instant::now() > deadline {
            return Err(format!("{name} was never counted").into());
        }
        capture.next(Duration::from_millis(20));
    }
    Ok(())
}

fn press(control: &str) -> Outcome {
    v4l2_ctl(CAPTURE, &["-c", &format!("{control}=1")])
}

fn button(metrics: &PrometheusHandle, control: &str, name: &str) -> Outcome {
    let capture = running()?;
    provoke(metrics, &capture, name, || press(control))?;
    frames_go_on(&capture)
}

fn dropped_buffers(metrics: &PrometheusHandle) -> Outcome {
    let capture = running()?;
    provoke(metrics, &capture, "sequence_gap", || {
        v4l2_ctl(CAPTURE, &["-c", "percentage_of_dropped_buffers=30"])
    })?;
    v4l2_ctl(CAPTURE, &["-c", "percentage_of_dropped_buffers=0"])?;
    if value(metrics, "oapwatch_source_frames_lost_total") == 0 {
        return Err("no lost frame was counted".into());
    }
    frames_go_on(&capture)
}

fn error_flag(metrics: &PrometheusHandle) -> Outcome {
    let capture = running()?;
    let before = fault(metrics, "error_flag");
    press("inject_v4l2_buf_flag_error")?;
    wait_for(&capture, "the flagged frame", |next| match next {
        Next::Unusable { reason, .. } => reason.contains("corrupt").then_some(()),
        _ => None,
    })?;
    if fault(metrics, "error_flag") == before {
        return Err("the flagged frame was not counted".into());
    }
    frames_go_on(&capture)
}

/// The stream breaks, and the first try to start it again fails too.
fn failed_start(metrics: &PrometheusHandle, control: &str) -> Outcome {
    let capture = running()?;
    let before = fault(metrics, "io");
    provoke(metrics, &capture, "io", || {
        press(control)?;
        press("inject_fatal_streaming_error")
    })?;
    frames_go_on(&capture)?;
    match fault(metrics, "io") - before {
        2.. => Ok(()),
        n => Err(format!("{n} errors counted, expected that of the stream and that of its start").into()),
    }
}

fn replug(metrics: &PrometheusHandle) -> Outcome {
    let capture = running()?;
    let driver = "/sys/bus/platform/drivers/vivid";
    provoke(metrics, &capture, "gone", || {
        Ok(fs::write(format!("{driver}/unbind"), "vivid.0")?)
    })?;
    wait_for(&capture, "word that the device is gone", |next| match next {
        Next::Unusable { reason, .. } => reason.contains("no device").then_some(()),
        _ => None,
    })?;
    if value(metrics, CONNECTED) != 0 {
        return Err("the gauge says connected".into());
    }
    // The new node belongs to root alone until somebody (udev, or here the test) says otherwise.
    provoke(metrics, &capture, "permission", || {
        Ok(fs::write(format!("{driver}/bind"), "vivid.0")?)
    })?;
    allow(true)?;
    frames_go_on(&capture)?;
    match value(metrics, CONNECTED) {
        1 => Ok(()),
        _ => Err("the gauge says disconnected".into()),
    }
}

fn starvation(metrics: &PrometheusHandle) -> Outcome {
    let capture = running()?;
    let drop_all = || v4l2_ctl(CAPTURE, &["-c", "percentage_of_dropped_buffers=100"]);
    provoke(metrics, &capture, "stalled", drop_all)?;
    let mut told = 0;
    wait_for(&capture, "word every second", |next| {
        told += u32::from(matches!(next, Next::Unusable { .. }));
        (told == 3).then_some(())
    })?;
    v4l2_ctl(CAPTURE, &["-c", "percentage_of_dropped_buffers=0"])?;
    frames_go_on(&capture)
}

fn signals(metrics: &PrometheusHandle) -> Outcome {
    extern "C" fn ignore(_: libc::c_int) {}
    let capture = running()?;
    // SAFETY: the handler does nothing, which is safe at any moment.
    unsafe { libc::signal(libc::SIGUSR1, ignore as *const () as libc::sighandler_t) };
    let tasks = fs::read_dir("/proc/self/task")?.filter_map(Result::ok);
    let thread: i32 = tasks
        .filter(|t| fs::read_to_string(t.path().join("comm")).is_ok_and(|name| name.trim() == "capture"))
        .find_map(|t| t.file_name().to_str()?.parse().ok())
        .ok_or("no capture thread")?;
    let before = fault(metrics, "interrupted");
    let deadline = Instant::now() + PATIENCE;
    while fault(metrics, "interrupted") == before {
        if Instant::now() > deadline {
            return Err("no interrupted wait was counted".into());
        }
        // SAFETY: sends a signal that has a handler to a thread of ours.
        unsafe { libc::syscall(libc::SYS_tgkill, libc::getpid(), thread, libc::SIGUSR1) };
        capture.next(Duration::from_millis(5));
    }
    frames_go_on(&capture)
}

/// vivid starts its clock anew with the next stream.
fn timestamps_wrap(metrics: &PrometheusHandle) -> Outcome {
    let capture = running()?;
    let went_on = provoke(metrics, &capture, "timestamp_implausible", || {
        v4l2_ctl(CAPTURE, &["-c", "wrap_timestamp=2"])?;
        press("inject_fatal_streaming_error")
    })
    .and_then(|()| frames_go_on(&capture));
    v4l2_ctl(CAPTURE, &["-c", "wrap_timestamp=0"])?;
    press("inject_fatal_streaming_error")?;
    went_on?;
    frames_go_on(&capture)
}

/// vivid lets its counter pass 2³² soon after the stream has started.
fn sequence_wraps(metrics: &PrometheusHandle) -> Outcome {
    let lost = value(metrics, "oapwatch_source_frames_lost_total");
    v4l2_ctl(CAPTURE, &["-c", "wrap_sequence_number=1"])?;
    let went_on = running().and_then(|capture| (0..10).try_for_each(|_| frames_go_on(&capture)));
    v4l2_ctl(CAPTURE, &["-c", "wrap_sequence_number=0"])?;
    went_on?;
    match value(metrics, "oapwatch_source_frames_lost_total") - lost {
        // A busy host may cost the emulated camera a few frames; a wrap taken for a loss costs a million.
        0..1000 => Ok(()),
        n => Err(format!("{n} frames counted as lost at the wrap").into()),
    }
}

fn busy(metrics: &PrometheusHandle) -> Outcome {
    allow(true)?;
    let mut other = Command::new("v4l2-ctl")
        .args(["-d", CAPTURE, "--stream-mmap", "--stream-count=100000"])
        .stdout(std::process::Stdio::null())
        .stderr(std::process::Stdio::piped())
        .spawn()?;
    // The tool writes to stderr with every frame: from the first on, it holds the device.
    let mut frames = other.stderr.take().ok_or("v4l2-ctl without stderr")?;
    frames.read_exact(&mut [0])?;
    let config = source(|v4l2| v4l2.roi = Some([0, 0, 320, 320]));
    let capture = start(&config, &camera([32, 32], 1e-9))?;
    let counted = provoke(metrics, &capture, "busy", || Ok(()));
    other.kill()?;
    other.wait()?;
    counted?;
    frames_go_on(&capture)
}

fn format_refused(metrics: &PrometheusHandle) -> Outcome {
    allow(true)?;
    let config = source(|v4l2| v4l2.size = Some([31, 7]));
    let capture = start(&config, &camera([1, 1], 1e-9))?;
    provoke(metrics, &capture, "format_refused", || Ok(()))?;
    wait_for(&capture, "word of what was asked and granted", |next| match next {
        Next::Unusable { reason, .. } => {
            (reason.contains("31 × 7") && reason.contains("offers") && reason.contains("Y16")).then_some(())
        }
        _ => None,
    })
}

/// The image changes its size while the device is out of reach.
fn format_change(metrics: &PrometheusHandle) -> Outcome {
    let capture = running()?;
    provoke(metrics, &capture, "permission", || {
        allow(false)?;
        press("inject_fatal_streaming_error")
    })?;
    resize(800, 600)?;
    provoke(metrics, &capture, "format_changed", || allow(true))?;
    frames_go_on(&capture)
}
