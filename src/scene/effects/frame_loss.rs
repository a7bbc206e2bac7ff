//! Frames lost or repeated on the link to the camera.

use rand::RngExt;
use serde::{Deserialize, Serialize};

use super::table::Table;
use crate::scene::effect::Effect;
use crate::scene::stream::{Ledger, Streams};
use crate::toml_file::{Key, OutOfRange};

/// The link to the camera drops or repeats each frame with the given probability.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct FrameLoss {
    pub dropped: f64,
    pub repeated: f64,
}

/// The fate of a frame on the link.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Fate {
    Delivered,
    /// Nothing arrived; its pixels are NaN.
    Dropped,
    /// The pixels of the last frame that was delivered arrived again.
    Repeated,
}

impl FrameLoss {
    pub(in crate::scene) fn fate(&self, k: u64, streams: Streams, ledger: &Ledger) -> Fate {
        let mut stream = streams.open(Effect::FrameLoss, 0, k, ledger);
        let u: f64 = stream.random();
        if u < self.dropped {
            Fate::Dropped
        } else if u < self.dropped + self.repeated {
            Fate::Repeated
        } else {
            Fate::Delivered
        }
    }
}

impl Table for FrameLoss {
    fn validate(&self, field: &Key) -> Result<(), OutOfRange> {
        field.at("dropped").fraction(self.dropped)?;
        field.at("repeated").fraction(self.repeated)?;
        if self.dropped + self.repeated >= 1.0 {
            return Err(field.at("repeated").refuse("less than 1 − dropped", self.repeated));
        }
        Ok(())
    }
}
