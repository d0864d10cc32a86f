//! Measures camera to action with all stages: time, cost, and the highest rate without a missed frame.

use crate::OutputArgs;
use crate::graph::{GraphArgs, Measured, Plan, Subject, measure};
use crate::report::{Report, number, table};
use crate::stats::Times;
use std::time::Duration;

/// A setting: number of samples, look-ahead steps, frames per second.
const SAMPLES: [u32; 3] = [1, 10, 35];
const HORIZONS: [u32; 3] = [1, 2, 3];
const RATES_HZ: [f64; 3] = [10.0, 20.0, 30.0];
/// Setting whose figures represent the loop.
const MAIN: Setting = Setting { samples: 10, horizon: 2, rate_hz: 10.0 };
/// Upper limit of the search for the highest rate. The search also ends when the rate is known to a twentieth.
const HIGHEST_HZ: f64 = 640.0;
const SEARCH_PRECISION: f64 = 1.05;

/// Measure the time from camera to action with all stages.
#[derive(Clone, Debug, clap::Args)]
pub struct LoopArgs {
    #[command(flatten)]
    subject: GraphArgs,
    /// Time for each setting, seconds; six times as long for the main one (n = 10, horizon 2, 10 Hz).
    #[arg(long, default_value_t = 10.0)]
    seconds: f64,
    /// Measure only the main setting and the highest rate, a few seconds each.
    #[arg(long)]
    quick: bool,
    #[command(flatten)]
    pub(crate) output: OutputArgs,
}

#[derive(Clone, Copy, Debug, PartialEq)]
struct Setting {
    samples: u32,
    horizon: u32,
    rate_hz: f64,
}

struct Bench {
    subject: Subject,
    warm_up: Duration,
}

impl Bench {
    fn measure(&self, setting: Setting, seconds: f64) -> anyhow::Result<Measured> {
        let mut graph = self.subject.graph.clone();
        graph.run.samples = setting.samples;
        graph.run.horizon = setting.horizon;
        graph.run.frame_rate_hz = setting.rate_hz;
        graph.camera.repeat = true;
        measure(&Plan {
            graph,
            dataset: &self.subject.dataset,
            checkpoint: &self.subject.checkpoint,
            warm_up: self.warm_up,
            measured: Duration::from_secs_f64(seconds.clamp(0.5, 3600.0)),
            probes: 0,
        })
    }
}

pub(crate) fn run(args: &LoopArgs) -> anyhow::Result<Report> {
    let warm_up = Duration::from_secs_f64(if args.quick { 1.0 } else { 2.0 });
    let bench = Bench { subject: args.subject.load()?, warm_up };
    bench.subject.check_dataset()?;
    let seconds = if args.quick { 5.0 } else { args.seconds };
    let mut report = Report::default();
    let heading =
        ["samples, horizon, rate", "p50 ms", "p99", "p99.9", "max", "missed", "between stages", "cores in use"];
    let mut rows = vec![heading.map(str::to_owned)];

    let measured = bench.measure(MAIN, if args.quick { seconds } else { 6.0 * seconds })?;
    rows.push(row(MAIN, &measured, "loop", &mut report));
    report.set("loop.rate_hz", measured.rate_hz);
    let mut uses = vec![["stage (main setting)", "cores in use", "memory (MB)"].map(str::to_owned)];
    for used in &measured.uses {
        let memory_mb = used.resident_bytes / 1e6;
        uses.push([used.stage.to_string(), number(used.cores), number(memory_mb)]);
        report.set(&format!("loop.stages.{}.cores", used.stage), used.cores);
        report.set(&format!("loop.stages.{}.memory_mb", used.stage), memory_mb);
    }
    let mut hand_overs = vec![["between stages (main setting)", "p50 us", "p99"].map(str::to_owned)];
    for (name, ms) in &measured.hand_overs_ms {
        let times = Times::new(ms.clone());
        let [p50, p99] = [0.5, 0.99].map(|q| times.quantile(q) * 1e3);
        hand_overs.push([(*name).to_owned(), number(p50), number(p99)]);
        report.set(&format!("loop.hand_overs.{}.p50_us", name.replace(' ', "_")), p50);
        report.set(&format!("loop.hand_overs.{}.p99_us", name.replace(' ', "_")), p99);
    }
    if !args.quick {
        for samples in SAMPLES {
            for horizon in HORIZONS {
                for rate_hz in RATES_HZ {
                    let setting = Setting { samples, horizon, rate_hz };
                    let measured = bench.measure(setting, seconds)?;
                    let key = format!("loop.settings.n{samples}_h{horizon}_{rate_hz}hz");
                    rows.push(row(setting, &measured, &key, &mut report));
                }
            }
        }
    }
    let held = highest_rate(|rate_hz| {
        let measured = bench.measure(Setting { rate_hz, ..MAIN }, if args.quick { 2.0 } else { seconds })?;
        let held = measured.held(rate_hz);
        println!(
            "{} Hz: {} frames, {} missed{}",
            number(rate_hz),
            measured.frames,
            measured.missed,
            if held { "" } else { ": not held" }
        );
        Ok(held.then_some(measured))
    })?;
    if let Some((rate_hz, measured)) = &held {
        rows.push(row(Setting { rate_hz: *rate_hz, ..MAIN }, measured, "loop.at_held_rate", &mut report));
    }
    println!("\n{}\n{}\n{}", table(&rows), table(&hand_overs), table(&uses));
    println!("renderer: {} views while the main setting was measured", measured.views);
    let rate_hz = held.map_or(0.0, |(rate_hz, _)| rate_hz);
    println!("highest rate held without a missed frame: {} Hz", number(rate_hz));
    report.set("loop.held_hz", rate_hz);
    Ok(report)
}

