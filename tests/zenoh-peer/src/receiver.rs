//! The receiving process: takes commands from standard input, and answers on standard output.

use crate::{End, Waiting, key, monotonic_now_ns, session};
use anyhow::{Context, bail, ensure};
use std::io::{BufRead, Write};
use std::path::Path;
use zenoh::Wait;
use zenoh::handlers::{FifoChannel, FifoChannelHandler};
use zenoh::pubsub::Subscriber;
use zenoh::sample::Sample;

type Samples = Subscriber<FifoChannelHandler<Sample>>;

/// Runs until standard input ends.
pub(crate) fn run(folder: &Path) -> anyhow::Result<()> {
    let session = session(folder, End::Receiver)?;
    let mut opened: Option<(Samples, usize)> = None;
    let mut answers = std::io::stdout().lock();
    let mut ready = |bytes: &[u8]| -> anyhow::Result<()> {
        answers.write_all(bytes)?;
        Ok(answers.flush()?)
    };
    ready(b".")?;
    for line in std::io::stdin().lock().lines() {
        let line = line?;
        let words: Vec<&str> = line.split_whitespace().collect();
        match words[..] {
            ["open", bytes] => {
                drop(opened.take());
                let bytes = bytes.parse()?;
                let samples = session
                    .declare_subscriber(key(bytes))
                    .with(FifoChannel::new(4))
                    .wait()
                    .map_err(anyhow::Error::from_boxed)
                    .context("no zenoh subscriber")?;
                opened = Some((samples, bytes));
                ready(b".")?;
            }
            ["run", count, waiting] => {
                let count: usize = count.parse()?;
                let waiting = Waiting::parse(waiting)?;
                let (samples, bytes) = opened.as_ref().context("no receiver is open")?;
                let mut times = Vec::with_capacity(count * size_of::<u64>());
                ready(b".")?;
                for _ in 0..count {
                    let sent_ns = {
                        let sample = receive(samples, waiting)?;
                        let payload = sample.payload().as_shm();
                        let payload = payload.context("a payload did not come by zenoh's shared memory")?;
                        ensure!(payload.len() == *bytes, "a payload has {} bytes, not {bytes}", payload.len());
                        read(payload)
                    };
                    times.extend_from_slice(&monotonic_now_ns().saturating_sub(sent_ns).to_le_bytes());
                    ready(b".")?;
                }
                ready(&times)?;
            }
            ["end"] => break,
            _ => bail!("no such command: {line}"),
        }
    }
    Ok(())
}

fn receive(samples: &Samples, waiting: Waiting) -> anyhow::Result<Sample> {
    match waiting {
        Waiting::Sleeping => samples.recv().map_err(anyhow::Error::from_boxed),
        Waiting::Busy => loop {
            if let Some(sample) = samples.try_recv().map_err(anyhow::Error::from_boxed)? {
                return Ok(sample);
            }
            std::thread::yield_now();
        },
    }
}

/// Reads the whole payload in the same way as the other transports, and returns the time in its first bytes.
fn read(payload: &[u8]) -> u64 {
    let words = payload.as_chunks().0.iter().map(|word| u64::from_le_bytes(*word));
    std::hint::black_box(words.clone().fold(0, u64::wrapping_add));
    words.clone().next().unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The time is in the first eight bytes, little-endian. A shorter payload has no time.
    #[test]
    fn time_is_in_the_first_bytes() {
        let mut payload = vec![7; 27];
        payload[..8].copy_from_slice(&0x0102_0304_0506_0708_u64.to_le_bytes());
        assert_eq!(read(&payload), 0x0102_0304_0506_0708);
        assert_eq!(read(&payload[..7]), 0);
    }
}
