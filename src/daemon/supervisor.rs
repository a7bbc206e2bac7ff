//! What the service manager hears: ready after the first frame, a watchdog fed by results only, a status line.

use std::time::Duration;

use sd_notify::NotifyState;

/// Speaks to systemd; silent where there is none.
pub struct Supervisor {
    ready: bool,
    watchdog: Option<Duration>,
}

impl Supervisor {
    pub fn new() -> Self {
        Self {
            ready: false,
            watchdog: sd_notify::watchdog_enabled(),
        }
    }

    /// How often `alive` must be called at least; `None` when nobody watches.
    pub fn period(&self) -> Option<Duration> {
        self.watchdog.map(|w| w / 3)
    }

    /// A result was delivered, or the absence of input was established and reported.
    pub fn alive(&mut self, status: &str) {
        let mut states = vec![NotifyState::Watchdog, NotifyState::Status(status)];
        if !self.ready {
            states.push(NotifyState::Ready);
            self.ready = true;
        }
        send(&states);
    }

    pub fn reloading(&self) {
        if let Ok(now) = NotifyState::monotonic_usec_now() {
            send(&[NotifyState::Reloading, now]);
        }
    }

    pub fn reloaded(&self) {
        send(&[NotifyState::Ready]);
    }

    pub fn stopping(&self) {
        send(&[NotifyState::Stopping, NotifyState::Status("stopping")]);
    }
}

fn send(states: &[NotifyState]) {
    if let Err(error) = sd_notify::notify(states) {
        tracing::debug!(%error, "the service manager did not hear us");
    }
}
