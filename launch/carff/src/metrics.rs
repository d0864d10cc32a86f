//! `carff metrics`: serves a run's metrics over HTTP, for Prometheus and for scripts.

use crate::session::{Session, SessionArgs};
use crate::vitals::{RunVitals, StageVitals};
use anyhow::{Context, anyhow, ensure};
use carff_base::statistics::percentile;
use carff_messages::Stage;
use carff_transport::monotonic_now_ns;
use clap::Args;
use serde_json::{Value, json};
use std::fmt::{Display, Write};
use std::net::SocketAddr;
use std::process::ExitCode;
use tiny_http::{Header, Method, Response, Server};

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
    #[arg(long)]
    pub once: bool,
    /// The run, and the time limit.
    #[command(flatten)]
    pub session: SessionArgs,
}

/// Serves until a stop is requested, the time is over, or the run ends.
pub fn run(args: &MetricsArgs) -> anyhow::Result<ExitCode> {
    refuse_remote(args.listen, args.remote)?;
    let mut session_args = args.session.clone();
    if args.once {
        session_args.seconds = session_args.seconds.or(Some(3.0));
    }
    let mut session = Session::open(&session_args, "metrics")?;
    session.listen(RunVitals::topics())?;
    let server = if args.once {
        None
    } else {
        let server = Server::http(args.listen).map_err(|e| anyhow!("cannot listen on {}: {e}", args.listen))?;
        println!("http://{}/metrics and /status", server.server_addr());
        Some(server)
    };
    let name = session.attached.live.name.clone();
    let mut vitals = RunVitals::default();
    let going = vitals.gather(&mut session, |vitals| {
        while let Some(request) = server.as_ref().map(Server::try_recv).transpose().context("cannot serve")?.flatten() {
            let (status, kind, body) = answer(request.method(), request.url(), &name, vitals);
            let mut response = Response::from_string(body).with_status_code(status);
            if let Ok(header) = Header::from_bytes("Content-Type", kind) {
                response = response.with_header(header);
            }
            // The client may have closed the connection.
            let _ = request.respond(response);
        }
        Ok(true)
    })?;
    if args.once {
        println!("{}", serde_json::to_string_pretty(&status(&name, &vitals))?);
    }
    session.say_end(going);
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

/// Returns status, content type and text of the response to a request.
fn answer(method: &Method, url: &str, run: &str, vitals: &RunVitals) -> (u16, &'static str, String) {
    match (method, url.split('?').next().unwrap_or_default()) {
        (Method::Get, "/metrics") => (200, "text/plain; version=0.0.4; charset=utf-8", prometheus(run, vitals)),
        (Method::Get, "/status") => (200, "application/json", status(run, vitals).to_string()),
        (Method::Get, _) => (404, "text/plain", "try /metrics or /status\n".to_owned()),
        _ => (405, "text/plain", "only GET\n".to_owned()),
    }
}

fn status(run: &str, vitals: &RunVitals) -> Value {
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
        "frames": vitals.frames,
        "decisions": vitals.decisions,
        "actions": vitals.actions,
        "safe_actions": vitals.safe_actions,
        "action": vitals.last_action.map(|(action, _)| action),
        "reason": vitals.last_action.map(|(_, reason)| reason),
        "hazard_probability": vitals.hazard_probability,
        "camera_to_action_ms": { "p50": percentile(&decided, 0.5), "p99": percentile(&decided, 0.99) },
        "stages": stages,
    })
}

