//! Notifies the service manager (systemd): ready after the first frame, a watchdog fed by results only, a status line.

use sd_notify::NotifyState;

/// Sends notifications to systemd; does nothing where there is none.
#[derive(Default)]
pub struct Supervisor {
    ready: bool,
}

impl Supervisor {
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
        tracing::debug!(%error, "the service manager was not notified");
    }
}
