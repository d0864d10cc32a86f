//! Measures the growth of cost with samples, horizon, resolution, candidates, stages and probes.
//!
//! Each axis is measured on a running graph, on a library function, or on a chain of processes. The values of an axis
//! are measured alternately. Each axis has a table, a fitted growth, figures and a plot.

mod chain;
mod fit;
mod library;
mod settings;

use crate::OutputArgs;
use crate::graph::GraphArgs;
use crate::report::{Report, number, table};
use crate::stats::Times;
use anyhow::Context;
use carff_plots::{Panel, Series};
pub(crate) use chain::{RelayArgs, relay};
use fit::{Fit, Law};
use settings::GraphBench;
use std::path::{Path, PathBuf};

/// Number of segments of a drawn fit.
const FIT_STEPS: u32 = 60;

/// Measure the growth of cost with samples, horizon, resolution, candidates, stages and probes.
#[derive(Clone, Debug, clap::Args)]
pub struct ScaleArgs {
    #[command(flatten)]
    subject: GraphArgs,
    /// Time for each setting of the graph in two rounds, seconds.
    #[arg(long, default_value_t = 20.0)]
    seconds: f64,
    /// Measure fewer settings, in one round, for a second each.
    #[arg(long)]
    quick: bool,
    /// Axes, separated by commas. Default: all.
    #[arg(long, value_delimiter = ',')]
    axes: Vec<AxisName>,
    /// Folder for the plots, one PNG file per axis.
    #[arg(long, default_value = "reports/scale")]
    plots: PathBuf,
    #[command(flatten)]
    pub(crate) output: OutputArgs,
}

/// Varied quantity.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub(crate) enum AxisName {
    /// Number of latents from each mixture, in a running graph.
    Samples,
    /// Number of look-ahead steps, in a running graph.
    Horizon,
    /// Side of the camera image, in a running graph.
    Image,
    /// Side of a rendered view.
    View,
    /// Number of probed places.
    Candidates,
    /// Number of processes that pass an image on.
    Stages,
    /// Number of additional subscribers to a running graph.
    Probes,
}

impl AxisName {
    const ALL: [Self; 7] =
        [Self::Samples, Self::Horizon, Self::Image, Self::View, Self::Candidates, Self::Stages, Self::Probes];
}

/// Measurements along one axis.
#[derive(Clone, Debug)]
pub(crate) struct Axis {
    /// Name in figures and plots.
    key: &'static str,
    title: &'static str,
    x_label: &'static str,
    /// Unit of x in a formula.
    each: &'static str,
    law: Law,
    /// Key of the second figure in addition to time.
    cost_key: &'static str,
    cost_label: &'static str,
    /// Rows in rising x.
    rows: Vec<Row>,
}

/// One value of an axis.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Row {
    x: u32,
    p50_ms: f64,
    p99_ms: f64,
    max_ms: f64,
    /// Number of times behind the quantiles.
    counted: usize,
    /// Number of frames without a decision; only for a graph.
    missed: Option<usize>,
    cost: f64,
    /// Additional figures by key.
    more: Vec<(&'static str, f64)>,
}

impl Row {
    /// Summarises times in milliseconds.
    fn new(x: u32, times: &Times, cost: f64) -> Self {
        let [p50_ms, p99_ms, max_ms] = [0.5, 0.99, 1.0].map(|q| times.quantile(q));
        Self { x, p50_ms, p99_ms, max_ms, counted: times.count(), missed: None, cost, more: Vec::new() }
    }
}

pub(crate) fn run(args: &ScaleArgs) -> anyhow::Result<Report> {
    let names: Vec<AxisName> =
        AxisName::ALL.into_iter().filter(|name| args.axes.is_empty() || args.axes.contains(name)).collect();
    let subject = args.subject.load()?;
    // Fails before the long part, not after it.
    std::fs::create_dir_all(&args.plots)
        .with_context(|| format!("cannot create the plots' folder {}", args.plots.display()))?;

    let mut axes = Vec::new();
    for name in &names {
        axes.push(match name {
            AxisName::View => library::views(&subject.checkpoint, args.quick)?,
            AxisName::Candidates => library::candidates(&subject.checkpoint, args.quick)?,
            AxisName::Stages => chain::measure(args.quick)?,
            AxisName::Samples | AxisName::Horizon | AxisName::Image | AxisName::Probes => continue,
        });
    }
    let seconds = if args.quick { 1.0 } else { args.seconds.clamp(1.0, 3600.0) };
    let bench = GraphBench { subject, quick: args.quick, seconds };
    axes.extend(bench.measure(&names)?);

    let mut report = Report::default();
    for axis in &axes {
        println!("{}", table(&axis.table()));
        println!("{}\n", axis.growth());
        axis.note(&mut report);
        axis.plot(&args.plots)?;
    }
    println!("plots: {}", args.plots.display());
    Ok(report)
}

