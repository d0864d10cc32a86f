//! `carff probe hz`, `bw` and `delay`: measure a topic.

use super::TopicArgs;
use super::structure::columns;
use crate::session::{Session, since_capture_ms};
use crate::terminal::Terminal;
use carff_base::statistics::{mean, percentile_of_sorted};
use carff_transport::monotonic_now_ns;

/// The measured quantity.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Quantity {
    /// Messages per second, and the time between messages.
    Rate,
    /// Bytes per second.
    Bandwidth,
    /// Age on arrival, and time since capture.
    Delay,
}

/// Time between two lines, nanoseconds.
const LINE_NS: u64 = 1_000_000_000;
/// Maximum number of values for the percentiles: an hour at 100 Hz.
const KEPT: usize = 360_000;

/// The measured values of a topic's messages.
#[derive(Clone, Debug, Default)]
struct Series {
    published_ns: Option<u64>,
    /// Times between publications, milliseconds.
    interval_ms: Vec<f64>,
    size_bytes: Vec<f64>,
    age_ms: Vec<f64>,
    since_capture_ms: Vec<f64>,
    messages: u64,
}

impl Series {
    fn add(&mut self, published_ns: u64, size_bytes: usize, age_ms: f64, since_capture_ms: f64) {
        self.messages += 1;
        let before_ns = self.published_ns.replace(published_ns);
        if self.size_bytes.len() >= KEPT {
            return;
        }
        if let Some(before_ns) = before_ns {
            self.interval_ms.push(published_ns.saturating_sub(before_ns) as f64 / 1e6);
        }
        self.size_bytes.push(size_bytes as f64);
        self.age_ms.push(age_ms);
        self.since_capture_ms.push(since_capture_ms);
    }

    /// Returns one line about the values since the last line.
    fn line(&self, quantity: Quantity, from: &Series, seconds: f64) -> String {
        let new = |all: &[f64], old: &[f64]| all[old.len().min(all.len())..].to_vec();
        let messages = self.messages - from.messages;
        match quantity {
            Quantity::Rate => {
                let intervals = new(&self.interval_ms, &from.interval_ms);
                let Some(mean_ms) = mean(&intervals) else { return "no messages".to_owned() };
                let spread = intervals.iter().map(|v| (v - mean_ms).powi(2)).sum::<f64>() / intervals.len() as f64;
                let (min, max) = range(&intervals);
                format!(
                    "{:>8.2} Hz   between messages: mean {mean_ms:.2} ms, jitter {:.2} ms, {min:.2} to {max:.2} ms",
                    1000.0 / mean_ms,
                    spread.sqrt()
                )
            }
            Quantity::Bandwidth => {
                let bytes: f64 = new(&self.size_bytes, &from.size_bytes).iter().sum();
                format!(
                    "{:>12} per second   {:.1} messages per second",
                    in_bytes(bytes / seconds),
                    messages as f64 / seconds
                )
            }
            Quantity::Delay => {
                let ages = new(&self.age_ms, &from.age_ms);
                let captures = new(&self.since_capture_ms, &from.since_capture_ms);
                match (mean(&ages), mean(&captures)) {
                    (Some(age), Some(capture)) => format!(
                        "age on arrival: mean {age:.3} ms, max {:.3} ms   since capture: mean {capture:.2} ms, max {:.2} ms",
                        range(&ages).1,
                        range(&captures).1
                    ),
                    _ => "no messages".to_owned(),
                }
            }
        }
    }

    /// Returns the percentiles of all values.
    fn summary(&self, quantity: Quantity) -> String {
        let rows: Vec<(&str, &[f64])> = match quantity {
            Quantity::Rate => vec![("between messages, ms", &self.interval_ms)],
            Quantity::Bandwidth => vec![("size, bytes", &self.size_bytes)],
            Quantity::Delay => {
                vec![("age on arrival, ms", &self.age_ms), ("since capture, ms", &self.since_capture_ms)]
            }
        };
        let mut table = vec![["", "messages", "p50", "p90", "p99", "max"].map(str::to_owned).to_vec()];
        for (name, values) in rows {
            let mut sorted = values.to_vec();
            sorted.sort_by(f64::total_cmp);
            let cell = |q: f64| percentile_of_sorted(&sorted, q).map_or("-".to_owned(), |v| format!("{v:.3}"));
            table.push(vec![name.to_owned(), sorted.len().to_string(), cell(0.5), cell(0.9), cell(0.99), cell(1.0)]);
        }
        columns(&table)
    }
}

