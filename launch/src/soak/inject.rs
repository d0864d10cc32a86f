//! Injectors of a soak, in their own processes: a rogue publisher, a camera with bad images, and probes that come and go.
//! The stages do not know them.

use super::seen::{LINGER, LOOK_NS, seen};
use super::stand_in;
use anyhow::Context;
use carff_base::random::{Key, stream};
use carff_config::FaultKind;
use carff_messages::{Belief, Forecast, FrameMeta, Header, Posterior};
use carff_transport::{ImagePayload, Node, Publisher, Run, Stop, Waiter, Woken, monotonic_now_ns, topics};
use rand::Rng;
use rustix::process::{Signal, set_parent_process_death_signal};
use std::time::Duration;

/// Number of frames in a burst, for each requested frame.
const BURST: u32 = 12;
/// Delay of a late frame.
const LATE: Duration = Duration::from_millis(400);
/// Interval between two rogue messages: long enough that each receiver counts each message.
const BETWEEN: Duration = Duration::from_millis(5);

/// Injects one fault. Prints the number of rogue beliefs that it sent.
#[derive(Clone, Debug, clap::Args)]
pub struct InjectArgs {
    /// The run's name.
    run: String,
    /// The run's id.
    run_id: u64,
    /// Kind of fault: `probe`, or a kind of the soak file.
    what: String,
    /// Number of messages or probes.
    count: u32,
    /// Seed.
    seed: u64,
}

/// Injects the fault.
pub fn run(args: &InjectArgs) -> anyhow::Result<()> {
    set_parent_process_death_signal(Some(Signal::KILL)).context("cannot watch the parent process")?;
    let node = Node::open(&Run::new(&args.run, args.run_id)?, "injector")?;
    let beliefs = match args.what.as_str() {
        "probe" => return probe(&node, args.count),
        "nan" | "garbage" | "schema" | "foreign_run" => rogue(&node, args)?,
        what => {
            let kind = FaultKind::ALL.iter().copied().find(|kind| kind.name() == what);
            match kind.filter(|&kind| stand_in::condition(kind).is_some()) {
                Some(kind) => return stand_in::run(&node, kind, args.seed),
                None => frames(&node, args)?,
            }
            0
        }
    };
    println!("{beliefs}");
    Ok(())
}

/// Subscribes to all topics, reports it, reads a little, and then waits to be stopped or killed.
fn probe(node: &Node, count: u32) -> anyhow::Result<()> {
    let waiter = Waiter::new(Stop::on_signals()?);
    let mut frames = node.receiver(&topics::FRAME)?;
    let mut beliefs = node.receiver(&topics::BELIEF)?;
    let mut actions = node.receiver(&topics::ACTION)?;
    println!("ready");
    for _ in 0..count {
        if waiter.wait_until(&[&frames, &beliefs, &actions], monotonic_now_ns() + LOOK_NS)? == Woken::Stopped {
            return Ok(());
        }
        frames.newest()?;
        beliefs.newest()?;
        actions.newest()?;
    }
    let held = frames.newest()?;
    while waiter.wait_until(&[], u64::MAX)? != Woken::Stopped {}
    drop(held);
    Ok(())
}

/// Publishes messages that no receiver may accept, on every topic of the decision path. Returns the number of beliefs.
fn rogue(node: &Node, args: &InjectArgs) -> anyhow::Result<u32> {
    let mut posteriors = node.publisher(&topics::POSTERIOR)?;
    let mut forecasts = node.publisher(&topics::FORECAST)?;
    let mut beliefs = node.publisher(&topics::BELIEF)?;
    let mut random = stream(Key { seed: args.seed, frame: 0, step: 0, sample: 0 });
    for i in 0..args.count {
        let mut header = Header::of_frame(random.random_range(0..1_000_000), monotonic_now_ns(), 1);
        header.run_id = args.run_id;
        match args.what.as_str() {
            "schema" => header.schema_version = header.schema_version.wrapping_add(1 + i),
            "foreign_run" => header.run_id = header.run_id.wrapping_add(1),
            _ => {}
        }
        let mut posterior =
            Posterior { header, gaussian: carff_messages::Gaussian::standard(), take_start: 0, stage_latency_ns: 0 };
        let mut forecast = Forecast::empty(header.at_step(1), carff_messages::ForecastSource::Observed, 2);
        (forecast.component_count, forecast.sample_count, forecast.weights[0]) = (1, 1, 1.0);
        let mut belief = Belief::empty(header.at_step(2), 2);
        (belief.state_count, belief.place_count, belief.component_count, belief.sample_count) = (6, 1, 1, 1);
        belief.component_weights[0] = 1.0;
        match args.what.as_str() {
            "nan" => {
                posterior.gaussian.mean[i as usize % 8] = f32::NAN;
                forecast.samples[0][i as usize % 8] = f32::NAN;
                [&mut belief.hazard_probability, &mut belief.path_probability, &mut belief.component_weights[0]]
                    [i as usize % 3]
                    .clone_from(&f32::NAN);
            }
            "garbage" => {
                let mut float = || f32::from_bits(random.random());
                posterior.gaussian.mean = std::array::from_fn(|_| float());
                posterior.gaussian.log_variance = std::array::from_fn(|_| float());
                forecast.weights = std::array::from_fn(|_| float());
                forecast.samples[0] = std::array::from_fn(|_| float());
                belief.state_probability = std::array::from_fn(|_| float());
                belief.hazard_probability = float();
                let mut word = || random.random::<u32>();
                belief.samples[0].state = word() as i32;
                (posterior.header.step, forecast.sample_count) = (word() | 16, word() | 128);
                (belief.sample_count, belief.state_count, belief.horizon) = (word() | 128, word(), word());
                belief.header.step = word();
            }
            _ => {}
        }
        posteriors.send_unchecked(posterior)?;
        forecasts.send_unchecked(forecast)?;
        beliefs.send_unchecked(belief)?;
        std::thread::sleep(BETWEEN);
    }
    std::thread::sleep(LINGER);
    Ok(args.count)
}

