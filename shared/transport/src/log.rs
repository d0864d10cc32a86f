//! Silences the log of iceoryx2.

use iceoryx2::prelude::{LogLevel, set_log_level_from_env_or};
use std::sync::Once;

/// Turns the log of iceoryx2 off: its results report the same errors.
pub(crate) fn quiet() {
    static ONCE: Once = Once::new();
    ONCE.call_once(|| set_log_level_from_env_or(LogLevel::Fatal));
}
