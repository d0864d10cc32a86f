//! Checks a graph file, and the existence and consistency of the files that it names.

use super::finding::{Area, Finding};
use carff_checkpoint::CheckpointPlanning;
use carff_checkpoint::{Manifest, ScenarioIdentity};
use carff_config::{CameraSource, ConfigError, GraphConfig};
use carff_dataset::Dataset;
use carff_scenes::Scenario;
use std::fmt::Display;
use std::path::Path;

/// Consequence of findings that make `carff launch` refuse the graph.
const NO_LAUNCH: &str = "`carff launch` refuses it";

/// Checks a graph with its dataset and checkpoint; both can be replaced.
pub fn check(path: &Path, graph: &GraphConfig, dataset: Option<&Path>, checkpoint: Option<&Path>) -> Vec<Finding> {
    let mut findings = vec![Finding::ok(Area::Graph, "file", path.display().to_string())];
    for warning in graph.warnings() {
        findings.push(Finding::warning(
            Area::Graph,
            "settings",
            warning,
            "the graph runs, but possibly not as intended",
            format!("change {}", path.display()),
        ));
    }
    let dataset = graph.resolve(dataset.unwrap_or(&graph.run.dataset));
    let checkpoint = graph.resolve(checkpoint.unwrap_or(&graph.run.checkpoint));
    let renders = graph.camera.source == CameraSource::FreeDrives || !dataset.exists();
    let scenario = scenario(graph, renders, &mut findings);
    let shown = images(graph, &dataset, scenario.as_ref(), &mut findings);
    models(&checkpoint, shown.as_ref(), &mut findings);
    findings
}

/// Returns the finding for a graph file that cannot be read.
pub fn wrong(error: &ConfigError) -> Finding {
    let advice = match error {
        ConfigError::Read { .. } => "pass the path of a graph file, as in configs/graphs",
        _ => "correct the file at the reported line",
    };
    Finding::error(Area::Graph, "file", error.to_string(), NO_LAUNCH, advice)
}

/// Checks the scenario, if the graph names one; a wrong one is an error only if the graph renders it.
fn scenario(graph: &GraphConfig, renders: bool, findings: &mut Vec<Finding>) -> Option<Scenario> {
    let path = graph.scenario_path()?;
    match Scenario::load(&path) {
        Ok(scenario) => {
            findings.push(Finding::ok(Area::Graph, "scenario", path.display().to_string()));
            Some(scenario)
        }
        Err(error) => {
            let finding = if renders { Finding::error } else { Finding::warning };
            findings.push(finding(
                Area::Graph,
                "scenario",
                error.to_string().as_str(),
                "free drives and a missing dataset cannot be rendered",
                "correct `run.scenario` in the graph file, or the scenario file",
            ));
            None
        }
    }
}

/// Checks a source of images other than a dataset: the folder or the file that it names exists.
fn real_source(graph: &GraphConfig, dataset: &Path) -> Finding {
    let camera = &graph.camera;
    let (key, path) = match (camera.source, &camera.folder, &camera.file) {
        (CameraSource::Folder, Some(folder), _) => ("camera.folder", graph.resolve(folder)),
        (CameraSource::Folder, None, _) => ("camera.folder", dataset.join("images")),
        (CameraSource::Mcap | CameraSource::Video, _, Some(file)) => ("camera.file", graph.resolve(file)),
        (CameraSource::External, ..) => {
            return Finding::ok(Area::Graph, "images", "another process publishes `camera/frame`".to_owned());
        }
        _ => {
            let program = camera.source.program().unwrap_or_default();
            return Finding::ok(Area::Graph, "images", format!("from {program}; `carff camera check` shows them"));
        }
    };
    let there = if camera.source == CameraSource::Folder { path.is_dir() } else { path.exists() };
    if there {
        return Finding::ok(Area::Graph, "images", path.display().to_string());
    }
    let kind = if camera.source == CameraSource::Folder { "is not a folder" } else { "does not exist" };
    Finding::error(
        Area::Graph,
        "images",
        format!("{} {kind}{}", path.display(), carff_base::names::beside(&path)),
        "the camera has no images",
        format!("correct `{key}` in the graph file"),
    )
}

