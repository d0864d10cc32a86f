//! What the injectors share: frames that the camera has sent, and their own end.

use anyhow::ensure;
use carff_messages::FrameMeta;
use carff_transport::{ImagePayload, Receiver, Waiter, Woken, monotonic_now_ns};
use std::time::Duration;

/// Longest sleep between two checks, nanoseconds.
pub(super) const LOOK_NS: u64 = 100_000_000;
/// Number of checks for frames before it gives up. It counts checks, because the process may get no processor time.
const LOOKS: usize = 300;
/// Time for which an injector outlives its last message: readers map its memory at their first read.
pub(super) const LINGER: Duration = Duration::from_millis(300);

/// Returns the next frames of the camera, in order: about three.
pub(super) fn seen(
    input: &mut Receiver<ImagePayload<FrameMeta>>,
    waiter: &Waiter,
) -> anyhow::Result<Vec<(FrameMeta, Vec<u8>)>> {
    let mut seen = Vec::new();
    for _ in 0..LOOKS {
        if seen.len() >= 3 || waiter.wait_until(&[input], monotonic_now_ns() + LOOK_NS)? == Woken::Stopped {
            break;
        }
        while let Some(frame) = input.next()? {
            seen.push((*frame, frame.bytes().to_vec()));
        }
    }
    ensure!(!seen.is_empty(), "no frame of the camera arrived in time: check with `carff probe top` that it publishes");
    Ok(seen)
}
