//! `carff run info`: the identity of a run and the layouts of its topics, with which a program in any language joins.

use crate::complete;
use carff_config::{CameraSource, GraphConfig};
use carff_dataset::Dataset;
use carff_messages::layout::Layout;
use carff_messages::{Intrinsics, SCHEMA_VERSION};
use carff_observe::LiveRun;
use carff_transport::{Run, TRANSPORT_VERSION, TopicId};
use clap_complete::engine::ArgValueCandidates;
use serde::Serialize;
use std::fmt;
use std::path::PathBuf;
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

/// Describes a run to a program that joins it. Its JSON is a contract with programs in other languages.
#[derive(Clone, Debug, Serialize)]
pub struct RunInfo {
    run: String,
    /// 16 hexadecimal digits, as in the header of each message.
    run_id: String,
    launcher_pid: u32,
    schema_version: u32,
    transport: TransportInfo,
    graph: PathBuf,
    dataset: PathBuf,
    checkpoint: PathBuf,
    /// `None` where the graph file cannot be read any more.
    camera: Option<CameraInfo>,
    topics: Vec<TopicInfo>,
}

#[derive(Clone, Debug, Serialize)]
struct TransportInfo {
    name: &'static str,
    version: &'static str,
    prefix: String,
    root_path: PathBuf,
}

/// The camera that the graph expects.
#[derive(Clone, Debug, Serialize)]
struct CameraInfo {
    source: CameraSource,
    frame_rate_hz: f64,
    /// The camera of the training; `None` without a dataset.
    trained: Option<TrainedCamera>,
}

#[derive(Clone, Debug, Serialize)]
struct TrainedCamera {
    width_px: u32,
    height_px: u32,
    #[serde(flatten)]
    intrinsics: Intrinsics,
    field_of_view_deg: [f64; 2],
}

/// A topic: two services of its name, publish-subscribe, and an event for wake-ups.
#[derive(Clone, Debug, Serialize)]
struct TopicInfo {
    name: &'static str,
    payload: PayloadInfo,
    /// Layout of the message that describes an image.
    user_header: Option<Layout>,
    limits: LimitsInfo,
}

#[derive(Clone, Debug, Serialize)]
#[serde(untagged)]
enum PayloadInfo {
    Message(Layout),
    Bytes { type_name: &'static str, variant: &'static str, content: &'static str },
}

#[derive(Clone, Debug, Serialize)]
struct LimitsInfo {
    max_subscribers: usize,
    max_publishers: usize,
    max_nodes: usize,
    history_size: usize,
    subscriber_max_buffer_size: usize,
    subscriber_max_borrowed_samples: usize,
    enable_safe_overflow: bool,
    event_id_max_value: usize,
}

/// Runs one of the commands.
pub fn run(command: &RunCommand) -> anyhow::Result<ExitCode> {
    let RunCommand::Info(args) = command;
    let info = RunInfo::of(&carff_observe::find(args.run.as_deref())?)?;
    if args.json {
        println!("{}", serde_json::to_string_pretty(&info)?);
    } else {
        print!("{info}");
    }
    Ok(ExitCode::SUCCESS)
}

impl RunInfo {
    /// Describes a run.
    pub fn of(live: &LiveRun) -> anyhow::Result<Self> {
        let run = Run::within(&live.dir, &live.name, live.run_id)?;
        Ok(Self {
            run: live.name.clone(),
            run_id: format!("{:016x}", live.run_id),
            launcher_pid: live.pid,
            schema_version: SCHEMA_VERSION,
            transport: TransportInfo {
                name: "iceoryx2",
                version: TRANSPORT_VERSION,
                prefix: run.shared_memory_prefix(),
                root_path: run.folder(),
            },
            graph: live.graph.clone(),
            dataset: live.dataset.clone(),
            checkpoint: live.checkpoint.clone(),
            camera: CameraInfo::of(live),
            topics: TopicId::all().map(TopicInfo::of).collect(),
        })
    }
}

impl CameraInfo {
    fn of(live: &LiveRun) -> Option<Self> {
        let graph = GraphConfig::load(&live.graph).ok()?;
        let camera = Dataset::open(&live.dataset).ok().and_then(|dataset| dataset.usual_camera());
        let trained = camera.map(|camera| TrainedCamera {
            width_px: camera.width_px,
            height_px: camera.height_px,
            intrinsics: Intrinsics::from(&camera),
            field_of_view_deg: camera.field_of_view_deg(),
        });
        Some(Self { source: graph.camera.source, frame_rate_hz: graph.run.frame_rate_hz, trained })
    }
}

impl TopicInfo {
    fn of(topic: TopicId) -> Self {
        let limits = topic.limits();
        let bytes = PayloadInfo::Bytes { type_name: "u8", variant: "slice", content: "RGB, 8 bit, rows from the top" };
        let (payload, user_header) =
            if topic.is_image() { (bytes, Some(topic.layout())) } else { (PayloadInfo::Message(topic.layout()), None) };
        Self {
            name: topic.name(),
            payload,
            user_header,
            limits: LimitsInfo {
                max_subscribers: limits.max_subscribers,
                max_publishers: limits.max_publishers,
                max_nodes: limits.max_nodes,
                history_size: limits.history,
                subscriber_max_buffer_size: limits.buffer,
                subscriber_max_borrowed_samples: limits.borrowed,
                enable_safe_overflow: true,
                event_id_max_value: 0,
            },
        }
    }
}

impl fmt::Display for RunInfo {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut row = |name: &str, value: &dyn fmt::Display| writeln!(f, "{name:<16} {value}");
        row("run", &self.run)?;
        row("run id", &self.run_id)?;
        row("schema version", &self.schema_version)?;
        row("transport", &self.transport.version)?;
        row("prefix", &self.transport.prefix)?;
        row("root path", &self.transport.root_path.display())?;
        if let Some(camera) = &self.camera {
            let source = serde_json::to_value(camera.source).map_err(|_| fmt::Error)?;
            row("camera", &source.as_str().unwrap_or_default())?;
            row("frames a second", &camera.frame_rate_hz)?;
        }
        writeln!(f, "\n{:<22} {:<24} {:>6}  ALIGNMENT", "TOPIC", "MESSAGE", "BYTES")?;
        for topic in &self.topics {
            let (layout, image) = match (&topic.user_header, &topic.payload) {
                (Some(layout), _) => (layout, " + RGB image"),
                (None, PayloadInfo::Message(layout)) => (layout, ""),
                (None, PayloadInfo::Bytes { .. }) => continue,
            };
            let Layout { type_name, size_bytes, alignment_bytes, .. } = layout;
            writeln!(f, "{:<22} {type_name:<24} {size_bytes:>6}  {alignment_bytes}{image}", topic.name)?;
        }
        Ok(())
    }
}