/// Checks that the calibration can be read.
fn calibration(graph: &GraphConfig) -> Option<Finding> {
    Some(match graph.calibration() {
        Ok(found) => {
            let [width, height] = found?.size_px();
            Finding::ok(Area::Graph, "calibration", format!("for images of {width}x{height} pixels"))
        }
        Err(error) => Finding::error(
            Area::Graph,
            "calibration",
            error.to_string(),
            "the camera's images cannot be rectified",
            "correct `camera.calibration` in the graph file",
        ),
    })
}

/// Checks the source of images. Returns the scenario of the images.
fn images(
    graph: &GraphConfig,
    dataset: &Path,
    scenario: Option<&Scenario>,
    findings: &mut Vec<Finding>,
) -> Option<ScenarioIdentity> {
    let subject = "dataset";
    let camera = &graph.camera;
    if !camera.source.has_truth() {
        findings.push(real_source(graph, dataset));
        camera.calibration.as_ref()?;
        findings.extend(calibration(graph));
    }
    let rendered = scenario.map(|s| ScenarioIdentity::of(s.info(), s.cameras().len()));
    if !dataset.exists() {
        findings.push(match &rendered {
            Some(_) => Finding::ok(
                Area::Graph,
                subject,
                format!("{} does not exist yet: `carff launch` renders it", dataset.display()),
            ),
            None => Finding::error(
                Area::Graph,
                subject,
                format!("{} does not exist{}", dataset.display(), carff_base::names::beside(dataset)),
                NO_LAUNCH,
                "pass --dataset, or name its scenario in the graph file (`run.scenario`)",
            ),
        });
        return rendered;
    }
    match Dataset::open(dataset) {
        Ok(set) => {
            for warning in set.warnings() {
                findings.push(Finding::warning(
                    Area::Graph,
                    subject,
                    warning.clone(),
                    "parts of the dataset cannot be used",
                    format!("carff dataset check {}", dataset.display()),
                ));
            }
            let found = format!("{}: {} images", dataset.display(), set.frames().len());
            findings.push(Finding::ok(Area::Graph, subject, found));
            set.scenario().map(|s| ScenarioIdentity::of(s, set.view_count()))
        }
        Err(error) => {
            findings.push(Finding::error(
                Area::Graph,
                subject,
                error.to_string(),
                NO_LAUNCH,
                format!("run `carff dataset check {}` for all errors, or render the dataset again", dataset.display()),
            ));
            None
        }
    }
}

/// Checks the parts of the checkpoint; each is read as the stages read it.
fn models(checkpoint: &Path, shown: Option<&ScenarioIdentity>, findings: &mut Vec<Finding>) {
    let bad = |error: &dyn Display, advice: &str| {
        Finding::error(Area::Graph, "checkpoint", error.to_string(), NO_LAUNCH, advice)
    };
    let manifest = match Manifest::load(checkpoint) {
        Ok(manifest) => manifest,
        Err(error) => {
            let advice = "train the scenario (carff train configs/training/NAME.toml), or pass --checkpoint";
            return findings.push(bad(&error, advice));
        }
    };
    let parts = [
        carff_inference::encoder_onnx(checkpoint, &manifest).map(drop).map_err(|e| e.to_string()),
        carff_inference::MixtureNet::load(checkpoint, &manifest).map(drop).map_err(|e| e.to_string()),
        carff_checkpoint::load_field(checkpoint, &manifest).map(drop).map_err(|e| e.to_string()),
        carff_checkpoint::load_probing(checkpoint, &manifest).map(drop).map_err(|e| e.to_string()),
        CheckpointPlanning::load(checkpoint).map(drop).map_err(|e| e.to_string()),
    ];
    let whole = parts.iter().all(Result::is_ok);
    let again = "train it again, or copy the folder again from a complete copy";
    findings.extend(parts.iter().filter_map(|part| part.as_ref().err()).map(|error| bad(error, again)));
    match shown.map(|shown| manifest.check_scenario(checkpoint, shown)) {
        Some(Err(error)) => findings.push(bad(
            &error,
            "use the dataset and scenario that the checkpoint was trained on, or another checkpoint",
        )),
        _ if whole => {
            let found = format!("{}, of {}", checkpoint.display(), manifest.scenario.name);
            findings.push(Finding::ok(Area::Graph, "checkpoint", found));
        }
        _ => {}
    }
}

#[cfg(test)]
mod tests {
    use super::super::finding::Level;
    use super::*;
    use std::path::PathBuf;

