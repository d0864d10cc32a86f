//! `carff metrics`: serves a run's metrics over HTTP, for Prometheus and for scripts.

use crate::conditions::{ConditionCount, Conditions};
use crate::http::{Response, Server};
use crate::provenance::{self, Origin};
use crate::session::{Sessions, WaitArgs};
use crate::vitals::{Labels, RunVitals, StageVitals};
use anyhow::{Context, ensure};
use carff_base::statistics::percentile;
use carff_messages::{ImageCondition, Stage};
use carff_transport::monotonic_now_ns;
use clap::Args;
use prometheus_client::encoding::prometheus_text;
use prometheus_client::metrics::counter::{ConstCounter, Counter};
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::{ConstGauge, Gauge};
use prometheus_client::metrics::info::Info;
use prometheus_client::registry::Registry;
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::process::ExitCode;
use std::sync::atomic::AtomicU64;

/// Serve a run's metrics.
#[derive(Clone, Debug, Args)]
pub struct MetricsArgs {
    /// Address and port to listen on; other than loopback only with --remote. Port 0 selects a free port.
    #[arg(long, default_value = "127.0.0.1:9464")]
    pub listen: SocketAddr,
    /// Allow an address that other machines can reach. Every host that reaches it can read the metrics.
    #[arg(long)]
    pub remote: bool,
    /// Print the status once, as JSON, after 3 seconds (or --seconds), and serve nothing.
    #[arg(long, conflicts_with = "wait")]
    pub once: bool,
    /// The run, the time limit, and the runs after it.
    #[command(flatten)]
    pub runs: WaitArgs,
}

/// Serves until a stop is requested, the time is over, or the run ends; with `--wait`, also while no run is alive.
pub fn run(args: &MetricsArgs) -> anyhow::Result<ExitCode> {
    refuse_remote(args.listen, args.remote)?;
    let mut runs = args.runs.clone();
    if args.once {
        runs.session.seconds = runs.session.seconds.or(Some(3.0));
    }
    let mut sessions = Sessions::new(&runs, "metrics")?;
    let mut server = None;
    if !args.once {
        let bound = Server::bind(args.listen).with_context(|| format!("cannot listen on {}", args.listen))?;
        println!("http://{}/metrics and /status", bound.address()?);
        server = Some(bound);
    }
    let mut last = runs.session.run.clone();
    while let Some(mut session) = sessions.next(|| {
        if let Some(server) = &mut server {
            server.serve(|method, target| answer(method, target, last.as_deref(), None));
        }
    })? {
        session.listen(RunVitals::topics())?;
        let live = session.attached.live.clone();
        let origin = provenance::of(Some(live.started_unix_s), Some(&live.checkpoint));
        let mut vitals = RunVitals::default();
        let going = vitals.gather(&mut session, |vitals| {
            if let Some(server) = &mut server {
                server.serve(|method, target| answer(method, target, Some(&live.name), Some((&origin, vitals))));
            }
            Ok(true)
        })?;
        if args.once {
            println!("{}", serde_json::to_string_pretty(&status(&live.name, &origin, &vitals))?);
        }
        session.say_end(going);
        last = Some(live.name);
    }
    Ok(ExitCode::SUCCESS)
}

/// Refuses an address that other machines can reach without `--remote`.
pub(crate) fn refuse_remote(listen: SocketAddr, remote: bool) -> anyhow::Result<()> {
    ensure!(
        remote || listen.ip().is_loopback(),
        "other machines can reach {listen}: add --remote to allow this, or listen on 127.0.0.1"
    );
    Ok(())
}

