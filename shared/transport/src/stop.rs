//! Ends the process in order: a stop that a signal triggers, and the rule for the times when nothing waits for one.

use rustix::event::{PollFd, PollFlags, poll};
use rustix::io::retry_on_intr;
use signal_hook::SigId;
use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};
use signal_hook::{flag, low_level};
use std::io::Write;
use std::os::fd::AsFd;
use std::os::unix::net::UnixStream;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, LazyLock, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

/// Exit code after a signal, as in shells after Ctrl-C: 128 plus the signal's number.
pub const INTERRUPTED: u8 = 130;

/// True while no [`Stop`] of a signal exists: a signal then ends a process of [`exit_on_signals`] at once.
static AT_ONCE: LazyLock<Arc<AtomicBool>> = LazyLock::new(|| Arc::new(AtomicBool::new(true)));
/// Number of stops that signals trigger. [`AT_ONCE`] is only changed under this lock.
static STOPS: Mutex<usize> = Mutex::new(0);
/// True after the first signal that a stop has taken.
static INTERRUPT: LazyLock<Arc<AtomicBool>> = LazyLock::new(Arc::default);

/// Lets SIGINT, SIGTERM and SIGHUP end the process at once with [`INTERRUPTED`] in any phase in which no
/// [`Stop::on_signals`] exists. No destructor runs, so a computation in another thread does no harm.
pub fn exit_on_signals() -> std::io::Result<()> {
    for signal in stop_signals() {
        flag::register_conditional_shutdown(signal, i32::from(INTERRUPTED), Arc::clone(&AT_ONCE))?;
    }
    Ok(())
}

/// Returns true if a signal has triggered a stop of this process.
pub fn is_interrupted() -> bool {
    INTERRUPT.load(Ordering::Acquire)
}

/// A stop signal for the process. Clones share one state.
///
/// ```
/// use carff_transport::{Stop, Waiter, Woken, monotonic_now_ns};
/// let stop = Stop::new()?;
/// let waiter = Waiter::new(stop.clone());
/// assert_eq!(waiter.wait_until(&[], monotonic_now_ns())?, Woken::Timeout);
/// stop.stop();
/// assert_eq!(waiter.wait_until(&[], u64::MAX)?, Woken::Stopped);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Clone, Debug)]
pub struct Stop {
    flag: Arc<AtomicBool>,
    read: Arc<UnixStream>,
    write: Arc<UnixStream>,
    _signals: Option<Arc<Signals>>,
}

impl Stop {
    /// Creates a stop that only [`Stop::stop`] triggers.
    pub fn new() -> std::io::Result<Self> {
        let (read, write) = UnixStream::pair()?;
        write.set_nonblocking(true)?;
        Ok(Self { flag: Arc::default(), read: Arc::new(read), write: Arc::new(write), _signals: None })
    }

    /// Creates a stop that SIGINT, SIGTERM and SIGHUP also trigger, in any thread. An ignored SIGHUP (`nohup`) stays
    /// ignored. Dropping the last clone gives the signals back.
    pub fn on_signals() -> std::io::Result<Self> {
        let stop = Self::new()?;
        let signals = Signals::of(&stop)?;
        Ok(Self { _signals: Some(Arc::new(signals)), ..stop })
    }

    /// Ends all current and later waits.
    pub fn stop(&self) {
        self.flag.store(true, Ordering::Release);
        // It only fails if the socket is full: then it is already readable, which suffices.
        let _ = (&*self.write).write(&[0]);
    }

    /// Returns true if the stop has been triggered.
    pub fn is_stopped(&self) -> bool {
        self.flag.load(Ordering::Acquire)
    }

    /// Returns the flag that the stop sets.
    pub fn flag(&self) -> &AtomicBool {
        &self.flag
    }

    /// Ends the process with [`INTERRUPTED`] if it still runs `grace` after the stop: for work that looks at the stop
    /// seldom. `last` runs first.
    pub fn exit_after(&self, grace: Duration, last: impl FnOnce() + Send + 'static) -> std::io::Result<()> {
        let stop = self.clone();
        let watch = move || {
            if retry_on_intr(|| poll(&mut [stop.descriptor()], None)).is_ok() {
                std::thread::sleep(grace);
                last();
                low_level::exit(i32::from(INTERRUPTED));
            }
        };
        std::thread::Builder::new().name("stop".into()).spawn(watch).map(drop)
    }

    /// Returns the descriptor that is readable after the stop.
    pub(crate) fn descriptor(&self) -> PollFd<'_> {
        PollFd::from_borrowed_fd(self.read.as_fd(), PollFlags::IN)
    }
}

/// Handlers of a stop. Dropping removes them.
#[derive(Debug)]
struct Signals(Vec<SigId>);

impl Signals {
    fn of(stop: &Stop) -> std::io::Result<Self> {
        // From here on, `drop` balances the count.
        *stops() += 1;
        let mut signals = Self(Vec::new());
        for signal in stop_signals() {
            signals.0.push(flag::register(signal, Arc::clone(&INTERRUPT))?);
            signals.0.push(flag::register(signal, Arc::clone(&stop.flag))?);
            signals.0.push(low_level::pipe::register(signal, stop.write.try_clone()?)?);
        }
        // Only now, so that no signal is lost: one that comes before this ends the process at once.
        let _held = stops();
        AT_ONCE.store(false, Ordering::Release);
        Ok(signals)
    }
}

impl Drop for Signals {
    fn drop(&mut self) {
        let mut stops = stops();
        *stops -= 1;
        // First, for the same reason.
        if *stops == 0 {
            AT_ONCE.store(true, Ordering::Release);
        }
        drop(stops);
        for id in self.0.drain(..) {
            low_level::unregister(id);
        }
    }
}

fn stops() -> MutexGuard<'static, usize> {
    STOPS.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Returns the signals that end a process: without SIGHUP if its caller has it ignored.
fn stop_signals() -> Vec<i32> {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let ignored = status.lines().find_map(|line| u64::from_str_radix(line.strip_prefix("SigIgn:")?.trim(), 16).ok());
    let is_ignored = |signal: i32| ignored.unwrap_or(0) & (1 << (signal - 1)) != 0;
    [SIGINT, SIGTERM, SIGHUP].into_iter().filter(|&signal| signal != SIGHUP || !is_ignored(signal)).collect()
}