/// Returns the metrics in the Prometheus text format.
fn prometheus(run: &str, vitals: &RunVitals) -> String {
    let mut text = String::new();
    let mut family = |name: &str, kind: &str, help: &str, samples: &[(String, String)]| {
        // Writing into a string does not fail.
        let _ = writeln!(text, "# HELP carff_{name} {help}\n# TYPE carff_{name} {kind}");
        for (labels, value) in samples {
            let comma = if labels.is_empty() { "" } else { "," };
            let _ = writeln!(text, "carff_{name}{{run=\"{run}\"{comma}{labels}}} {value}");
        }
    };
    let one = |value: &dyn Display| vec![(String::new(), value.to_string())];
    let labelled = |label: &str, counts: &std::collections::BTreeMap<&'static str, u64>| -> Vec<(String, String)> {
        counts.iter().map(|(name, count)| (format!("{label}=\"{name}\""), count.to_string())).collect()
    };
    family("frames_total", "counter", "Frames from the camera.", &one(&vitals.frames));
    family("decisions_total", "counter", "Decisions on a frame.", &one(&vitals.decisions));
    family("actions_total", "counter", "Actions published.", &labelled("action", &vitals.actions));
    family("safe_actions_total", "counter", "Safe actions by reason.", &labelled("reason", &vitals.safe_actions));
    family("hazard_probability", "gauge", "Hazard probability of the latest action.", &one(&vitals.hazard_probability));
    let decided: Vec<f64> = vitals.decided_ms.iter().copied().collect();
    let quantiles: Vec<(String, String)> = [0.5, 0.9, 0.99]
        .iter()
        .filter_map(|&q| percentile(&decided, q).map(|ms| (format!("quantile=\"{q}\""), (ms / 1e3).to_string())))
        .collect();
    family("camera_to_action_seconds", "gauge", "Time from capture to decision of the latest decisions.", &quantiles);
    let now_ns = monotonic_now_ns();
    let mut of_stages = |name: &str, kind: &str, help: &str, value: &dyn Fn(&StageVitals) -> String| {
        let samples: Vec<(String, String)> =
            vitals.stages.iter().map(|(stage, v)| (format!("stage=\"{stage}\""), value(v))).collect();
        family(name, kind, help, &samples);
    };
    of_stages("stage_up", "gauge", "1 when the stage is ok.", &|v| u8::from(v.state_name(now_ns) == "ok").to_string());
    of_stages("stage_messages_total", "counter", "Messages seen on the stage's topic.", &|v| v.messages.to_string());
    of_stages("stage_rate_hertz", "gauge", "Recent rate of messages.", &|v| v.rate_hz(now_ns).to_string());
    of_stages("stage_latency_seconds", "gauge", "Latency of the latest output.", &|v| {
        (v.latency_ms.back().copied().unwrap_or(0.0) / 1e3).to_string()
    });
    of_stages("stage_cpu_cores", "gauge", "Cores in use.", &|v| v.cpu.to_string());
    of_stages("stage_resident_bytes", "gauge", "Resident memory.", &|v| v.rss_bytes.to_string());
    of_stages("stage_skipped_total", "counter", "Inputs skipped for newer ones.", &|v| v.counts[0].to_string());
    of_stages("stage_invalid_total", "counter", "Invalid inputs dropped.", &|v| v.counts[1].to_string());
    of_stages("stage_errors_total", "counter", "Errors of the stage.", &|v| v.counts[2].to_string());
    of_stages("stage_restarts_total", "counter", "New processes seen.", &|v| v.restarts.to_string());
    of_stages("stage_late_total", "counter", "Heartbeats that reported slow or stale.", &|v| v.late.to_string());
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use carff_messages::forms::AnyMessage;
    use carff_messages::{Gaussian, Posterior};

    fn vitals() -> RunVitals {
        let mut vitals = RunVitals::default();
        let header = carff_messages::Header::of_frame(1, 1, 1);
        let posterior = Posterior { header, gaussian: Gaussian::standard(), stage_latency_ns: 15_000_000 };
        vitals.take(AnyMessage::new(&posterior, &[]));
        vitals
    }

    /// Each line is a comment or a sample with labels and a number; the stage with messages is included.
    #[test]
    fn metrics_are_in_the_text_format() {
        let text = prometheus("r", &vitals());
        for line in text.lines().filter(|l| !l.starts_with('#')) {
            let (name, value) = line.rsplit_once(' ').unwrap();
            assert!(name.starts_with("carff_") && name.contains("{run=\"r\"") && name.ends_with('}'), "{line}");
            assert!(value.parse::<f64>().is_ok(), "{line}");
        }
        assert!(text.contains("carff_stage_latency_seconds{run=\"r\",stage=\"encoder\"} 0.015"), "{text}");
    }

    /// An address that other machines can reach is refused without `--remote`.
    #[test]
    fn nothing_listens_to_others_by_mistake() {
        assert!(refuse_remote("127.0.0.1:1".parse().unwrap(), false).is_ok());
        assert!(refuse_remote("[::1]:1".parse().unwrap(), false).is_ok());
        assert!(refuse_remote("0.0.0.0:1".parse().unwrap(), false).is_err());
        assert!(refuse_remote("0.0.0.0:1".parse().unwrap(), true).is_ok());
    }

    /// Unknown paths and other methods than GET are refused.
    #[test]
    fn other_requests_are_refused() {
        assert_eq!(answer(&Method::Get, "/metrics?x=1", "r", &vitals()).0, 200);
        assert_eq!(answer(&Method::Get, "/etc/passwd", "r", &vitals()).0, 404);
        assert_eq!(answer(&Method::Post, "/metrics", "r", &vitals()).0, 405);
        let status: Value = serde_json::from_str(&answer(&Method::Get, "/status", "r", &vitals()).2).unwrap();
        assert_eq!(status["stages"]["encoder"]["messages"], 1);
    }
}
