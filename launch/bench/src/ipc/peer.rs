//! The receiving process: takes commands from standard input, and answers on standard output.

use super::{PeerArgs, Receiver, Size, Waiting};
use anyhow::{Context, bail};
use carff_transport::monotonic_now_ns;
use rustix::process::{Signal, set_parent_process_death_signal};
use std::io::{BufRead, Write};

/// Runs until standard input ends.
pub(crate) fn peer(args: &PeerArgs) -> anyhow::Result<()> {
    set_parent_process_death_signal(Some(Signal::KILL)).context("cannot watch the parent process")?;
    let mut receiver: Option<Box<dyn Receiver>> = None;
    let mut answers = std::io::stdout().lock();
    let mut ready = |byte: &[u8]| -> anyhow::Result<()> {
        answers.write_all(byte)?;
        Ok(answers.flush()?)
    };
    for line in std::io::stdin().lock().lines() {
        let line = line?;
        let words: Vec<&str> = line.split_whitespace().collect();
        match words[..] {
            ["open", width, height] => {
                drop(receiver.take());
                let size = Size { width_px: width.parse()?, height_px: height.parse()? };
                receiver = Some(args.transport.receiver(&args.folder, size)?);
                ready(b".")?;
            }
            ["run", count, waiting] => {
                let count: usize = count.parse()?;
                let waiting = if waiting == Waiting::Busy.name() { Waiting::Busy } else { Waiting::Sleeping };
                let receiver = receiver.as_mut().context("no receiver is open")?;
                let mut times = Vec::with_capacity(count * size_of::<u64>());
                receiver.prepare(waiting)?;
                ready(b".")?;
                for _ in 0..count {
                    let mut sent_ns = 0;
                    receiver.receive(waiting, &mut |payload| sent_ns = read(payload))?;
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

/// Reads the whole payload, and returns the time in its first bytes.
fn read(payload: &[u8]) -> u64 {
    let words = payload.as_chunks().0.iter().map(|word| u64::from_le_bytes(*word));
    std::hint::black_box(words.clone().fold(0, u64::wrapping_add));
    words.clone().next().unwrap_or_default()
}
