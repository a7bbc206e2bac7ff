//! An autopilot's poses on their way to the frames.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use jiff::Timestamp;
use metrics::{counter, gauge};

use super::buffer::Outcome;
use super::config::{Config, ConfigError};
use super::inbox::PoseInbox;
use super::mavlink::{Event, Link, Moment, Reader, Relation, Sample};
use super::place::Unplaced;
use crate::geo;
use crate::metric;
use crate::pose::Pose;

/// Why an autopilot cannot be listened to.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    #[error(transparent)]
    Config(#[from] ConfigError),
    #[error("platform.endpoint: cannot listen on {endpoint}: {source}")]
    Listen { endpoint: String, source: std::io::Error },
}

/// Opens the link that a config names; none unless poses come from an autopilot.
///
/// # Errors
/// The key cannot be read, or the port of `udpin` cannot be had.
pub fn open(config: &Config) -> Result<Option<Link>, Error> {
    let listen = |source| Error::Listen {
        endpoint: config.endpoint.clone().unwrap_or_default(),
        source,
    };
    let settings = config.telemetry()?;
    settings
        .map(|settings| Link::open(settings).map_err(listen))
        .transpose()
}

/// A link that is being read. Dropping it ends its thread.
pub struct Telemetry {
    stop: Arc<AtomicBool>,
}

impl Telemetry {
    /// Starts reading a link into `inbox`. `world` says where local axes lie.
    ///
    /// # Errors
    /// No thread can be started.
    pub fn start(link: Link, inbox: PoseInbox, world: geo::Config) -> std::io::Result<Self> {
        let stop = Arc::new(AtomicBool::new(false));
        let mut unplaced: Option<Unplaced> = None;
        link.start(stop.clone(), move |event, moment, reader| match event {
            Event::Selected(_) => {}
            Event::Refused(why) => refused(why.name()),
            Event::Pose(sample) => {
                measure_clock(reader, moment);
                match pose(&sample, moment, &world) {
                    Ok(pose) => {
                        unplaced = None;
                        inbox.put(pose);
                    }
                    Err(why) => {
                        refused("unplaced");
                        // Logged once for each reason, not with each message.
                        if unplaced.replace(why) != Some(why) {
                            tracing::warn!("telemetry: {why}");
                        }
                    }
                }
            }
        })?;
        Ok(Self { stop })
    }
}

impl Drop for Telemetry {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
    }
}

/// Counts what became of a pose.
pub(super) fn count(outcome: Outcome) {
    match outcome {
        Outcome::Accepted | Outcome::OutOfOrder | Outcome::Restarted => counter!(metric::POSES).increment(1),
        Outcome::Duplicate => refused("duplicate"),
        Outcome::TooOld | Outcome::Jumped => refused("time"),
    }
}

fn pose(sample: &Sample, moment: Moment, world: &geo::Config) -> Result<Pose, Unplaced> {
    let unix_ns = moment
        .unix_ns
        .saturating_sub(moment.now_ns)
        .saturating_add(sample.time_ns);
    Ok(Pose {
        time: Timestamp::from_nanosecond(unix_ns.into()).unwrap_or_default(),
        position_m: sample.place.local_m(world)?,
        attitude: sample.attitude,
        cov: sample.cov,
    })
}

/// Counts a pose or a message that is not used.
pub(super) fn refused(reason: &'static str) {
    counter!(metric::POSE_REFUSED, "reason" => reason).increment(1);
}

fn measure_clock(reader: &Reader, moment: Moment) {
    if let Relation::Exchange { error_s } = reader.relation(moment.now_ns) {
        gauge!(metric::POSE_CLOCK_ERROR).set(error_s);
    }
}
