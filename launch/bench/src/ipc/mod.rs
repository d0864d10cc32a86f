//! Measures payloads from one process to another: this program's topics, bare iceoryx2, Unix sockets, zenoh, dora.
//!
//! One process writes a payload, and another reads it. The time starts before the sender requests memory. It ends after
//! the receiver has read the last byte, on the same monotonic clock. The receiver then acknowledges through a pipe,
//! which is not part of the time, and the next payload follows. zenoh's and dora's two processes belong to separate programs,
//! during whose work this process sleeps.

mod bare;
mod driver;
mod peer;
mod program;
mod typed;
mod unix;

use crate::OutputArgs;
use crate::report::{Report, number, table};
use crate::stats::{Ratio, Times};
use anyhow::ensure;
use carff_transport::Stop;
use driver::Driver;
pub(crate) use peer::peer;
use program::ProgramPair;
use std::path::{Path, PathBuf};

/// Sizes of the payloads, bytes: powers of two, rounded to whole pixels.
const SIZES: [usize; 5] = [64, 1 << 10, 1 << 14, 1 << 18, 1 << 22];
/// Number of turns of each transport at each size.
const TURNS: usize = 10;

/// Measure payloads between processes: this program's topics, bare iceoryx2, Unix sockets, zenoh, dora.
#[derive(Clone, Debug, clap::Args)]
pub struct IpcArgs {
    /// Number of payloads for each transport, size and way of waiting; a tenth of it from 256 KiB on.
    #[arg(long, default_value_t = 10_000)]
    messages: usize,
    /// Pause between two payloads, microseconds. In a pause, cores sleep and must be woken.
    #[arg(long, default_value_t = 0)]
    pause_us: u64,
    /// Send a tenth of the payloads.
    #[arg(long)]
    quick: bool,
    /// Program with zenoh's two ends, built by `make bench-peer`. Default: `carff-zenoh-peer` in this program's folder.
    /// If the default does not exist, zenoh is left out.
    #[arg(long)]
    zenoh: Option<PathBuf>,
    /// Python with the packages dora-rs, dora-rs-cli and pyarrow, and the script with dora's two ends
    /// (tests/dora-peer/carff_dora_peer.py). Without them, dora is left out.
    #[arg(long, num_args = 2, value_names = ["PYTHON", "SCRIPT"])]
    dora: Vec<PathBuf>,
    #[command(flatten)]
    pub(crate) output: OutputArgs,
}

/// Runs the receiving process of `ipc`.
#[derive(Clone, Debug, clap::Args)]
pub struct PeerArgs {
    /// Transport of the payloads.
    transport: Transport,
    /// Folder that both processes use.
    folder: PathBuf,
}

/// Transport of the payloads.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub(crate) enum Transport {
    /// This program's typed topics.
    Typed,
    /// iceoryx2 without a wrapper.
    Bare,
    /// A Unix stream socket.
    Unix,
}

impl Transport {
    const ALL: [Self; 3] = [Self::Typed, Self::Bare, Self::Unix];

    fn name(self) -> &'static str {
        match self {
            Self::Typed => "typed",
            Self::Bare => "bare",
            Self::Unix => "unix",
        }
    }

    fn title(self) -> &'static str {
        match self {
            Self::Typed => "typed topics",
            Self::Bare => "bare iceoryx2",
            Self::Unix => "Unix sockets",
        }
    }

    /// Opens the sender's end after the receiver's.
    fn sender(self, folder: &Path, size: Size) -> anyhow::Result<Box<dyn Sender>> {
        Ok(match self {
            Self::Typed => Box::new(typed::TypedSender::open(folder, size)?),
            Self::Bare => Box::new(bare::BareSender::open(folder, size)?),
            Self::Unix => Box::new(unix::UnixSender::open(folder)?),
        })
    }

    fn receiver(self, folder: &Path, size: Size) -> anyhow::Result<Box<dyn Receiver>> {
        Ok(match self {
            Self::Typed => Box::new(typed::TypedReceiver::open(folder)?),
            Self::Bare => Box::new(bare::BareReceiver::open(folder)?),
            Self::Unix => Box::new(unix::UnixReceiver::open(folder, size)?),
        })
    }
}

/// Way in which the receiver waits.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Waiting {
    /// Sleeps until it is woken.
    Sleeping,
    /// Polls in a loop.
    Busy,
}

impl Waiting {
    const ALL: [Self; 2] = [Self::Sleeping, Self::Busy];

