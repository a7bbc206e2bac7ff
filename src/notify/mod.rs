//! Floor 4: signed webhooks, at least once, in order per alert, from a durable outbox.

mod config;

pub use config::Config;