fn row(setting: Setting, measured: &Measured, key: &str, report: &mut Report) -> [String; 8] {
    let times = Times::new(measured.latency_ms.clone());
    let [p50, p99, p999, max] = [0.5, 0.99, 0.999, 1.0].map(|q| times.quantile(q));
    let cores: f64 = measured.uses.iter().map(|u| u.cores).sum();
    for (name, value) in [
        ("p50_ms", p50),
        ("p99_ms", p99),
        ("p999_ms", p999),
        ("max_ms", max),
        ("ipc_share", measured.ipc_share),
        ("frames", measured.frames as f64),
        ("missed", measured.missed as f64),
        ("cores", cores),
    ] {
        report.set(&format!("{key}.{name}"), value);
    }
    [
        format!("n {}, h {}, {} Hz", setting.samples, setting.horizon, number(setting.rate_hz)),
        number(p50),
        number(p99),
        number(p999),
        number(max),
        format!("{} of {}", measured.missed, measured.frames),
        format!("{:.2} %", measured.ipc_share * 100.0),
        number(cores),
    ]
}

/// Searches the highest rate for which `held` returns a value, and returns both: it doubles, then halves the interval.
fn highest_rate<T>(mut held: impl FnMut(f64) -> anyhow::Result<Option<T>>) -> anyhow::Result<Option<(f64, T)>> {
    let mut best = None;
    let mut rate_hz = MAIN.rate_hz;
    let mut too_high = HIGHEST_HZ * 2.0;
    while rate_hz <= HIGHEST_HZ {
        let Some(result) = held(rate_hz)? else {
            too_high = rate_hz;
            break;
        };
        best = Some((rate_hz, result));
        rate_hz *= 2.0;
    }
    if too_high > HIGHEST_HZ {
        return Ok(best);
    }
    let mut low = best.as_ref().map_or(1.0, |(rate, _)| *rate);
    while too_high / low > SEARCH_PRECISION {
        let middle = (low * too_high).sqrt();
        match held(middle)? {
            Some(result) => {
                best = Some((middle, result));
                low = middle;
            }
            None => too_high = middle,
        }
    }
    Ok(best)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The search ends within a twentieth below the limit, also if the first trial fails, and at its upper limit.
    #[test]
    fn the_highest_rate_is_found() {
        for limit in [1.5, 7.0, 10.0, 33.3, 250.0] {
            let (rate, got) = highest_rate(|rate| Ok((rate <= limit).then_some(rate))).unwrap().unwrap();
            assert!(rate <= limit && rate * SEARCH_PRECISION >= limit, "{limit}: {rate}");
            assert_eq!(rate, got);
        }
        assert_eq!(highest_rate(|rate| Ok(Some(rate))).unwrap().unwrap().0, HIGHEST_HZ);
        assert!(highest_rate(|_| Ok(None::<()>)).unwrap().is_none());
    }
}
