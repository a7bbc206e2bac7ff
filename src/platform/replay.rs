//! Poses from an NDJSON file or a flight log, handed out as the frames' time goes on.

use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};

use jiff::Timestamp;
use serde_json::Value;

use super::place::Unplaced;
use super::px4_log;
use crate::geo::{self, Geodetic, LocalAxes};
use crate::pose::{AttitudeError, Pose, PoseSigmas, attitude_of};
use crate::time::seconds;
use crate::ulog;

/// How far ahead of a frame poses are read, s: a pose after it to interpolate to, also where the file is a little out of order.
const AHEAD_S: f64 = 1.0;
/// Largest coordinate, m, that is not a mistake of units.
const FARTHEST_M: f64 = 1e7;

/// Why a file of poses cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    #[error("{path}: expected a readable file of poses, found: {source}")]
    Unreadable { path: PathBuf, source: std::io::Error },
    #[error("{path}:{line}: {source}")]
    Line {
        path: PathBuf,
        line: usize,
        source: LineError,
    },
    #[error("{path}: expected poses, found an empty file")]
    Empty { path: PathBuf },
    #[error(transparent)]
    Log(#[from] ulog::Error),
    #[error("{path}: expected attitudes and positions, found a flight log without {missing}")]
    Incomplete { path: PathBuf, missing: &'static str },
    #[error("{path}: the flight log has no GNSS time: set platform.poses_start, the time of its first attitude")]
    NoTime { path: PathBuf },
    #[error("{path}: {source}")]
    Unplaced { path: PathBuf, source: Unplaced },
}

/// Why a line is no pose.
#[derive(Debug, thiserror::Error)]
pub enum LineError {
    #[error("not a JSON object: {0}")]
    NotJson(#[from] serde_json::Error),
    #[error("field `{field}`: expected {expected}, found {found}")]
    Wrong {
        field: &'static str,
        expected: &'static str,
        found: String,
    },
    #[error("field `q`: {0}")]
    Attitude(#[from] AttitudeError),
    #[error("field `latitude_deg`: expected [world] origin in the config, found none")]
    NoOrigin,
}

/// A recording of poses.
#[derive(Debug)]
pub struct Replay {
    poses: std::vec::IntoIter<Recorded>,
    upcoming: Option<Pose>,
}

/// A pose as compact as a file needs it: an hour at 100 Hz is 35 MB.
#[derive(Clone, Copy, Debug)]
struct Recorded {
    time: Timestamp,
    position_m: [f64; 3],
    q: [f64; 4],
    sigmas: PoseSigmas,
}

impl Replay {
    /// Reads and checks all of a file: NDJSON, or a flight log of PX4 (`.ulg`), whose first attitude is at `log_start`; left out,
    /// the log's GNSS time says when.
    pub fn open(path: &Path, world: &geo::Config, log_start: Option<Timestamp>) -> Result<Self, Error> {
        let poses = match path.extension().is_some_and(|e| e == "ulg") {
            true => logged(path, world, log_start)?,
            false => lines(path, world.axes().as_ref())?,
        };
        Ok(Self {
            poses: poses.into_iter(),
            upcoming: None,
        })
    }

    /// The next poses up to a moment after `time`.
    pub fn until(&mut self, time: Timestamp) -> Vec<Pose> {
        let mut due = Vec::new();
        while let Some(pose) = self.upcoming.take().or_else(|| Some(self.poses.next()?.pose())) {
            if seconds(time, pose.time) > AHEAD_S {
                self.upcoming = Some(pose);
                break;
            }
            due.push(pose);
        }
        due
    }
}

impl Recorded {
    fn pose(self) -> Pose {
        Pose {
            time: self.time,
            position_m: self.position_m,
            attitude: attitude_of(self.q).unwrap_or_default(),
            cov: self.sigmas.cov(),
        }
    }
}

fn lines(path: &Path, axes: Option<&LocalAxes>) -> Result<Vec<Recorded>, Error> {
    let unreadable = |source| Error::Unreadable {
        path: path.to_owned(),
        source,
    };
    let file = std::fs::File::open(path).map_err(unreadable)?;
    let mut poses = Vec::new();
    for (k, line) in BufReader::new(file).split(b'\n').enumerate() {
        let line = line.map_err(unreadable)?;
        if line.trim_ascii().is_empty() {
            continue;
        }
        let pose = parse_line(&line, axes).map_err(|source| Error::Line {
            path: path.to_owned(),
            line: k + 1,
            source,
        })?;
        poses.push(pose);
    }
    if poses.is_empty() {
        return Err(Error::Empty { path: path.to_owned() });
    }
    Ok(poses)
}

fn logged(path: &Path, world: &geo::Config, start: Option<Timestamp>) -> Result<Vec<Recorded>, Error> {
    let log = ulog::read(path)?;
    let incomplete = |missing| Error::Incomplete {
        path: path.to_owned(),
        missing,
    };
    let first_us = log.attitudes.iter().map(|a| a.time_us).min();
    let first_us = first_us.ok_or_else(|| incomplete("attitudes"))?;
    let first = match start {
        Some(start) => start.as_microsecond(),
        None => {
            let offset = log
                .utc_minus_boot_us
                .ok_or_else(|| Error::NoTime { path: path.to_owned() })?;
            offset.saturating_add_unsigned(first_us)
        }
    };
    let default = PoseSigmas::default();
    let poses = px4_log::poses(&log, default).into_iter().map(|pose| {
        let since_us = i64::try_from(pose.time_us - first_us).unwrap_or(i64::MAX);
        let q = pose.attitude.quaternion();
        let unplaced = |source| Error::Unplaced {
            path: path.to_owned(),
            source,
        };
        Ok(Recorded {
            time: Timestamp::from_microsecond(first.saturating_add(since_us)).unwrap_or_default(),
            position_m: pose.place.local_m(world).map_err(unplaced)?,
            q: [q.w, q.i, q.j, q.k],
            sigmas: PoseSigmas {
                position_m: pose.cov.fixed_view::<3, 3>(3, 3).diagonal().max().sqrt(),
                ..default
            },
        })
    });
    let poses = poses.collect::<Result<Vec<_>, Error>>()?;
    match poses.is_empty() {
        true => Err(incomplete("positions")),
        false => Ok(poses),
    }
}

fn parse_line(line: &[u8], axes: Option<&LocalAxes>) -> Result<Recorded, LineError> {
    let object: Value = serde_json::from_slice(line)?;
    let time = match object.get("time").and_then(Value::as_str).map(str::parse::<Timestamp>) {
        Some(Ok(time)) => time,
        _ => return Err(wrong(&object, "time", "an RFC 3339 time")),
    };
    let number = |field: &'static str, expected: &'static str, most: f64| {
        let value = object.get(field).and_then(Value::as_f64);
        value
            .filter(|v| v.is_finite() && v.abs() <= most)
            .ok_or_else(|| wrong(&object, field, expected))
    };
    const METRES: &str = "metres within 10000 km of the origin";
    let position_m = if object.get("latitude_deg").is_some() {
        let place = Geodetic {
            latitude_deg: number("latitude_deg", "degrees between -90 and 90", 90.0)?,
            longitude_deg: number("longitude_deg", "degrees between -180 and 180", 180.0)?,
            height_m: number("height_m", "metres above the origin's datum", FARTHEST_M)?,
        };
        axes.ok_or(LineError::NoOrigin)?.to_local(place)
    } else {
        [
            number("x_m", METRES, FARTHEST_M)?,
            number("y_m", METRES, FARTHEST_M)?,
            number("z_m", METRES, FARTHEST_M)?,
        ]
    };
    const QUATERNION: &str = "four finite numbers [w, x, y, z]";
    let q: Vec<f64> = object
        .get("q")
        .and_then(Value::as_array)
        .map(|q| q.iter().filter_map(Value::as_f64).collect())
        .unwrap_or_default();
    let q: [f64; 4] = q.try_into().map_err(|_| wrong(&object, "q", QUATERNION))?;
    attitude_of(q)?;
    let sigma = |field: &'static str, expected: &'static str, most: f64, missing: f64| match object.get(field) {
        None | Some(Value::Null) => Ok(missing),
        Some(value) => value
            .as_f64()
            .filter(|s| (0.0..=most).contains(s))
            .ok_or_else(|| wrong(&object, field, expected)),
    };
    let default = PoseSigmas::default();
    let sigmas = PoseSigmas {
        attitude_rad: sigma("attitude_sigma_rad", "0 to 3.2 (radians)", 3.2, default.attitude_rad)?,
        position_m: sigma("position_sigma_m", "0 to 100000 (metres)", 1e5, default.position_m)?,
    };
    Ok(Recorded {
        time,
        position_m,
        q,
        sigmas,
    })
}

fn wrong(object: &Value, field: &'static str, expected: &'static str) -> LineError {
    let mut found = object.get(field).map_or("nothing".to_owned(), Value::to_string);
    if found.len() > 80 {
        found = found.chars().take(77).chain(['…']).collect();
    }
    LineError::Wrong { field, expected, found }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(line: &str) -> Result<Recorded, String> {
        parse_line(line.as_bytes(), None).map_err(|e| e.to_string())
    }

    #[test]
    fn a_line_with_and_without_sigmas() {
        let of = |rest: &str| {
            let line = format!(r#"{{"time":"2026-11-23T08:00:00Z","x_m":1,"y_m":2,"z_m":300,"q":[2,0,0,0]{rest}}}"#);
            parse(&line)
        };
        let pose = of("").expect("a pose").pose();
        assert_eq!(pose.position_m, [1.0, 2.0, 300.0]);
        assert_eq!(pose.attitude.angle(), 0.0);
        assert_eq!(pose.cov, PoseSigmas::default().cov());
        let exact = of(r#","attitude_sigma_rad":0.003,"position_sigma_m":1.5"#)
            .expect("a pose")
            .pose();
        assert!((exact.cov[(0, 0)] - 9e-6).abs() < 1e-18 && (exact.cov[(4, 4)] - 2.25).abs() < 1e-12);
        assert!(
            of(r#","position_sigma_m":-1"#)
                .unwrap_err()
                .contains("position_sigma_m")
        );
    }

    #[test]
    fn what_is_no_pose_says_which_field() {
        for (line, expected) in [
            ("[", "not a JSON object"),
            (r#"{"time":7}"#, "`time`"),
            (
                r#"{"time":"2026-11-23T08:00:00Z","x_m":1,"y_m":2,"z_m":"up","q":[1,0,0,0]}"#,
                "`z_m`: expected metres within 10000 km of the origin, found \"up\"",
            ),
            (
                r#"{"time":"2026-11-23T08:00:00Z","x_m":1,"y_m":2,"z_m":3,"q":[0,0,0,0]}"#,
                "`q`: expected a quaternion that is not zero",
            ),
            (
                r#"{"time":"2026-11-23T08:00:00Z","x_m":1,"y_m":2,"z_m":3,"q":[1,0,0]}"#,
                "`q`: expected four finite numbers",
            ),
            (
                r#"{"time":"2026-11-23T08:00:00Z","latitude_deg":1,"longitude_deg":2,"height_m":3,"q":[1,0,0,0]}"#,
                "[world] origin",
            ),
        ] {
            let error = parse(line).unwrap_err();
            assert!(error.contains(expected), "{error}");
        }
    }
}