/// Returns the response to a request, with the observed run's name, and what was observed if it is alive.
fn answer(method: &str, target: &str, run: Option<&str>, seen: Option<(&Origin, &RunVitals)>) -> Response {
    let name = run.unwrap_or_default();
    let metrics = || seen.map_or_else(|| down(run), |(origin, vitals)| prometheus(name, origin, vitals));
    let status = || seen.map_or_else(|| json!({ "run": null }), |(origin, vitals)| status(name, origin, vitals));
    match (method, target.split('?').next().unwrap_or_default()) {
        ("GET", "/metrics") => ("200 OK", prometheus_text::CONTENT_TYPE, metrics()),
        ("GET", "/status") => ("200 OK", "application/json", status().to_string()),
        ("GET", _) => ("404 Not Found", "text/plain", "try /metrics or /status\n".to_owned()),
        _ => ("405 Method Not Allowed", "text/plain", "only GET\n".to_owned()),
    }
}

/// Returns the metrics while no run is alive.
fn down(run: Option<&str>) -> String {
    text(&registry(run, 0.0))
}

/// Returns a registry with the metric that is always there.
fn registry(run: Option<&str>, up: f64) -> Registry {
    let labels = run.map(|run| ("run".into(), run.to_owned().into()));
    let mut registry = Registry::with_prefix_and_labels("carff", labels.into_iter());
    registry.register("up", "1 if a run is alive and observed, else 0", ConstGauge::new(up));
    registry
}

fn text(registry: &Registry) -> String {
    let mut text = String::new();
    // Writing into a string does not fail.
    let _ = prometheus_text::encode(&mut text, registry);
    text
}

/// Returns the status as JSON. Counts of messages start with the observation; `skipped`, `invalid`, `errors` and
/// `max_latency_ms` with the stage.
fn status(run: &str, origin: &Origin, vitals: &RunVitals) -> Value {
    let now_ns = monotonic_now_ns();
    let decided: Vec<f64> = vitals.decided_ms.iter().copied().collect();
    let stages: serde_json::Map<String, Value> = Stage::ALL
        .iter()
        .map(|stage| {
            let v = vitals.stages.get(stage).cloned().unwrap_or_default();
            let value = json!({
                "state": v.state_name(now_ns), "pid": v.pid, "rate_hz": v.rate_hz(now_ns), "messages": v.messages,
                "latency_ms": v.latency_ms.back(), "max_latency_ms": v.max_latency_ms, "cpu": v.cpu,
                "rss_bytes": v.rss_bytes, "skipped": v.counts[0], "invalid": v.counts[1], "errors": v.counts[2],
                "restarts": v.restarts, "late": v.late,
            });
            (stage.name().to_owned(), value)
        })
        .collect();
    json!({
        "run": run,
        "origin": origin,
        "frames": vitals.frames,
        "decisions": vitals.decisions,
        "actions": vitals.actions,
        "safe_actions": vitals.safe_actions,
        "camera": vitals.conditions.current().map(ImageCondition::name),
        "images": vitals.conditions.counts().map(|(c, n)| (c.name(), n.images)).collect::<BTreeMap<_, _>>(),
        "action": vitals.last_action.map(|(action, _)| action),
        "reason": vitals.last_action.map(|(_, reason)| reason),
        "hazard_probability": vitals.hazard_probability,
        "unknown_probability": vitals.unknown_probability,
        "camera_to_action_ms": { "p50": percentile(&decided, 0.5), "p99": percentile(&decided, 0.99) },
        "stages": stages,
    })
}

