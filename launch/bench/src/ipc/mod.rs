//! From one process to another: this program's topics, bare iceoryx2, Unix sockets, zenoh.
//!
//! A payload is written by one process and read by another. The time is from before the sender asks for memory to after
//! the receiver has read the last byte, on the one monotonic clock. The receiver acknowledges by a pipe, the same for
//! all, which is not part of the time; then the next payload goes out. zenoh's two processes are those of a program of
//! its own; while they work, this one sleeps.

mod bare;
mod driver;
mod peer;
mod typed;
mod unix;
mod zenoh;

use crate::OutputArgs;
use crate::report::{Report, number, table};
use crate::stats::{Ratio, Times};
use driver::Driver;
pub(crate) use peer::peer;
use std::path::{Path, PathBuf};
use zenoh::ZenohPair;

/// Payloads, bytes: in powers of two, brought to whole pixels.
const SIZES: [usize; 5] = [64, 1 << 10, 1 << 14, 1 << 18, 1 << 22];
/// Turns that each transport takes at each size.
const TURNS: usize = 10;

/// From one process to another: this program's topics, bare iceoryx2, Unix sockets, zenoh.
#[derive(Clone, Debug, clap::Args)]
pub struct IpcArgs {
    /// Payloads for each transport, size and way of waiting; a tenth of them at 256 KiB and more.
    #[arg(long, default_value_t = 10_000)]
    messages: usize,
    /// Pause between two payloads, microseconds: with a pause, cores go to sleep and must be woken.
    #[arg(long, default_value_t = 0)]
    pause_us: u64,
    /// A tenth of the payloads.
    #[arg(long)]
    quick: bool,
    /// The program with zenoh's two ends, which `make bench-peer` builds; when not given, `carff-zenoh-peer` beside
    /// this program, and no zenoh if it is not there.
    #[arg(long)]
    zenoh: Option<PathBuf>,
    #[command(flatten)]
    pub(crate) output: OutputArgs,
}

/// The other process of `ipc`.
#[derive(Clone, Debug, clap::Args)]
pub struct PeerArgs {
    /// By what payloads come.
    transport: Transport,
    /// Folder that both processes know.
    folder: PathBuf,
}

/// By what payloads go.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub(crate) enum Transport {
    /// This program's typed topics.
    Typed,
    /// iceoryx2 with nothing around it.
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

    /// Opens the sender's end; the receiver's is open already.
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

/// How the receiver waits.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Waiting {
    /// It sleeps and is woken.
    Sleeping,
    /// It spins.
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

/// The size of a payload as a picture, so that a picture topic takes it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Size {
    width_px: u32,
    height_px: u32,
}

impl Size {
    /// As near to so many bytes as whole pixels allow; of sizes that are equally near, the one closest to a square.
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

/// Two processes and a way from one to the other.
trait Pair {
    /// In keys of figures.
    fn name(&self) -> &'static str;

    /// In tables.
    fn title(&self) -> &'static str;

    /// Opens both ends anew, for payloads of this size.
    fn open(&mut self, size: Size) -> anyhow::Result<()>;

    /// Sends so many payloads, each once the one before is acknowledged. Returns the times, microseconds.
    fn run(&mut self, count: usize, waiting: Waiting, pause_us: u64) -> anyhow::Result<Vec<f64>>;
}

/// The sender's end.
pub(crate) trait Sender {
    /// Writes the payload and sends it, waking a receiver that sleeps.
    fn send(&mut self, payload: &[u8], waiting: Waiting) -> anyhow::Result<()>;
}

/// The receiver's end.
pub(crate) trait Receiver {
    /// Gets ready to wait in this way, before anything is sent.
    fn prepare(&mut self, _waiting: Waiting) -> anyhow::Result<()> {
        Ok(())
    }

    /// Waits for a payload and hands it out where it lies.
    fn receive(&mut self, waiting: Waiting, read: &mut dyn FnMut(&[u8])) -> anyhow::Result<()>;
}

/// What a receiver measured, in nanoseconds, eight bytes each, the lowest first: in microseconds.
fn times_us(bytes: &[u8]) -> Vec<f64> {
    bytes.as_chunks().0.iter().map(|ns| u64::from_le_bytes(*ns) as f64 / 1e3).collect()
}

pub(crate) fn run(args: &IpcArgs) -> anyhow::Result<Report> {
    let zenoh = zenoh::program(args.zenoh.as_deref())?;
    let folder = tempfile::tempdir()?;
    let mut pairs: Vec<Box<dyn Pair>> = Vec::new();
    for transport in Transport::ALL {
        pairs.push(Box::new(Driver::start(transport, folder.path())?));
    }
    if let Some(program) = zenoh {
        pairs.push(Box::new(ZenohPair::start(&program, folder.path())?));
    }
    let labels: Vec<_> = pairs.iter().map(|pair| (pair.name(), pair.title())).collect();
    let mut report = Report::default();
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
    drop(pairs);
    typed::clean_up(folder.path())?;
    bare::clean_up(folder.path())?;

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
    Ok(report)
}

/// What was measured at one size and way of waiting: times in microseconds, by transport and turn.
struct Cell {
    size: Size,
    waiting: Waiting,
    turns: Vec<Vec<Vec<f64>>>,
}

impl Cell {
    fn times(&self, transport: usize) -> Times {
        Times::new(self.turns[transport].concat())
    }

    /// Against bare iceoryx2: by the medians of the turns.
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

    /// Times come as whole nanoseconds, eight bytes each, and are told in microseconds.
    #[test]
    fn times_are_in_microseconds() {
        let bytes: Vec<u8> = [1_500_u64, 0, 1 << 40].iter().flat_map(|ns| ns.to_le_bytes()).collect();
        assert_eq!(times_us(&bytes), [1.5, 0.0, 1_099_511_627.776]);
    }

    /// Payloads are near to what was asked for, and no picture is wider or higher than topics allow.
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