fn range(values: &[f64]) -> (f64, f64) {
    values.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(min, max), &v| (min.min(v), max.max(v)))
}

fn in_bytes(bytes: f64) -> String {
    match bytes {
        b if b >= 1e6 => format!("{:.2} MB", b / 1e6),
        b if b >= 1e3 => format!("{:.2} kB", b / 1e3),
        b => format!("{b:.0} B"),
    }
}

pub(super) fn run(args: &TopicArgs, quantity: Quantity) -> anyhow::Result<()> {
    let mut session = Session::open(&args.session, "probe-measure")?;
    let topic = session.topic(&args.topic)?;
    if quantity == Quantity::Delay {
        session.listen_woken(topic)?;
    } else {
        session.listen([topic])?;
    }
    // Messages from the topic's history have an old age.
    session.take(|_, _| Ok(()))?;
    let terminal = Terminal::new();
    let series = std::cell::RefCell::new(Series::default());
    let (mut last, mut line_ns) = (Series::default(), monotonic_now_ns());
    let going = session.follow(
        |_, message| {
            let (message, now_ns) = (message.message(), monotonic_now_ns());
            let header = message.header();
            let age_ms = now_ns.saturating_sub(header.publish_time_ns) as f64 / 1e6;
            let capture_ms = since_capture_ms(header, now_ns);
            let mut series = series.borrow_mut();
            series.add(header.publish_time_ns, message.size_bytes(), age_ms, capture_ms);
            Ok(args.count.is_none_or(|count| series.messages < count))
        },
        || {
            let now_ns = monotonic_now_ns();
            if now_ns >= line_ns + LINE_NS {
                let series = series.borrow();
                terminal.line(&series.line(quantity, &last, (now_ns - line_ns) as f64 / 1e9));
                (last, line_ns) = (series.clone(), now_ns);
            }
            Ok(())
        },
    )?;
    if series.borrow().messages > last.messages {
        let seconds = monotonic_now_ns().saturating_sub(line_ns).max(1) as f64 / 1e9;
        terminal.line(&series.borrow().line(quantity, &last, seconds));
    }
    print!("{topic} of {}\n{}", session.attached.live.name, series.borrow().summary(quantity));
    session.say_end(going);
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Rate, jitter, bytes per second and ages match the messages: only new ones in a line, all in the summary.
    #[test]
    fn a_series_in_numbers() {
        let mut series = Series::default();
        for i in 0..5 {
            series.add(i * 100_000_000, 1000, 0.5, 20.0);
        }
        let before = series.clone();
        for i in 0..10 {
            series.add(500_000_000 + i * 50_000_000, 2000, 1.5, 40.0);
        }
        let rate = series.line(Quantity::Rate, &before, 1.0);
        assert!(rate.contains("18.18 Hz") && rate.contains("50.00 to 100.00 ms"), "{rate}");
        let bandwidth = series.line(Quantity::Bandwidth, &before, 2.0);
        assert!(bandwidth.contains("10.00 kB per second") && bandwidth.contains("5.0 messages"), "{bandwidth}");
        let delay = series.line(Quantity::Delay, &before, 1.0);
        assert!(delay.contains("max 1.500 ms") && delay.contains("mean 40.00 ms"), "{delay}");
        let summary = series.summary(Quantity::Delay);
        assert!(summary.lines().any(|l| l.starts_with("age on arrival") && l.contains("15")), "{summary}");
        assert_eq!(Series::default().line(Quantity::Rate, &Series::default(), 1.0), "no messages");
    }
}
