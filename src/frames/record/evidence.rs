//! Reads the evidence of one alert: which frames, claims and poses its recording holds, and single frames of it.

use std::path::Path;

use jiff::Timestamp;
use serde::Serialize;

use super::tape::{Seen, TapeReader};
use crate::claim::Claim;
use crate::frame::Frame;
use crate::frames::{Error, Next, npy};
use crate::pose::{Pose, PoseRecord};

/// What the monitor was given around an alert.
#[derive(Clone, Debug, Serialize, utoipa::ToSchema)]
pub struct Evidence {
    /// Claims that stood when the recording begins, oldest first.
    pub claims: Vec<Claim>,
    /// The platform's poses until then, of about a second; none where it is fixed.
    #[schema(value_type = Vec<PoseRecord>)]
    pub poses: Vec<Pose>,
    /// What followed, in order.
    pub frames: Vec<EvidenceFrame>,
}

/// One thing that the monitor was given.
#[derive(Clone, Debug, Serialize, utoipa::ToSchema)]
pub struct EvidenceFrame {
    /// Position in the .npy file, from 0; null where there was no usable frame.
    pub position: Option<u64>,
    /// The source's own number of the frame.
    pub index: u64,
    #[schema(value_type = String, format = DateTime)]
    pub time: Timestamp,
    /// Why there is no frame.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub unusable: Option<String>,
    /// Claims that came with the frame, or since the one before.
    pub claims: Vec<Claim>,
    /// The platform's poses that came since the frame before.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    #[schema(value_type = Vec<PoseRecord>)]
    pub poses: Vec<Pose>,
}

/// The file name that an alert's evidence has.
pub fn file_name(alert: &str) -> String {
    // An id of ours needs no change; nothing else may name a path.
    let name = alert.replace(|c: char| !(c.is_ascii_alphanumeric() || c == '-' || c == '_'), "_");
    format!("{name}.npy")
}

impl Evidence {
    /// Reads the index beside a recording; it may still be growing.
    pub fn read(path: &Path) -> Result<Self, Error> {
        let (mut tape, standing) = TapeReader::open(path)?;
        let mut frames = Vec::new();
        let mut position = 0;
        while let Some(entry) = tape.entry()? {
            let has_pixels = entry.unusable.is_none();
            frames.push(EvidenceFrame {
                position: has_pixels.then_some(position),
                index: entry.index,
                time: entry.time,
                unusable: entry.unusable,
                claims: entry.arrivals.claims,
                poses: entry.arrivals.poses,
            });
            position += u64::from(has_pixels);
        }
        Ok(Self {
            claims: standing.claims,
            poses: standing.poses,
            frames,
        })
    }

    /// Position of the frame with this number or, where it is not there, of the one nearest in time.
    pub fn position_of(&self, index: u64, time: Timestamp) -> Option<u64> {
        let usable = || self.frames.iter().filter(|f| f.position.is_some());
        let exact = usable().find(|f| f.index == index);
        let nearest = || usable().min_by_key(|f| f.time.duration_since(time).abs());
        exact.or_else(nearest)?.position
    }
}

/// Reads one frame, with its mask, at a position in the .npy file.
pub fn frame_at(path: &Path, position: u64) -> Result<Option<Frame>, Error> {
    let (mut tape, _) = TapeReader::open(path)?;
    let mut passed = 0;
    while let Some(entry) = tape.entry()? {
        if entry.unusable.is_some() {
            continue;
        }
        if passed < position {
            passed += 1;
            continue;
        }
        let mut frames = npy::Reader::open(path, None)?;
        frames.seek(position)?;
        let Some(pixels) = frames.next().transpose()? else {
            return Ok(None);
        };
        let seen = Seen {
            entry,
            pixels: Some(pixels),
        };
        return Ok(match seen.next() {
            Next::Frame(frame, _) => Some(frame),
            _ => None,
        });
    }
    Ok(None)
}