impl Axis {
    /// Fits the growth of the median time and of the cost.
    fn fits(&self) -> [Option<Fit>; 2] {
        let points = |y: fn(&Row) -> f64| self.rows.iter().map(|r| (f64::from(r.x), y(r))).collect::<Vec<_>>();
        [points(|r| r.p50_ms), points(|r| r.cost)].map(|points| Fit::new(self.law, &points))
    }

    fn table(&self) -> Vec<[String; 7]> {
        let heading = [self.x_label, "p50 ms", "p99", "max", "measured", self.cost_label, ""];
        let mut rows = vec![heading.map(str::to_owned)];
        rows.extend(self.rows.iter().map(|row| {
            let more: Vec<String> =
                row.more.iter().map(|(key, value)| format!("{} {}", key.replace('_', " "), number(*value))).collect();
            [
                row.x.to_string(),
                number(row.p50_ms),
                number(row.p99_ms),
                number(row.max_ms),
                row.missed.map_or(row.counted.to_string(), |missed| format!("{}, {missed} missed", row.counted)),
                number(row.cost),
                more.join(", "),
            ]
        }));
        rows
    }

    /// Returns the growth as one line of text.
    fn growth(&self) -> String {
        let [time, cost] = self.fits();
        let sentence = |fit: Option<Fit>, unit: &str| {
            fit.map_or("no growth can be fitted".to_owned(), |fit| fit.sentence(unit, self.each))
        };
        let unit = if self.cost_key == "cores" { "cores" } else { "ms" };
        format!("{}: p50 = {}; {} = {}", self.key, sentence(time, "ms"), self.cost_key, sentence(cost, unit))
    }

    fn note(&self, report: &mut Report) {
        for row in &self.rows {
            let mut set = |name: &str, value: f64| report.set(&format!("scale.{}.{}.{name}", self.key, row.x), value);
            set("p50_ms", row.p50_ms);
            set("p99_ms", row.p99_ms);
            set("max_ms", row.max_ms);
            set("count", row.counted as f64);
            set(self.cost_key, row.cost);
            if let Some(missed) = row.missed {
                set("missed", missed as f64);
            }
            for (key, value) in &row.more {
                set(key, *value);
            }
        }
        for (fit, of) in self.fits().into_iter().zip(["p50_ms", self.cost_key]) {
            let Some(fit) = fit else { continue };
            let [base, rate] = match fit.law {
                Law::Linear => ["at_zero", "slope"],
                Law::Area => ["at_zero", "slope_per_px2"],
                Law::Power => ["factor", "exponent"],
            };
            for (name, value) in [(base, fit.base), (rate, fit.rate), ("r_squared", fit.r_squared)] {
                report.set(&format!("scale.{}.fit.{of}.{name}", self.key), value);
            }
        }
    }

    /// Returns evenly spaced x from the first to the last value; on request, evenly spaced in their logarithms.
    fn between(&self, log: bool) -> Vec<f64> {
        let (Some(first), Some(last)) = (self.rows.first(), self.rows.last()) else { return Vec::new() };
        let (first, last) = (f64::from(first.x), f64::from(last.x));
        let at = |share: f64| if log { first * (last / first).powf(share) } else { first + share * (last - first) };
        (0..=FIT_STEPS).map(|i| at(f64::from(i) / f64::from(FIT_STEPS))).collect()
    }

