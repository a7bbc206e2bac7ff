//! Composes the daemon: capture thread → latest-wins slot → compute thread → snapshot and events → tasks.
