//! Names and descriptions of all metrics, by Prometheus conventions: base units, `_total` on counters, no user ids as labels.
//! Modules count with the `metrics` macros under these names.

use metrics::Unit;
use metrics_exporter_prometheus::{BuildError, Matcher, PrometheusBuilder, PrometheusRecorder};

pub const FRAMES_CAPTURED: &str = "oapwatch_frames_captured_total";
pub const FRAMES_DROPPED: &str = "oapwatch_frames_dropped_total";
pub const FRAMES_UNUSABLE: &str = "oapwatch_frames_unusable_total";
/// The time budget of the estimator ended before its search did.
pub const FRAMES_CUT_SHORT: &str = "oapwatch_frames_cut_short_total";
/// The search ended at the most emitters that it looks for.
pub const FRAMES_LIMITED: &str = "oapwatch_frames_limited_total";
/// Weighted squared residual per degree of freedom of the latest frame.
pub const REDUCED_CHI2: &str = "oapwatch_frame_reduced_chi2";
/// Share of a spot's light by which the spots of the latest frame were taken to differ from the model.
pub const SPOT_ERROR: &str = "oapwatch_frame_spot_error";
pub const LAST_GOOD_FRAME: &str = "oapwatch_last_good_frame_timestamp_seconds";
/// Label `stage`: one of [`STAGES`].
pub const STAGE_SECONDS: &str = "oapwatch_stage_duration_seconds";
/// From the end of the exposure to the published report.
pub const FRAME_SECONDS: &str = "oapwatch_frame_latency_seconds";
/// Label `status`: verified, mismatch, unclaimed, pending, known, ignored.
pub const EMITTERS: &str = "oapwatch_emitters";
pub const USERS_UNSEEN: &str = "oapwatch_users_unseen";
/// Label `kind`.
pub const ALERTS_RAISED: &str = "oapwatch_alerts_raised_total";
/// Label `kind`.
pub const ALERTS_OPEN: &str = "oapwatch_alerts_open";
/// Label `outcome`: accepted, late (kept as history), duplicate, refused (contradicts, too old, store full), malformed, shed (more than there is time for).
pub const CLAIMS: &str = "oapwatch_claims_total";
pub const CLAIMS_LAST: &str = "oapwatch_claims_last_timestamp_seconds";
pub const CLAIMS_SKIPPED: &str = "oapwatch_claims_log_skipped_bytes_total";
pub const POSES: &str = "oapwatch_poses_total";
/// Label `reason`.
pub const POSE_REFUSED: &str = "oapwatch_pose_refused_total";
/// Of the newest pose, when it was last used.
pub const POSE_AGE: &str = "oapwatch_pose_age_seconds";
pub const POSE_CLOCK_ERROR: &str = "oapwatch_pose_clock_error_seconds";
/// Labels `endpoint` and `outcome`.
pub const WEBHOOK_ATTEMPTS: &str = "oapwatch_webhook_attempts_total";
/// Label `endpoint`, as of the three.
pub const WEBHOOK_QUEUED: &str = "oapwatch_webhook_queued";
pub const WEBHOOK_OLDEST: &str = "oapwatch_webhook_oldest_queued_seconds";
pub const WEBHOOK_DEAD_LETTERS: &str = "oapwatch_webhook_dead_letters";
/// Label `outcome`: stored, failed.
pub const FLEET_ALERTS: &str = "oapwatch_fleet_alerts_total";
/// Labels `topic` and `outcome`: sent, failed; at the hub: taken, or why refused.
pub const FLEET_MESSAGES: &str = "oapwatch_fleet_messages_total";
pub const FLEET_CONNECTED: &str = "oapwatch_fleet_connected";
pub const FLEET_WAITING: &str = "oapwatch_fleet_alerts_waiting";
/// Labels `endpoint` and `outcome`.
pub const EXPORT_HEARD: &str = "oapwatch_export_heard_total";
/// Labels `endpoint` and `outcome`.
pub const EXPORT_UPDATES: &str = "oapwatch_export_updates_total";
pub const JOURNAL_BYTES: &str = "oapwatch_journal_bytes";
/// 1 while alerts reach the disk.
pub const JOURNAL_WRITABLE: &str = "oapwatch_journal_writable";
pub const JOURNAL_UNWRITTEN: &str = "oapwatch_journal_unwritten_events";
pub const JOURNAL_LOST: &str = "oapwatch_journal_events_lost_total";
pub const JOURNAL_FAILURES: &str = "oapwatch_journal_write_failures_total";
pub const JOURNAL_WRITE_SECONDS: &str = "oapwatch_journal_write_seconds";
pub const SOURCE_CONNECTED: &str = "oapwatch_source_connected";
pub const RECORDER_DROPPED: &str = "oapwatch_recorder_dropped_total";
pub const RECORDER_ERRORS: &str = "oapwatch_recorder_errors_total";
pub const SOURCE_OPENED: &str = "oapwatch_source_opened_total";
pub const SOURCE_FRAMES_LOST: &str = "oapwatch_source_frames_lost_total";
/// Label `fault`.
pub const SOURCE_FAULTS: &str = "oapwatch_source_faults_total";
/// Labels `method`, `route` (the pattern, never the path) and `status`.
pub const HTTP_REQUESTS: &str = "oapwatch_http_requests_total";
/// Label `route`.
pub const HTTP_SECONDS: &str = "oapwatch_http_request_duration_seconds";
pub const HTTP_CONNECTIONS: &str = "oapwatch_http_connections";
/// Label `reason`: connections, share, rate, token, host, origin.
pub const HTTP_REFUSED: &str = "oapwatch_http_refused_total";
/// Label `protocol`: websocket, sse.
pub const STREAM_CLIENTS: &str = "oapwatch_stream_clients";
pub const STREAM_POSITIONS_MISSED: &str = "oapwatch_stream_positions_missed_total";
/// The metrics that every Prometheus client exports of its process.
pub const PROCESS_CPU: &str = "process_cpu_seconds_total";
pub const PROCESS_RESIDENT: &str = "process_resident_memory_bytes";
pub const PROCESS_VIRTUAL: &str = "process_virtual_memory_bytes";
pub const PROCESS_FDS: &str = "process_open_fds";
pub const PROCESS_MAX_FDS: &str = "process_max_fds";
pub const PROCESS_THREADS: &str = "process_threads";
pub const PROCESS_START: &str = "process_start_time_seconds";
/// Always 1; label `version`.
pub const BUILD_INFO: &str = "oapwatch_build_info";

