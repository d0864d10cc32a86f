//! Notifies the service manager (systemd's `sd_notify`), if one started this program: ready, alive, stopping. A failed
//! notification is not an error; the manager notices it by itself.

use carff_transport::monotonic_now_ns;
use sd_notify::NotifyState;

/// Reports that all stages are ready.
pub(crate) fn ready() {
    tell(NotifyState::Ready);
}

/// Reports that the run is ending.
pub(crate) fn stopping() {
    tell(NotifyState::Stopping);
}

/// The manager's watchdog, if the manager has set one for this program.
#[derive(Debug)]
pub(crate) struct Watchdog {
    /// Interval of notifications.
    every_ns: Option<u64>,
    told_ns: u64,
}

impl Watchdog {
    /// Reads the watchdog's interval from the environment.
    pub(crate) fn from_environment() -> Self {
        // Twice per interval, as systemd's documentation recommends.
        let every_ns = sd_notify::watchdog_enabled().map(|limit| limit.as_nanos() as u64 / 2);
        Self { every_ns, told_ns: 0 }
    }

    /// Reports a round of the launcher's loop. The call is cheap: it notifies only once per interval.
    pub(crate) fn alive(&mut self) {
        let now_ns = monotonic_now_ns();
        if self.every_ns.is_some_and(|every_ns| now_ns.saturating_sub(self.told_ns) >= every_ns) {
            self.told_ns = now_ns;
            tell(NotifyState::Watchdog);
        }
    }
}

fn tell(state: NotifyState<'_>) {
    // Without a manager this does nothing, and a manager that has ended needs no notification.
    let _ = sd_notify::notify(&[state]);
}