    fn name(self) -> &'static str {
        match self {
            Self::Sleeping => "sleeping",
            Self::Busy => "busy",
        }
    }
}

/// Size of a payload as an image, so that an image topic accepts it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Size {
    width_px: u32,
    height_px: u32,
}

impl Size {
    /// Returns the size that is nearest to a number of bytes; of equally near sizes, the one closest to a square.
    fn near(bytes: usize) -> Self {
        let pixels = bytes as f64 / 3.0;
        let square = pixels.sqrt().floor().max(1.0) as u32;
        let of_height = |height_px: u32| Self { width_px: (pixels / f64::from(height_px)).round() as u32, height_px };
        let off = |size: &Self| (size.bytes() as f64 / 3.0 - pixels).abs();
        (square.div_ceil(2)..square)
            .rev()
            .map(of_height)
            .fold(of_height(square), |best, size| if off(&size) < off(&best) { size } else { best })
    }

    fn bytes(self) -> usize {
        self.width_px as usize * self.height_px as usize * 3
    }
}

/// Two processes and the transport between them.
trait Pair {
    /// Returns the name in keys of figures.
    fn name(&self) -> &'static str;

    /// Returns the name in tables.
    fn title(&self) -> &'static str;

    /// Reopens both ends for payloads of this size.
    fn open(&mut self, size: Size) -> anyhow::Result<()>;

    /// Sends `count` payloads, each after the acknowledgement of the previous one. Returns the times, microseconds.
    fn run(&mut self, count: usize, waiting: Waiting, pause_us: u64) -> anyhow::Result<Vec<f64>>;
}

/// The sender's end.
pub(crate) trait Sender {
    /// Writes and sends a payload, and wakes a sleeping receiver.
    fn send(&mut self, payload: &[u8], waiting: Waiting) -> anyhow::Result<()>;
}

/// The receiver's end.
pub(crate) trait Receiver {
    /// Prepares this way of waiting, before the first payload.
    fn prepare(&mut self, _waiting: Waiting) -> anyhow::Result<()> {
        Ok(())
    }

    /// Waits for a payload, and lends it in place to `read`.
    fn receive(&mut self, waiting: Waiting, read: &mut dyn FnMut(&[u8])) -> anyhow::Result<()>;
}

/// Converts a receiver's times (nanoseconds, u64, little-endian) to microseconds.
fn times_us(bytes: &[u8]) -> Vec<f64> {
    bytes.as_chunks().0.iter().map(|ns| u64::from_le_bytes(*ns) as f64 / 1e3).collect()
}

pub(crate) fn run(args: &IpcArgs) -> anyhow::Result<Report> {
    let zenoh = program::zenoh(args.zenoh.as_deref())?;
    let folder = tempfile::tempdir()?;
    let stop = Stop::on_signals()?;
    let measured = measure(args, zenoh.as_deref(), folder.path(), &stop);
    // All processes have ended, also after an error or a signal.
    typed::clean_up(folder.path())?;
    bare::clean_up(folder.path())?;
    // Ctrl-C in a terminal ends the other processes too, which is then the first error.
    ensure!(!stop.is_stopped(), "interrupted");
    let (labels, cells) = measured?;
    Ok(reported(&labels, &cells))
}

/// Name in keys of figures and name in tables of a transport.
type Label = (&'static str, &'static str);

/// Measures all transports by turns.
fn measure(
    args: &IpcArgs,
    zenoh: Option<&Path>,
    folder: &Path,
    stop: &Stop,
) -> anyhow::Result<(Vec<Label>, Vec<Cell>)> {
    let mut pairs: Vec<Box<dyn Pair>> = Vec::new();
    for transport in Transport::ALL {
        pairs.push(Box::new(Driver::start(transport, folder, stop)?));
    }
    if let Some(program) = zenoh {
        pairs.push(Box::new(ProgramPair::start(program::ZENOH, &[program], folder)?));
    }
    if !args.dora.is_empty() {
        pairs.push(Box::new(ProgramPair::start(program::DORA, &args.dora, folder)?));
    }
    let mut cells = Vec::new();
    for size in SIZES.map(Size::near) {
        let messages = args.messages / if args.quick { 10 } else { 1 } / if size.bytes() > 200_000 { 10 } else { 1 };
        let turn = (messages / TURNS).max(20);
        for pair in &mut pairs {
            pair.open(size)?;
            for waiting in Waiting::ALL {
                pair.run(turn.min(200), waiting, args.pause_us)?;
            }
        }
        for waiting in Waiting::ALL {
            let mut turns = vec![Vec::new(); pairs.len()];
            for round in 0..TURNS {
                for i in 0..pairs.len() {
                    let i = if round % 2 == 0 { i } else { pairs.len() - 1 - i };
                    turns[i].push(pairs[i].run(turn, waiting, args.pause_us)?);
                }
            }
            cells.push(Cell { size, waiting, turns });
        }
    }
    Ok((pairs.iter().map(|pair| (pair.name(), pair.title())).collect(), cells))
}