/// Sends recorded frames again: late, repeated, or out of order.
fn frames(node: &Node, args: &InjectArgs) -> anyhow::Result<()> {
    let mut input = node.receiver(&topics::FRAME)?;
    let seen = seen(&mut input, &Waiter::new(Stop::on_signals()?))?;
    // Frames of other sizes are up to twice as large along each side.
    let most = 4 * seen.iter().map(|(_, bytes)| bytes.len()).max().unwrap_or(0);
    let mut output = node.image_publisher(&topics::FRAME, most)?;
    let newest = seen.len() - 1;
    match args.what.as_str() {
        "late" => {
            std::thread::sleep(LATE);
            send(&mut output, &seen[newest])?;
        }
        "duplicate" => (0..args.count).try_for_each(|_| send(&mut output, &seen[newest]))?,
        "reorder" => seen.iter().rev().try_for_each(|frame| send(&mut output, frame))?,
        "burst" => (0..args.count * BURST).try_for_each(|_| send(&mut output, &seen[newest]))?,
        "resolution" => {
            let sizes = [[4, 4], [1, 2], [3, 1], [1, 1]];
            (0..args.count as usize).try_for_each(|i| send(&mut output, &rescaled(&seen[newest], sizes[i % 4])))?;
        }
        "corrupt" => {
            let mut random = stream(Key { seed: args.seed, frame: 0, step: 1, sample: 0 });
            for i in 0..args.count {
                let (mut meta, mut bytes) = seen[newest].clone();
                meta.header.capture_time_ns = monotonic_now_ns();
                match i % 3 {
                    0 => random.fill(&mut bytes[..]),
                    1 => bytes.truncate(bytes.len() / 2),
                    _ => (meta.width_px, bytes) = (0, vec![0]),
                }
                send(&mut output, &(meta, bytes))?;
            }
        }
        other => anyhow::bail!("`{other}` is not a fault that can be injected"),
    }
    std::thread::sleep(LINGER);
    Ok(())
}

/// Returns a frame captured now, with its sides multiplied by halves of `halves`.
fn rescaled((meta, bytes): &(FrameMeta, Vec<u8>), halves: [u32; 2]) -> (FrameMeta, Vec<u8>) {
    let mut meta = *meta;
    let (width, from) = (meta.width_px, [meta.width_px, meta.height_px]);
    (meta.width_px, meta.height_px) = ((from[0] * halves[0]).div_ceil(2), (from[1] * halves[1]).div_ceil(2));
    meta.header.capture_time_ns = monotonic_now_ns();
    let pixels = (0..meta.height_px).flat_map(|y| (0..meta.width_px).map(move |x| (x, y)));
    let source = |(x, y): (u32, u32)| {
        let at = [(x * 2 / halves[0]).min(from[0] - 1), (y * 2 / halves[1]).min(from[1] - 1)];
        (at[1] * width + at[0]) as usize * 3
    };
    let scaled = pixels.flat_map(|pixel| bytes[source(pixel)..][..3].to_vec()).collect();
    (meta, scaled)
}

fn send(output: &mut Publisher<ImagePayload<FrameMeta>>, (meta, bytes): &(FrameMeta, Vec<u8>)) -> anyhow::Result<()> {
    let mut loan = output.loan(bytes.len())?;
    loan.bytes_mut().copy_from_slice(bytes);
    Ok(output.send_image_unchecked(loan, *meta)?)
}
