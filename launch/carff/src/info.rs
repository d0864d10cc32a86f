//! `carff run info`: the identity of a run and the layouts of its topics, with which a program in any language joins.

use crate::complete;
use carff_config::GraphConfig;
use carff_dataset::Dataset;
use carff_messages::SCHEMA_VERSION;
use carff_messages::layout::{Described, Layout};
use carff_observe::LiveRun;
use carff_runtime::{EGO_MOTION, EGO_POSE, EgoMotion, EgoPose};
use carff_transport::{Limits, Run, TRANSPORT_VERSION, TopicId};
use clap_complete::engine::ArgValueCandidates;
use serde_json::{Value, json};
use std::fmt::Write;
use std::process::ExitCode;

/// The commands of `carff run`.
#[derive(Clone, Debug, clap::Subcommand)]
pub enum RunCommand {
    /// Print what another program needs to join a run: id, prefix, folder, and each topic's layout in memory.
    #[command(after_help = "Example: for a program
  carff run info approaching-intersection --json")]
    Info(InfoArgs),
}

/// A run, and the form of the output.
#[derive(Clone, Debug, clap::Args)]
pub struct InfoArgs {
    /// Name of the run; optional if only one runs.
    #[arg(add = ArgValueCandidates::new(complete::runs))]
    run: Option<String>,
    /// Print JSON, with the offset of each field.
    #[arg(long)]
    json: bool,
}

/// Runs one of the commands.
pub fn run(command: &RunCommand) -> anyhow::Result<ExitCode> {
    let RunCommand::Info(args) = command;
    let live = carff_observe::find(args.run.as_deref())?;
    let info = info(&live)?;
    if args.json {
        println!("{}", serde_json::to_string_pretty(&info)?);
    } else {
        print!("{}", text(&info));
    }
    Ok(ExitCode::SUCCESS)
}

/// Describes a run.
pub fn info(live: &LiveRun) -> anyhow::Result<Value> {
    let run = Run::within(&live.dir, &live.name, live.run_id)?;
    let graph = TopicId::all().map(|id| topic(id.name(), id.is_image(), &id.layout(), id.limits()));
    // A camera on a vehicle receives its pose, and a controller with an approach its motion.
    let pose = topic(EGO_POSE.name, false, &EgoPose::layout(), EGO_POSE.limits);
    let motion = topic(EGO_MOTION.name, false, &EgoMotion::layout(), EGO_MOTION.limits);
    let topics: Vec<Value> = graph.chain([pose, motion]).collect();
    Ok(json!({
        "run": live.name,
        "run_id": format!("{:016x}", live.run_id),
        "launcher_pid": live.pid,
        "schema_version": SCHEMA_VERSION,
        "transport": {
            "name": "iceoryx2",
            "version": TRANSPORT_VERSION,
            "prefix": run.shared_memory_prefix(),
            "root_path": run.folder().to_string_lossy(),
        },
        "graph": live.graph,
        "dataset": live.dataset,
        "checkpoint": live.checkpoint,
        "camera": camera(live),
        "topics": topics,
    }))
}

/// Describes the camera that the graph expects; `trained` is missing without a dataset.
fn camera(live: &LiveRun) -> Value {
    let Ok(graph) = GraphConfig::load(&live.graph) else { return Value::Null };
    let trained = Dataset::open(&live.dataset).ok().and_then(|dataset| dataset.usual_camera()).map(|camera| {
        json!({
            "width_px": camera.width_px,
            "height_px": camera.height_px,
            "fl_x_px": camera.fl_x_px,
            "fl_y_px": camera.fl_y_px,
            "cx_px": camera.cx_px,
            "cy_px": camera.cy_px,
            "field_of_view_deg": camera.field_of_view_deg(),
        })
    });
    json!({ "source": graph.camera.source, "frame_rate_hz": graph.run.frame_rate_hz, "trained": trained })
}

/// Describes a topic. It is two services of its name: publish-subscribe, and an event for wake-ups.
fn topic(name: &str, is_image: bool, layout: &Layout, limits: Limits) -> Value {
    let (payload, header) = if is_image {
        (json!({ "type_name": "u8", "variant": "slice", "content": "RGB, 8 bit, rows from the top" }), json!(layout))
    } else {
        (json!(layout), Value::Null)
    };
    json!({
        "name": name,
        "payload": payload,
        "user_header": header,
        "limits": {
            "max_subscribers": limits.max_subscribers,
            "max_publishers": limits.max_publishers,
            "max_nodes": limits.max_nodes,
            "history_size": limits.history,
            "subscriber_max_buffer_size": limits.buffer,
            "subscriber_max_borrowed_samples": limits.borrowed,
            "enable_safe_overflow": true,
            "event_id_max_value": 0,
        },
    })
}

/// Writing into a `String` cannot fail, so results of `writeln!` are dropped.
fn text(info: &Value) -> String {
    let word = |value: &Value| value.as_str().map_or_else(|| value.to_string(), str::to_owned);
    let transport = &info["transport"];
    let mut text = String::new();
    for (name, value) in [
        ("run", &info["run"]),
        ("run id", &info["run_id"]),
        ("schema version", &info["schema_version"]),
        ("transport", &transport["version"]),
        ("prefix", &transport["prefix"]),
        ("root path", &transport["root_path"]),
        ("camera", &info["camera"]["source"]),
        ("frames a second", &info["camera"]["frame_rate_hz"]),
    ] {
        let _ = writeln!(text, "{name:<16} {}", word(value));
    }
    let _ = writeln!(text, "\n{:<22} {:<24} {:>6}  ALIGNMENT", "TOPIC", "MESSAGE", "BYTES");
    for topic in info["topics"].as_array().into_iter().flatten() {
        let message = if topic["user_header"].is_null() { &topic["payload"] } else { &topic["user_header"] };
        let image = if topic["user_header"].is_null() { "" } else { " + RGB image" };
        let _ = writeln!(
            text,
            "{:<22} {:<24} {:>6}  {}{image}",
            word(&topic["name"]),
            word(&message["type_name"]),
            message["size_bytes"],
            message["alignment_bytes"]
        );
    }
    text
}