/// Prints the tables, and returns the figures.
fn reported(labels: &[Label], cells: &[Cell]) -> Report {
    let mut report = Report::default();
    for waiting in Waiting::ALL {
        let mut rows = vec![
            [&format!("{}, write to read (us)", waiting.name()), "by", "p50", "p99", "p99.9", "max", "x bare (p50)"]
                .map(str::to_owned),
        ];
        for cell in cells.iter().filter(|c| c.waiting == waiting) {
            for (i, (name, title)) in labels.iter().copied().enumerate() {
                let times = cell.times(i);
                let [p50, p99, p999, max] = [0.5, 0.99, 0.999, 1.0].map(|q| times.quantile(q));
                let bytes = cell.size.bytes();
                rows.push([
                    if i == 0 { format!("{bytes} bytes") } else { String::new() },
                    title.to_owned(),
                    number(p50),
                    number(p99),
                    number(p999),
                    number(max),
                    cell.ratio_to_bare(i).to_string(),
                ]);
                let key = format!("ipc.{}.{}.{}", waiting.name(), name, bytes);
                for (name, value) in [("p50_us", p50), ("p99_us", p99), ("p999_us", p999), ("max_us", max)] {
                    report.set(&format!("{key}.{name}"), value);
                }
            }
        }
        println!("{}", table(&rows));
    }
    let mean = |waiting: Option<Waiting>| {
        let ratios: Vec<f64> = cells
            .iter()
            .filter(|c| waiting.is_none_or(|w| w == c.waiting))
            .map(|c| c.ratio_to_bare(0).of_medians)
            .collect();
        (ratios.iter().map(|r| r.ln()).sum::<f64>() / ratios.len() as f64).exp()
    };
    let worst = cells.iter().map(|c| c.ratio_to_bare(0).of_medians).fold(0.0, f64::max);
    println!(
        "typed topics take {:.3} times as long as bare iceoryx2 (sleeping {:.3}, busy {:.3}, worst {:.3})",
        mean(None),
        mean(Some(Waiting::Sleeping)),
        mean(Some(Waiting::Busy)),
        worst
    );
    report.set("ipc.vs_bare", mean(None));
    report.set("ipc.vs_bare_sleeping", mean(Some(Waiting::Sleeping)));
    report.set("ipc.vs_bare_busy", mean(Some(Waiting::Busy)));
    report.set("ipc.vs_bare_worst", worst);
    report
}

/// Times at one size and way of waiting, microseconds, by transport and turn.
struct Cell {
    size: Size,
    waiting: Waiting,
    turns: Vec<Vec<Vec<f64>>>,
}

impl Cell {
    fn times(&self, transport: usize) -> Times {
        Times::new(self.turns[transport].concat())
    }

    /// Returns the ratio to bare iceoryx2 by the medians of the turns.
    fn ratio_to_bare(&self, transport: usize) -> Ratio {
        let medians =
            |i: usize| -> Vec<f64> { self.turns[i].iter().map(|turn| Times::new(turn.clone()).median()).collect() };
        let bare = Transport::ALL.iter().position(|t| *t == Transport::Bare).unwrap_or_default();
        Ratio::new(&medians(transport), &medians(bare))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Times arrive as whole nanoseconds of eight bytes, and are reported in microseconds.
    #[test]
    fn times_are_in_microseconds() {
        let bytes: Vec<u8> = [1_500_u64, 0, 1 << 40].iter().flat_map(|ns| ns.to_le_bytes()).collect();
        assert_eq!(times_us(&bytes), [1.5, 0.0, 1_099_511_627.776]);
    }

    /// Payloads are near the requested size, and no image is wider or higher than topics allow.
    #[test]
    fn sizes_are_near() {
        for bytes in SIZES {
            let size = Size::near(bytes);
            let off = (size.bytes() as f64 / bytes as f64 - 1.0).abs();
            assert!(off < 0.05, "{bytes}: {size:?}");
            assert!(size.width_px.max(size.height_px) <= carff_messages::MAX_SIDE_PX);
            assert!(size.bytes() >= size_of::<u64>());
        }
    }
}