    /// Draws `<key>.png`: times on the left, cost on the right, each with its fit.
    fn plot(&self, folder: &Path) -> anyhow::Result<()> {
        let log = self.law != Law::Linear;
        let series = |name: &str, y: fn(&Row) -> f64| Series {
            name: name.to_owned(),
            points: self.rows.iter().map(|row| (f64::from(row.x), y(row))).collect(),
            ..Series::default()
        };
        let panel = |title: &str, y_label: &str, measured: Vec<Series>, fit: Option<Fit>| {
            let fitted = fit.map(|fit| {
                let name = match fit.law {
                    Law::Linear => "fit: straight line".to_owned(),
                    Law::Area => "fit: straight line over pixels".to_owned(),
                    Law::Power => format!("fit: power {:.2}", fit.rate),
                };
                let points = self.between(log).into_iter().map(|x| (x, fit.at(x))).collect();
                Series { name, points, ..Series::default() }
            });
            Panel {
                title: title.to_owned(),
                x_label: self.x_label.to_owned(),
                y_label: y_label.to_owned(),
                log_x: log,
                log_y: self.law == Law::Power,
                from_zero: true,
                // Measurements are drawn over the fit.
                series: fitted.into_iter().chain(measured).collect(),
            }
        };
        let [time, cost] = self.fits();
        let times = vec![series("p50", |row| row.p50_ms), series("p99", |row| row.p99_ms)];
        let panels = [
            panel("Time", "time (ms)", times, time),
            panel("Processor", self.cost_label, vec![series("measured", |row| row.cost)], cost),
        ];
        carff_plots::curves(&folder.join(format!("{}.png", self.key)), self.title, &panels)?;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn axis() -> Axis {
        let row = |x: u32| {
            let times = (1..=100).map(|i| f64::from(i) / 100.0 + 2.0 * f64::from(x)).collect();
            let mut row = Row::new(x, &Times::new(times), 0.5 + 0.25 * f64::from(x));
            row.missed = Some(3);
            row.more.push(("probe_cores", 0.125));
            row
        };
        Axis {
            key: "probes",
            title: "Title",
            x_label: "probes attached",
            each: "probe",
            law: Law::Linear,
            cost_key: "cores",
            cost_label: "cores in use",
            rows: [0, 2, 6].map(row).to_vec(),
        }
    }

    /// All figures of an axis, and its growth, are in the report under key and value.
    #[test]
    fn figures_are_noted_by_axis_and_value() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("figures.json");
        let mut report = Report::default();
        axis().note(&mut report);
        report.write(&path, &serde_json::json!({})).unwrap();
        let value = crate::report::read(&path).unwrap();
        let figure = |pointer: &str| value.pointer(&format!("/scale/probes/{pointer}")).unwrap().as_f64().unwrap();
        assert_eq!((figure("2/p50_ms"), figure("2/p99_ms"), figure("2/max_ms")), (4.5, 4.99, 5.0));
        assert_eq!((figure("6/count"), figure("6/missed"), figure("6/cores")), (100.0, 3.0, 2.0));
        assert_eq!(figure("0/probe_cores"), 0.125);
        assert_eq!((figure("fit/p50_ms/slope"), figure("fit/p50_ms/at_zero")), (2.0, 0.5));
        assert_eq!((figure("fit/cores/slope"), figure("fit/cores/r_squared")), (0.25, 1.0));
    }

    /// The table has a row for each value, and the sentence contains the slopes.
    #[test]
    fn growth_is_a_sentence() {
        let axis = axis();
        let rows = axis.table();
        assert_eq!(rows.len(), 4);
        assert_eq!(rows[2], ["2", "4.50", "4.99", "5.00", "100, 3 missed", "1.00", "probe cores 0.125"]);
        assert_eq!(
            axis.growth(),
            "probes: p50 = 0.500 + 2.00 ms a probe (R² 1.00); cores = 0.500 + 0.250 cores a probe (R² 1.00)"
        );
        let single = Axis { rows: axis.rows[..1].to_vec(), ..axis };
        assert!(single.growth().contains("no growth can be fitted"));
    }

    /// A fit is drawn from the first to the last value, in even steps on its axis.
    #[test]
    fn fits_span_the_values() {
        let mut axis = axis();
        assert_eq!(axis.between(false)[..3], [0.0, 0.1, 0.2]);
        axis.rows = [32, 256].map(|x| Row { x, ..axis.rows[0].clone() }).to_vec();
        let x = axis.between(true);
        assert!((x[0] - 32.0).abs() < 1e-9 && (x[20] - 64.0).abs() < 1e-9 && (x[60] - 256.0).abs() < 1e-9, "{x:?}");
    }

    /// A plot is drawn for any law, and also for a single value.
    #[test]
    fn plots_are_drawn() {
        let folder = tempfile::tempdir().unwrap();
        for (law, rows) in [(Law::Linear, 3), (Law::Area, 3), (Law::Power, 3), (Law::Power, 1)] {
            let axis = Axis { law, rows: axis().rows[..rows].to_vec(), ..axis() };
            axis.plot(folder.path()).unwrap();
            assert!(carff_dataset::Image::load(&folder.path().join("probes.png")).is_ok());
            std::fs::remove_file(folder.path().join("probes.png")).unwrap();
        }
    }
}