/// Returns the metrics in the Prometheus text format.
fn prometheus(run: &str, origin: &Origin, vitals: &RunVitals) -> String {
    let mut registry = registry(Some(run), 1.0);
    let labels: Vec<(&'static str, String)> = origin.clone().into_iter().collect();
    registry.register("build", "Program, host, start of the run and checkpoint", Info::new(labels));
    registry.register("frames", "Frames from the camera since this exporter started", ConstCounter::new(vitals.frames));
    let decisions = ConstCounter::new(vitals.decisions);
    registry.register("decisions", "Decisions on a frame since this exporter started", decisions);
    let labelled = |label: &'static str, counts: &BTreeMap<&'static str, u64>| {
        let family = Family::<Labels, Counter>::default();
        for (name, count) in counts {
            family.get_or_create(&[(label, *name)]).inc_by(*count);
        }
        family
    };
    let actions = labelled("action", &vitals.actions);
    registry.register("actions", "Actions published since this exporter started", actions);
    let safe_actions = labelled("reason", &vitals.safe_actions);
    registry.register("safe_actions", "Safe actions since this exporter started, by reason", safe_actions);
    camera(&mut registry, &vitals.conditions);
    let hazard = ConstGauge::new(f64::from(vitals.hazard_probability));
    registry.register("hazard_probability", "Hazard probability of the latest action, 0 to 1", hazard);
    let unknown = ConstGauge::new(f64::from(vitals.unknown_probability));
    let help = "Probability of something that no known state explains, in the latest action, 0 to 1";
    registry.register("unknown_probability", help, unknown);
    let histograms = &vitals.histograms;
    let camera_to_action = histograms.camera_to_action.clone();
    registry.register("camera_to_action_seconds", "Time from capture to decision", camera_to_action);
    let help = "Time from the arrival of an input to the output, as the stage measures it; of camera and controller, \
                one value for each heartbeat";
    registry.register("stage_latency_seconds", help, histograms.stages.clone());
    stages(&mut registry, vitals);
    text(&registry)
}

/// Registers the conditions of the camera.
fn camera(registry: &mut Registry, conditions: &Conditions) {
    let current = Family::<Labels, Gauge>::default();
    for condition in ImageCondition::ALL.into_iter().filter(|_| conditions.current().is_some()) {
        let is_current = conditions.current() == Some(condition);
        current.get_or_create(&[("condition", condition.name())]).set(is_current.into());
    }
    registry.register("camera_condition", "1 for the condition of the latest checked image, else 0", current);
    let mut counter = |name: &str, help: &str, value: &dyn Fn(&ConditionCount) -> u64| {
        let family = Family::<Labels, Counter>::default();
        for (condition, count) in conditions.counts() {
            family.get_or_create(&[("condition", condition.name())]).inc_by(value(count));
        }
        registry.register(name, help, family);
    };
    counter("camera_frames", "Checked frames since this exporter started, by condition", &|count| count.images);
    let help = "Sequences of frames of one condition since this exporter started, by condition";
    counter("camera_episodes", help, &|count| count.episodes);
}

/// Registers the metrics that each stage has.
fn stages(registry: &mut Registry, vitals: &RunVitals) {
    let now_ns = monotonic_now_ns();
    let mut gauge = |name: &str, help: &str, value: &dyn Fn(&StageVitals) -> f64| {
        let family = Family::<Labels, Gauge<f64, AtomicU64>>::default();
        for (stage, v) in &vitals.stages {
            family.get_or_create(&[("stage", stage.name())]).set(value(v));
        }
        registry.register(name, help, family);
    };
    gauge("stage_up", "1 if the stage is ok, else 0", &|v| f64::from(u8::from(v.state_name(now_ns) == "ok")));
    gauge("stage_latency_max_seconds", "Longest latency since the stage started", &|v| v.max_latency_ms / 1e3);
    gauge("stage_resident_memory_bytes", "Resident memory", &|v| v.rss_bytes as f64);
    let mut counter = |name: &str, help: &str, value: &dyn Fn(&StageVitals) -> f64| {
        let family = Family::<Labels, Counter<f64, AtomicU64>>::default();
        for (stage, v) in &vitals.stages {
            family.get_or_create(&[("stage", stage.name())]).inc_by(value(v));
        }
        registry.register(name, help, family);
    };
    counter("stage_messages", "Messages on the stage's topic since this exporter started", &|v| v.messages as f64);
    counter("stage_cpu_seconds", "Processor time since the stage started", &|v| v.cpu_ns as f64 / 1e9);
    counter("stage_skipped", "Inputs skipped for newer ones since the stage started", &|v| v.counts[0] as f64);
    counter("stage_invalid", "Invalid inputs dropped since the stage started", &|v| v.counts[1] as f64);
    counter("stage_errors", "Errors since the stage started", &|v| v.counts[2] as f64);
    counter("stage_restarts", "New processes since this exporter started", &|v| v.restarts as f64);
    counter("stage_late", "Heartbeats with slow or stale since this exporter started", &|v| v.late as f64);
}

#[cfg(test)]
mod tests {
    use super::*;
    use carff_messages::forms::AnyMessage;
    use carff_messages::{Gaussian, ImageCheck, Posterior};

    fn vitals() -> RunVitals {
        let mut vitals = RunVitals::default();
        let header = carff_messages::Header::of_frame(1, 1, 1);
        let posterior =
            Posterior { header, gaussian: Gaussian::standard(), take_start: 0, stage_latency_ns: 15_000_000 };
        vitals.take(AnyMessage::new(&posterior, &[]));
        vitals
    }

    fn origin() -> Origin {
        provenance::of(None, None)
    }

    /// The samples of a metric: its labels with their values, and its value.
    type Samples<'a> = Vec<(Vec<(&'a str, &'a str)>, f64)>;

    /// Parses the text format: each sample follows the help and the type of its metric, and no metric is repeated.
    fn parsed(text: &str) -> BTreeMap<&str, (&str, BTreeMap<&str, Samples<'_>>)> {
        let mut metrics: BTreeMap<&str, (&str, BTreeMap<&str, Samples<'_>>)> = BTreeMap::new();
        let (mut helped, mut current) = ("", "");
        for line in text.lines() {
            if let Some((name, help)) = line.strip_prefix("# HELP ").map(|rest| rest.split_once(' ').unwrap()) {
                assert!(!help.trim().is_empty() && !metrics.contains_key(name), "{line}");
                helped = name;
            } else if let Some((name, kind)) = line.strip_prefix("# TYPE ").map(|rest| rest.split_once(' ').unwrap()) {
                assert!(helped == name && ["counter", "gauge", "histogram"].contains(&kind), "{line}");
                metrics.insert(name, (kind, BTreeMap::new()));
                current = name;
            } else {
                let (series, value) = line.rsplit_once(' ').unwrap();
                let (name, labels) = series.strip_suffix('}').unwrap().split_once('{').unwrap();
                let labels = labels.split(',').map(|label| label.split_once('=').unwrap()).collect();
                assert!(name.starts_with(current), "{line}");
                let value = if value == "+Inf" { f64::INFINITY } else { value.parse().unwrap() };
                metrics.get_mut(current).unwrap().1.entry(name).or_default().push((labels, value));
            }
        }
        metrics
    }

    /// Abbreviated units, and units that are not base units.
    const NO_UNITS: [&str; 24] = [
        "s",
        "ms",
        "us",
        "ns",
        "sec",
        "b",
        "kb",
        "mb",
        "gb",
        "tb",
        "pb",
        "m",
        "h",
        "d",
        "hertz",
        "cores",
        "milliseconds",
        "microseconds",
        "nanoseconds",
        "minutes",
        "hours",
        "days",
        "kilobytes",
        "bits",
    ];

    /// The metrics follow the rules of `promtool check metrics`.
    #[test]
    fn metrics_follow_the_conventions() {
        let mut vitals = vitals();
        vitals.decisions = 3;
        vitals.actions.insert("halt", 2);
        vitals.safe_actions.insert("stale belief", 1);
        vitals.histograms.camera_to_action.observe(0.03);
        for (frame_id, condition) in
            [(1, ImageCondition::Usable), (2, ImageCondition::Black), (3, ImageCondition::Black)]
        {
            let check = ImageCheck::of_frame(carff_messages::Header::of_frame(frame_id, frame_id, 1));
            vitals.take(AnyMessage::new(&ImageCheck { condition: condition.code(), ..check }, &[]));
        }
        let text = prometheus("r", &origin(), &vitals);
        for (name, (kind, series)) in parsed(&text) {
            let words: Vec<&str> = name.split('_').collect();
            assert_eq!(words[0], "carff");
            assert!(name.chars().all(|c| c.is_ascii_lowercase() || c == '_'), "{name}");
            assert!(!words.iter().any(|w| NO_UNITS.contains(w)), "{name}: units");
            assert!(!["counter", "gauge", "histogram", "summary"].iter().any(|t| words.contains(t)), "{name}: type");
            assert_eq!(kind == "counter", name.ends_with("_total"), "{name}");
            assert!(["_bucket", "_count", "_sum"].iter().all(|end| !name.ends_with(end)), "{name}");
            for (sample, values) in series {
                for (labels, value) in values {
                    let has = |label: &str| labels.iter().any(|(name, _)| *name == label);
                    assert_eq!(labels[0], ("run", "\"r\""), "{sample}");
                    assert!(!has("quantile") && has("le") == sample.ends_with("_bucket"), "{sample}");
                    assert!(labels.iter().all(|(l, v)| !l.is_empty() && v.starts_with('"') && v.ends_with('"')));
                    assert!(value >= 0.0, "{sample}");
                }
            }
        }
        let line =
            |begin: &str| text.lines().find(|l| l.starts_with(begin)).unwrap_or_else(|| panic!("{begin}: {text}"));
        line("carff_build_info{run=\"r\",commit=\"");
        assert!(
            line("carff_decisions_total").ends_with(" 3") && line("carff_safe_actions_total").contains("stale belief")
        );
        assert_eq!(
            line("carff_stage_latency_seconds_sum"),
            "carff_stage_latency_seconds_sum{run=\"r\",stage=\"encoder\"} 0.015"
        );
        assert!(line("carff_camera_to_action_seconds_count").ends_with(" 1"));
        let of = |name: &str, condition: &str| format!("carff_camera_{name}{{run=\"r\",condition=\"{condition}\"}}");
        for (name, black, usable) in [("frames_total", 2, 1), ("episodes_total", 1, 1), ("condition", 1, 0)] {
            assert!(line(&of(name, "black")).ends_with(&format!(" {black}")), "{text}");
            assert!(line(&of(name, "usable")).ends_with(&format!(" {usable}")), "{text}");
        }
        assert!(line(&of("condition", "frozen")).ends_with(" 0"));
    }

    /// Names of runs, hosts and reasons are escaped.
    #[test]
    fn labels_are_escaped() {
        let text = prometheus("a\"b\\c\nd", &origin(), &vitals());
        assert!(text.contains(r#"carff_frames_total{run="a\"b\\c\nd"} 0"#), "{text}");
    }

    /// An address that other machines can reach is refused without `--remote`.
    #[test]
    fn nothing_listens_to_others_by_mistake() {
        assert!(refuse_remote("127.0.0.1:1".parse().unwrap(), false).is_ok());
        assert!(refuse_remote("[::1]:1".parse().unwrap(), false).is_ok());
        assert!(refuse_remote("0.0.0.0:1".parse().unwrap(), false).is_err());
        assert!(refuse_remote("0.0.0.0:1".parse().unwrap(), true).is_ok());
    }

    /// Without a run the exporter answers that it is down, for the run that it saw last.
    #[test]
    fn no_run_is_a_metric() {
        let answer = |run| answer("GET", "/metrics", run, None).2;
        assert!(answer(None).contains("\ncarff_up 0"), "{}", answer(None));
        assert!(answer(Some("r")).contains("carff_up{run=\"r\"} 0"), "{}", answer(Some("r")));
        assert!(prometheus("r", &origin(), &vitals()).contains("carff_up{run=\"r\"} 1"));
    }

    /// Unknown paths and other methods than GET are refused.
    #[test]
    fn other_requests_are_refused() {
        let answer = |method, target| answer(method, target, Some("r"), Some((&origin(), &vitals())));
        assert_eq!(answer("GET", "/metrics?x=1").0, "200 OK");
        assert_eq!(answer("GET", "/etc/passwd").0, "404 Not Found");
        assert_eq!(answer("POST", "/metrics").0, "405 Method Not Allowed");
        let status: Value = serde_json::from_str(&answer("GET", "/status").2).unwrap();
        assert_eq!(status["stages"]["encoder"]["messages"], 1);
    }
}
