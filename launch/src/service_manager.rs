//! Words to the service manager (systemd's `sd_notify`), where one started this program: ready, alive, stopping. What it
//! does not hear is its own to judge: nothing here is an error.

use carff_transport::monotonic_now_ns;
use sd_notify::NotifyState;

/// All stages are ready.
pub(crate) fn ready() {
    tell(NotifyState::Ready);
}

/// The run is coming to its end.
pub(crate) fn stopping() {
    tell(NotifyState::Stopping);
}

/// The manager's watchdog, if it has set one on this program.
#[derive(Debug)]
pub(crate) struct Watchdog {
    /// How often it is told.
    every_ns: Option<u64>,
    told_ns: u64,
}

impl Watchdog {
    /// Looks at what the manager has put into the environment.
    pub(crate) fn from_environment() -> Self {
        // Twice in its time, as its documentation asks.
        let every_ns = sd_notify::watchdog_enabled().map(|limit| limit.as_nanos() as u64 / 2);
        Self { every_ns, told_ns: 0 }
    }

    /// The launcher's loop has gone round. Cheap: it is passed on no more often than is asked for.
    pub(crate) fn alive(&mut self) {
        let now_ns = monotonic_now_ns();
        if self.every_ns.is_some_and(|every_ns| now_ns.saturating_sub(self.told_ns) >= every_ns) {
            self.told_ns = now_ns;
            tell(NotifyState::Watchdog);
        }
    }
}

fn tell(state: NotifyState<'_>) {
    // Without a manager this does nothing; one that is gone needs no word.
    let _ = sd_notify::notify(&[state]);
}
