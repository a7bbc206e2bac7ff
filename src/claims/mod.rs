//! Positions that the access network asserts. An attacker may write them; nothing below the
//! monitor ever sees one.

mod ahead;
mod body;
mod candidates;
mod config;
mod ellipse;
mod follower;
mod format;
mod history;
mod inbox;
mod line;
mod outcome;
mod pressure;
mod registry;
mod roster;
mod rotated;
mod store;

pub use body::parse_body;
pub use candidates::{Bearing, MOST_UNANSWERED};
pub use config::{Config, ConfigError, Fields, Format};
pub use follower::{Follower, LONGEST_LINE, Poll, Refused, read_log};
pub use format::{LineReader, parse_line};
pub use history::Standing;
pub use inbox::{Batch, Inbox, MOST_NEW};
pub use line::LineError;
pub use outcome::{NO_ROOM, Outcome};
pub use pressure::{Squeeze, WINDOW_S};
pub use roster::Roster;
pub use store::{Beam, Counts, Store};

pub use crate::claim::{Claim, ClaimState};
