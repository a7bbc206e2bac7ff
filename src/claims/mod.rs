//! Floor 2: positions that the access network asserts. An attacker may write them; nothing below the
//! monitor ever sees one.

mod config;

pub use config::Config;

pub use crate::claim::{Claim, ClaimState};
