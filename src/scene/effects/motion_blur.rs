//! Motion of emitters within an exposure.

use serde::{Deserialize, Serialize};

use super::table::Table;
use crate::toml_file::{Key, OutOfRange};

/// Emitters move during the exposure; without it each stays where it is in the middle. A speed v smears the spot evenly over
/// vT_int (on the ground), a variance of (vT_int)²/12.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MotionBlur {}

impl Table for MotionBlur {
    fn validate(&self, _field: &Key) -> Result<(), OutOfRange> {
        Ok(())
    }
}
