//! `carff doctor`: checks the machine and a graph, and reports problems with consequence and remedy. `gather` collects
//! facts, `checks` judges them, `finding` prints the findings.

mod checks;
mod finding;
mod gather;
mod graph;

pub use finding::{Area, Finding, Level};

use anyhow::Context;
use carff::provenance;
use carff_config::{Backend, GraphConfig, RendererConfig, StagesConfig};
use carff_transport::graph_bytes;
use std::io::IsTerminal;
use std::path::PathBuf;
use std::process::ExitCode;

/// Check the machine.
#[derive(Clone, Debug, clap::Args)]
pub struct DoctorArgs {
    /// A graph file, as in configs/graphs: also check its requirements, and that the files that it names exist and fit.
    pub graph: Option<PathBuf>,
    /// Dataset folder, in place of the graph file's.
    #[arg(long, requires = "graph")]
    pub dataset: Option<PathBuf>,
    /// Checkpoint folder, in place of the graph file's.
    #[arg(long, requires = "graph")]
    pub checkpoint: Option<PathBuf>,
    /// Print the findings as JSON.
    #[arg(long)]
    pub json: bool,
}

/// Prints the findings; the exit code is 1 if a finding prevents a graph from running.
pub fn run(args: &DoctorArgs) -> anyhow::Result<ExitCode> {
    let findings = examine(args)?;
    let text = if args.json {
        let graph = args.graph.as_deref().and_then(|path| GraphConfig::load(path).ok());
        let checkpoint = graph.map(|g| g.resolve(args.checkpoint.as_ref().unwrap_or(&g.run.checkpoint)));
        let mut json = finding::json(&findings);
        json["origin"] = serde_json::json!(provenance::of(None, checkpoint.as_deref()));
        serde_json::to_string_pretty(&json)? + "\n"
    } else {
        let colours = std::env::var_os("NO_COLOR").is_none_or(|v| v.is_empty());
        finding::text(&findings, colours && std::io::stdout().is_terminal())
    };
    print!("{text}");
    let failed = findings.iter().any(|f| f.level == Level::Error);
    Ok(if failed { ExitCode::FAILURE } else { ExitCode::SUCCESS })
}

/// Returns all findings.
pub fn examine(args: &DoctorArgs) -> anyhow::Result<Vec<Finding>> {
    let graph = args.graph.as_deref().map(GraphConfig::load);
    let config = graph.as_ref().and_then(|g| g.as_ref().ok());
    let stages = config.map_or_else(StagesConfig::default, |g| g.stages.clone());
    let renderer = config.map_or_else(RendererConfig::default, |g| g.renderer.clone());

    let (name, features) = gather::processor();
    let features: Vec<&str> = features.iter().map(String::as_str).collect();
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let mut findings = vec![checks::processor(&name, &features), checks::cores(cores, &stages)];
    findings.extend(gather::available_memory().map(checks::memory));
    findings.extend([checks::clock(&gather::clock()), checks::governor(&gather::governors())]);
    let here = std::env::current_dir().context("the current folder does not exist: change to another one")?;
    findings.extend(gather::free_bytes(&here).map(|bytes| checks::disk(&here, bytes)));

    let view_bytes = carff_messages::rgb_bytes(renderer.width_px, renderer.height_px);
    let needed_bytes = graph_bytes(crate::launch::FRAME_BYTES, view_bytes);
    findings.extend(checks::shared_memory(&gather::shared_memory(), needed_bytes));
    let (folder, writable) = gather::run_folder();
    findings.push(checks::run_folder(&folder, writable));
    let (runs, strays) = gather::runs()?;
    findings.extend(checks::leftovers(&runs, &strays));

    findings.extend(checks::limits(&gather::allowed(), &stages));
    findings.extend(checks::bound_cores(&gather::online(), &stages));
    findings.push(checks::remove_ipc(&gather::logind()));

    let folder =
        std::env::current_exe()?.parent().context("this program has no folder: start it by its whole path")?.to_owned();
    let (library, version) = gather::libtorch(&folder);
    let needed = stages.encoder_backend() == Backend::Tch;
    findings.push(checks::libtorch(library.as_deref(), version.as_deref(), needed));
    let onnx = carff_inference::library::build().map_err(|e| e.to_string());
    let needed = stages.encoder_backend() == Backend::Onnx;
    let onnx = onnx.as_ref().copied().map_err(String::as_str);
    findings.push(checks::onnx_runtime(&carff_inference::library::path(), onnx, needed));
    findings.push(checks::programs(&folder, &gather::missing_programs(&folder, &stages)));

    match (&args.graph, graph) {
        (Some(path), Some(Ok(config))) => {
            findings.extend(graph::check(path, &config, args.dataset.as_deref(), args.checkpoint.as_deref()));
        }
        (_, Some(Err(error))) => findings.push(graph::wrong(&error)),
        _ => {}
    }
    Ok(findings)
}
