//! Floor 4: alerts and webhook deliveries on disk, before anyone hears of them.

mod config;

pub use config::Config;