/// Values of the label `stage`, in the order of the chain.
pub const STAGES: [&str; 4] = ["estimate", "monitor", "journal", "publish"];

/// Values of the label `outcome` of [`CLAIMS`].
const CLAIM_OUTCOMES: [&str; 6] = ["accepted", "late", "duplicate", "refused", "malformed", "shed"];

const LATENCY_BUCKETS: [f64; 14] = [
    50e-6, 100e-6, 250e-6, 500e-6, 1e-3, 2.5e-3, 5e-3, 10e-3, 25e-3, 50e-3, 100e-3, 250e-3, 1.0, 5.0,
];

/// The process's recorder. Install it once (`metrics::set_global_recorder`) and then call [`describe`].
pub fn recorder() -> Result<PrometheusRecorder, BuildError> {
    Ok(PrometheusBuilder::new()
        .set_buckets_for_metric(Matcher::Suffix("_seconds".into()), &LATENCY_BUCKETS)?
        .build_recorder())
}

/// Registers the help text of every metric and the initial values of those that must not be absent.
pub fn describe() {
    use metrics::{counter, describe_counter as c, describe_gauge as g, describe_histogram as h, gauge};

    c!(FRAMES_CAPTURED, "Frames the source delivered.");
    c!(
        FRAMES_DROPPED,
        "Frames replaced by a newer one before they were processed."
    );
    c!(
        FRAMES_UNUSABLE,
        "Frames that could not be used: wrong shape, error-flagged, no usable pixel."
    );
    c!(
        FRAMES_CUT_SHORT,
        "Frames whose estimate was cut short by the time budget."
    );
    c!(
        FRAMES_LIMITED,
        "Frames in which the estimator found as many emitters as it looks for; there may be more."
    );
    g!(
        LAST_GOOD_FRAME,
        Unit::Seconds,
        "Unix time of the last frame with a result; 0 before the first."
    );
    c!(POSES, "Poses of the autopilot that were taken.");
    c!(
        POSE_REFUSED,
        "Telemetry that was refused, by reason: malformed, checksum, other_system, unsigned, signature, replayed, time, attitude, position, frame, unplaced, duplicate."
    );
    g!(
        POSE_AGE,
        Unit::Seconds,
        "Age of the newest pose at the latest frame; absent on a fixed platform."
    );
    g!(
        POSE_CLOCK_ERROR,
        Unit::Seconds,
        "Largest error of the autopilot's clock against the camera's, by TIMESYNC; absent where it is not answered."
    );
    g!(
        REDUCED_CHI2,
        "Weighted squared residual per degree of freedom of the latest frame; near 1 where the model explains it."
    );
    g!(
        SPOT_ERROR,
        "Share of a spot's light by which the latest frame's spots differ from the model; 0 where it explains them."
    );
    h!(STAGE_SECONDS, Unit::Seconds, "Time a frame spends in each stage.");
    h!(
        FRAME_SECONDS,
        Unit::Seconds,
        "Time from a frame's arrival to its published report."
    );
    g!(EMITTERS, "Emitters in the latest frame, by status.");
    g!(USERS_UNSEEN, "Active users in view without an emitter.");
    c!(ALERTS_RAISED, "Alerts raised, by kind.");
    g!(ALERTS_OPEN, "Alerts that are not cleared, by kind.");
    c!(CLAIMS, "Claims received, by outcome.");
    c!(
        CLAIMS_SKIPPED,
        Unit::Bytes,
        "Bytes of the claims log that were not read: its beginning at the start, or more than could be read."
    );
    g!(
        CLAIMS_LAST,
        Unit::Seconds,
        "Unix time stated by the newest accepted claim; 0 before the first."
    );
    c!(
        WEBHOOK_ATTEMPTS,
        "Delivery attempts of webhooks and exports, by endpoint and outcome."
    );
    g!(WEBHOOK_QUEUED, "Deliveries of webhooks and exports in the queue.");
    g!(
        WEBHOOK_OLDEST,
        Unit::Seconds,
        "Age of the oldest delivery of a webhook or export in the queue."
    );
    g!(
        WEBHOOK_DEAD_LETTERS,
        "Deliveries of webhooks and exports that failed for good and are kept for a replay."
    );
    c!(FLEET_ALERTS, "Alert events published to the fleet, by outcome.");
    c!(
        FLEET_MESSAGES,
        "Fleet messages other than a station's alerts, by topic and outcome."
    );
    g!(FLEET_CONNECTED, "1 while the NATS server is connected.");
    g!(FLEET_WAITING, "Alert events that wait for the NATS server.");
    c!(
        EXPORT_HEARD,
        "Messages from the receivers of exports, by endpoint and what became of them."
    );
    c!(
        EXPORT_UPDATES,
        "Rounds of latest positions and open alerts to exports, by endpoint and outcome."
    );
    g!(JOURNAL_BYTES, Unit::Bytes, "Size of the journal on disk.");
    g!(JOURNAL_WRITABLE, "1 while alerts reach the disk, else 0.");
    g!(JOURNAL_UNWRITTEN, "Alert events in memory that are not on disk yet.");
    c!(JOURNAL_LOST, "Alert events lost because disk and memory were full.");
    c!(JOURNAL_FAILURES, "Writes to the journal that failed.");
    h!(
        JOURNAL_WRITE_SECONDS,
        Unit::Seconds,
        "Time of one transaction of the journal."
    );
    g!(SOURCE_CONNECTED, "1 while the camera is open, else 0.");
    c!(
        RECORDER_DROPPED,
        "Frames, evidence and messages to a hub not recorded because the disk could not keep up."
    );
    c!(
        RECORDER_ERRORS,
        "Writes of the recorder that failed, such as on a full disk."
    );
    c!(SOURCE_OPENED, "Times the camera was opened.");
    c!(SOURCE_FRAMES_LOST, "Frames lost by the driver.");
    c!(SOURCE_FAULTS, "Faults of the camera, by kind.");
    c!(HTTP_REQUESTS, "Requests answered, by method, route and status.");
    h!(HTTP_SECONDS, Unit::Seconds, "Time to answer a request, by route.");
    g!(HTTP_CONNECTIONS, "Open connections.");
    c!(HTTP_REFUSED, "Connections and requests refused, by reason.");
    g!(STREAM_CLIENTS, "Open streams, by protocol.");
    c!(STREAM_POSITIONS_MISSED, "Position messages dropped for slow readers.");
    c!(
        PROCESS_CPU,
        Unit::Seconds,
        "User and system time of the process, whole seconds."
    );
    g!(PROCESS_RESIDENT, Unit::Bytes, "Resident memory of the process.");
    g!(PROCESS_VIRTUAL, Unit::Bytes, "Virtual memory of the process.");
    g!(PROCESS_FDS, "Open file descriptors of the process.");
    g!(PROCESS_MAX_FDS, "Most file descriptors that the process may open.");
    g!(PROCESS_THREADS, "Threads of the process.");
    g!(PROCESS_START, Unit::Seconds, "Unix time at which the daemon started.");
    g!(BUILD_INFO, "The running version; always 1.");

    for name in [
        FRAMES_CAPTURED,
        FRAMES_DROPPED,
        FRAMES_UNUSABLE,
        FRAMES_CUT_SHORT,
        FRAMES_LIMITED,
        CLAIMS_SKIPPED,
        STREAM_POSITIONS_MISSED,
        JOURNAL_FAILURES,
        JOURNAL_LOST,
        RECORDER_DROPPED,
        RECORDER_ERRORS,
        SOURCE_OPENED,
        SOURCE_FRAMES_LOST,
    ] {
        counter!(name).increment(0);
    }
    for outcome in CLAIM_OUTCOMES {
        counter!(CLAIMS, "outcome" => outcome).increment(0);
    }
    // A rule on the age of these must fire also where the first never comes.
    for name in [LAST_GOOD_FRAME, CLAIMS_LAST] {
        gauge!(name).set(0.0);
    }
    gauge!(BUILD_INFO, "version" => env!("CARGO_PKG_VERSION")).set(1.0);
}

