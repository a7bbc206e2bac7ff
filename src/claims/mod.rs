//! Floor 2: positions that the access network asserts. An attacker may write them; nothing below the
//! monitor ever sees one.

mod config;
mod follower;
mod line;
mod store;

pub use config::{Config, ConfigError, Fields, Origin};
pub use follower::{Follower, LONGEST_LINE, Poll, Refused, read_log};
pub use line::{LineError, parse_line};
pub use store::{Counts, Outcome, Standing, Store};

pub(crate) use store::seconds;

pub use crate::claim::{Claim, ClaimState};