    fn root() -> PathBuf {
        Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap().to_owned()
    }

    fn shipped() -> (PathBuf, GraphConfig) {
        let path = root().join("configs/graphs/approaching-intersection.toml");
        let graph = GraphConfig::load(&path).unwrap();
        (path, graph)
    }

    fn errors(findings: &[Finding]) -> Vec<(&'static str, &str)> {
        findings.iter().filter(|f| f.level == Level::Error).map(|f| (f.subject, f.found.as_str())).collect()
    }

    /// The shipped graph with its checkpoint is ok, with or without a rendered dataset.
    #[test]
    fn the_shipped_graph_is_well() {
        let (path, graph) = shipped();
        let missing = root().join("nowhere/at-all");
        let findings = check(&path, &graph, Some(&missing), None);
        assert_eq!(errors(&findings), []);
        let set = findings.iter().find(|f| f.subject == "dataset").unwrap();
        assert!(set.found.contains("renders it"), "{set:?}");
        assert!(findings.iter().any(|f| f.subject == "checkpoint" && f.level == Level::Ok));
    }

    /// A dataset that cannot be rendered, a missing or damaged checkpoint, and a checkpoint of another scenario are
    /// errors, each with a remedy.
    #[test]
    fn what_is_wrong_is_said() {
        let (path, graph) = shipped();
        let mut without = graph.clone();
        without.run.scenario = None;
        let nowhere = root().join("nowhere");
        let findings =
            check(&path, &without, Some(&nowhere), Some(&root().join("configs/checkpoints/aproaching-intersection")));
        let found = errors(&findings);
        assert_eq!(found.iter().map(|(subject, _)| *subject).collect::<Vec<_>>(), ["dataset", "checkpoint"]);
        assert!(found[1].1.contains("did you mean") && found[1].1.contains("approaching-intersection"), "{found:?}");
        assert!(
            findings.iter().filter(|f| f.level == Level::Error).all(|f| !f.means.is_empty() && !f.advice.is_empty())
        );

        let folder = tempfile::tempdir().unwrap();
        for entry in std::fs::read_dir(graph.resolve(&graph.run.checkpoint)).unwrap().flatten() {
            std::fs::copy(entry.path(), folder.path().join(entry.file_name())).unwrap();
        }
        let damaged = std::fs::read(folder.path().join("mixture.safetensors")).unwrap();
        std::fs::write(folder.path().join("mixture.safetensors"), &damaged[..damaged.len() / 2]).unwrap();
        std::fs::remove_file(folder.path().join("planning.json")).unwrap();
        let mut other = graph.clone();
        other.run.scenario = Some("two-lane-merge".to_owned());
        let findings = check(&path, &other, Some(&nowhere), Some(folder.path()));
        let found = errors(&findings);
        assert_eq!(found.len(), 3, "{found:?}");
        assert!(found.iter().all(|(subject, _)| *subject == "checkpoint"), "{found:?}");
        assert!(found[1].1.contains("planning.json") && found[2].1.contains("scenario.name"), "{found:?}");
    }

    /// An unreadable scenario is an error if the graph renders it, else a warning; both suggest the nearest name.
    #[test]
    fn a_wrong_scenario_matters_where_it_is_rendered() {
        let (path, mut graph) = shipped();
        graph.run.scenario = Some("aproaching-intersection".to_owned());
        let folder = tempfile::tempdir().unwrap();
        for (dataset, level) in [(folder.path().join("none"), Level::Error), (folder.path().to_owned(), Level::Warning)]
        {
            let findings = check(&path, &graph, Some(&dataset), None);
            let finding = findings.iter().find(|f| f.subject == "scenario").unwrap();
            assert_eq!(finding.level, level, "{finding:?}");
            assert!(
                finding.found.contains("did you mean") && finding.found.contains("/approaching-inter"),
                "{finding:?}"
            );
        }
    }

    /// A wrong graph file is one error, with the line.
    #[test]
    fn a_wrong_file_is_one_error() {
        let error = GraphConfig::parse("[run]\nname = \"x\"\nhorizn = 2\n", Path::new("x.toml")).unwrap_err();
        let finding = wrong(&error);
        assert_eq!(finding.level, Level::Error);
        assert!(
            finding.found.starts_with("x.toml:3: ") && finding.found.ends_with("did you mean `horizon`?"),
            "{finding:?}"
        );
    }
}