#[cfg(test)]
mod tests {
    /// The names of metrics in a text.
    fn names(text: &str) -> impl Iterator<Item = &str> {
        let words = text.split(|c: char| !(c.is_ascii_alphanumeric() || c == '_'));
        words.filter(|w| w.starts_with("oapwatch_") || w.starts_with("process_"))
    }

    #[test]
    fn rules_and_dashboard_use_metrics_that_exist() {
        let known: Vec<&str> = names(include_str!("metric.rs")).collect();
        for (file, text) in [
            ("prometheus-alerts.yml", include_str!("../deploy/prometheus-alerts.yml")),
            (
                "grafana-dashboard.json",
                include_str!("../deploy/grafana-dashboard.json"),
            ),
        ] {
            let used: Vec<&str> = names(text).collect();
            assert!(used.len() > 5, "{file}");
            for name in used {
                assert!(known.contains(&name.trim_end_matches("_bucket")), "{file}: {name}");
            }
        }
    }

    #[test]
    fn nothing_that_a_rule_needs_is_absent_at_the_start() {
        let recorder = super::recorder().unwrap();
        let handle = recorder.handle();
        metrics::with_local_recorder(&recorder, super::describe);
        let text = handle.render();
        for line in [
            "oapwatch_last_good_frame_timestamp_seconds 0",
            "oapwatch_claims_last_timestamp_seconds 0",
            "oapwatch_journal_events_lost_total 0",
            "oapwatch_recorder_errors_total 0",
            "oapwatch_claims_total{outcome=\"refused\"} 0",
        ] {
            assert!(text.lines().any(|l| l == line), "{line} is not in:\n{text}");
        }
    }
}
