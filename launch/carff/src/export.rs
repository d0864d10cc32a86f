//! `carff export`: converts a recording to images, tables, a film or a trace.

#[cfg(feature = "film")]
use crate::film;
use crate::probe::image::named_image;
use crate::spans::{recorded_spans, trace_events};
use anyhow::{Context, ensure};
use carff_base::files::{check_distinct, check_writable};
use carff_checkpoint::Manifest;
use carff_recording::{Entry, Reader, RecordingAbout};
use carff_transport::TopicId;
use clap::Args;
use serde_json::Value;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

/// Export a recording.
#[derive(Clone, Debug, Args)]
#[group(required = true, multiple = true)]
pub struct Outputs {
    /// Write camera frames and rendered views as PNG files into this folder.
    #[arg(long, value_name = "DIR")]
    pub png: Option<PathBuf>,
    /// Write a CSV file per topic into this folder, with a column per field.
    #[arg(long, value_name = "DIR")]
    pub csv: Option<PathBuf>,
    /// Write the camera's frames as a film (H.264), each with its decision, its belief and the latest rendered hypothesis
    /// from above. A frame is shown from its capture until the next one.
    #[arg(long, value_name = "FILE")]
    pub mp4: Option<PathBuf>,
    /// Write the times of all stages and frames in the trace event format, for ui.perfetto.dev.
    #[arg(long, value_name = "FILE")]
    pub trace: Option<PathBuf>,
}

/// Export a recording.
#[derive(Clone, Debug, Args)]
pub struct ExportArgs {
    /// Recording to export.
    pub recording: PathBuf,
    /// Outputs to write.
    #[command(flatten)]
    pub outputs: Outputs,
}

/// Runs the command.
pub fn run(args: &ExportArgs) -> anyhow::Result<ExitCode> {
    let Outputs { png, csv, mp4, trace } = &args.outputs;
    let path = &args.recording;
    let files = || mp4.iter().chain(trace).map(PathBuf::as_path);
    check_distinct([path.as_path()], files())?;
    files().try_for_each(check_writable)?;
    if let Some(folder) = png {
        println!("{}: {} images", folder.display(), images(path, folder)?);
    }
    if let Some(folder) = csv {
        for (file, rows) in tables(path, folder)? {
            println!("{}: {rows} rows", file.display());
        }
    }
    if let Some(file) = mp4 {
        #[cfg(feature = "film")]
        println!("{}: {} frames", file.display(), film::export(path, file)?);
        #[cfg(not(feature = "film"))]
        anyhow::bail!("{}: films are not part of this build, which `make run` made: run `make build`", file.display());
    }
    if let Some(file) = trace {
        println!("{}: {} spans; open it at ui.perfetto.dev or chrome://tracing", file.display(), spans(path, file)?);
    }
    Ok(ExitCode::SUCCESS)
}

/// Notes on standard error that a recording is incomplete.
fn note_cut_off(reader: &Reader, recording: &Path) {
    if reader.is_cut_off() {
        crate::say(&format!("warning: {} is cut off; the messages before its end are exported", recording.display()));
    }
}

fn make_folder(folder: &Path) -> anyhow::Result<()> {
    std::fs::create_dir_all(folder).with_context(|| format!("cannot create the folder {}", folder.display()))
}

fn images(recording: &Path, folder: &Path) -> anyhow::Result<u64> {
    make_folder(folder)?;
    let mut reader = Reader::open(recording)?;
    note_cut_off(&reader, recording);
    let mut topics = vec![TopicId::FRAME, TopicId::VIEW];
    // One of the two is enough.
    if topics.iter().any(|topic| reader.has(*topic)) {
        topics.retain(|topic| reader.has(*topic));
    }
    reader.select(topics)?;
    let mut count = 0;
    while let Some(entry) = reader.next()? {
        let message = entry.message.as_message();
        let Some((name, [width_px, height_px])) = named_image(message) else { continue };
        let path = folder.join(format!("{name}.png"));
        image::save_buffer(&path, message.bytes(), width_px, height_px, image::ColorType::Rgb8)
            .with_context(|| format!("cannot write {}", path.display()))?;
        count += 1;
    }
    Ok(count)
}

/// Flattens a JSON value into cells, each named by its path.
fn flatten(path: &str, value: &Value, cells: &mut BTreeMap<String, String>) {
    let below = |key: &str| if path.is_empty() { key.to_owned() } else { format!("{path}.{key}") };
    match value {
        Value::Object(map) => map.iter().for_each(|(key, value)| flatten(&below(key), value, cells)),
        Value::Array(list) => {
            list.iter().enumerate().for_each(|(i, value)| flatten(&below(&i.to_string()), value, cells));
        }
        Value::Null => drop(cells.insert(path.to_owned(), String::new())),
        Value::String(text) => drop(cells.insert(path.to_owned(), text.clone())),
        value => drop(cells.insert(path.to_owned(), value.to_string())),
    }
}

/// Columns with wall-clock times, which come first.
const WALL_TIMES: [&str; 2] = ["capture_time_iso8601", "publish_time_iso8601"];

/// Returns a sort key: wall-clock times, the message's header, the rest; `a.10` after `a.9`.
fn natural(column: &str) -> (usize, Vec<(bool, u64, String)>) {
    let wall_time = WALL_TIMES.iter().position(|name| *name == column);
    let rank = wall_time.unwrap_or(WALL_TIMES.len() + usize::from(!column.starts_with("header.")));
    let parts = column.split('.');
    (rank, parts.map(|part| part.parse().map_or((true, 0, part.to_owned()), |n| (false, n, String::new()))).collect())
}

fn iso8601(wall_ns: u64) -> String {
    jiff::Timestamp::from_nanosecond(wall_ns.into()).map_or_else(|_| wall_ns.to_string(), |at| format!("{at:.9}"))
}

/// Returns the cells of a message by the name of their column.
fn cells_of(entry: &Entry) -> anyhow::Result<BTreeMap<String, String>> {
    let mut cells = BTreeMap::new();
    let message = entry.message.as_message();
    flatten("", &message.to_json()?, &mut cells);
    let header = message.header();
    let age_ns = header.publish_time_ns.saturating_sub(header.capture_time_ns);
    let times_ns = [entry.wall_time_ns.saturating_sub(age_ns), entry.wall_time_ns];
    cells.extend(WALL_TIMES.iter().zip(times_ns).map(|(name, at_ns)| ((*name).to_owned(), iso8601(at_ns))));
    Ok(cells)
}

/// Names of states, for tables.
struct States(Vec<String>);

impl States {
    /// Takes the names from the recording, or from its checkpoint; states of neither have a number.
    fn of(about: Option<&RecordingAbout>) -> Self {
        let stored = about.map(|about| about.states.clone()).filter(|states| !states.is_empty());
        let trained = || Manifest::load(Path::new(&about?.checkpoint)).ok().map(|m| m.scenario.state_names());
        // Many readers of tables do not know quoted commas.
        Self(stored.or_else(trained).unwrap_or_default().iter().map(|name| name.replace(',', "")).collect())
    }

    fn name(&self, state: &str) -> String {
        let named = |index: usize| self.0.get(index).cloned().unwrap_or_else(|| format!("state {index}"));
        state.parse().map_or(state.to_owned(), named)
    }

    fn branch(&self, index: &str) -> String {
        let mut branches: Vec<&str> = self.0.iter().filter_map(|name| Some(name.rsplit_once(" t")?.0)).collect();
        branches.dedup();
        index.parse().ok().and_then(|index: usize| branches.get(index)).map_or(index, |name| name).to_owned()
    }

    fn column(&self, column: &str) -> String {
        let state = column.strip_prefix("state_probability.");
        state.map_or(column.to_owned(), |state| format!("state_probability.{}", self.name(state)))
    }

    fn cell(&self, column: &str, cell: &str) -> String {
        match column.rsplit('.').next() {
            Some("state" | "resolved_state") => self.name(cell),
            Some("branch") => self.branch(cell),
            _ => cell.to_owned(),
        }
    }
}

fn tables(recording: &Path, folder: &Path) -> anyhow::Result<Vec<(PathBuf, u64)>> {
    make_folder(folder)?;
    let mut reader = Reader::open(recording)?.without_images();
    note_cut_off(&reader, recording);
    let states = States::of(reader.about());
    let mut columns: BTreeMap<TopicId, BTreeSet<String>> = BTreeMap::new();
    while let Some(entry) = reader.next()? {
        columns.entry(entry.topic).or_default().extend(cells_of(&entry)?.into_keys());
    }
    ensure!(!columns.is_empty(), "{} contains no messages", recording.display());
    let mut files = BTreeMap::new();
    for (topic, columns) in columns {
        let mut columns: Vec<String> = columns.into_iter().collect();
        columns.sort_by_key(|c| natural(c));
        let path = folder.join(format!("{}.csv", topic.name().replace('/', "-")));
        let mut file = csv::Writer::from_path(&path).with_context(|| format!("cannot write {}", path.display()))?;
        file.write_record(columns.iter().map(|column| states.column(column)))?;
        files.insert(topic, (path, columns, file, 0));
    }
    let mut reader = Reader::open(recording)?.without_images();
    while let Some(entry) = reader.next()? {
        if let Some((path, columns, file, rows)) = files.get_mut(&entry.topic) {
            let cells = cells_of(&entry)?;
            let row = columns.iter().map(|c| cells.get(c).map_or(String::new(), |cell| states.cell(c, cell)));
            file.write_record(row).with_context(|| format!("cannot write {}", path.display()))?;
            *rows += 1;
        }
    }
    let mut written = Vec::new();
    for (path, _, mut file, rows) in files.into_values() {
        file.flush().with_context(|| format!("cannot write {}", path.display()))?;
        written.push((path, rows));
    }
    Ok(written)
}

fn spans(recording: &Path, file: &Path) -> anyhow::Result<usize> {
    let (run, spans) = recorded_spans(recording)?;
    let trace = serde_json::to_string(&trace_events(&run, &spans))?;
    std::fs::write(file, trace).with_context(|| format!("cannot write {}", file.display()))?;
    Ok(spans.len())
}

#[cfg(test)]
#[cfg(feature = "film")]
mod tests {
    use super::*;
    use carff_messages::forms::AnyMessage;
    use carff_messages::{Belief, DatasetView, FrameMeta, Gaussian, Header, Posterior, ProbeResult};
    use carff_recording::Writer;

    fn recording(path: &Path) {
        let mut writer = Writer::create(path, &RecordingAbout::default(), &[]).unwrap();
        for frame in 0..3_u64 {
            let at_ns = frame * 50_000_000;
            let header = Header { publish_time_ns: at_ns + 1, ..Header::of_frame(frame, at_ns, 1) };
            let mut meta = FrameMeta { header, width_px: 2, height_px: 1, ..FrameMeta::default() };
            (meta.intrinsics.fl_x_px, meta.intrinsics.fl_y_px) = (1.0, 1.0);
            writer.write(TopicId::FRAME, AnyMessage::new(&meta, &[frame as u8; 6])).unwrap();
            let posterior =
                Posterior { header, gaussian: Gaussian::standard(), take_start: 0, stage_latency_ns: frame };
            writer.write(TopicId::POSTERIOR, AnyMessage::new(&posterior, &[])).unwrap();
        }
        writer.finish().unwrap();
    }

    /// Images have their bytes, tables a row per message and a column per field, films every frame, and traces a span
    /// per message. Without frames there is no film.
    #[test]
    fn recordings_become_files() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("r.mcap");
        recording(&path);
        assert_eq!(images(&path, &folder.path().join("png")).unwrap(), 3);
        let image = image::open(folder.path().join("png/frame-000002.png")).unwrap().into_rgb8();
        assert_eq!((image.dimensions(), image.as_raw().as_slice()), ((2, 1), [2; 6].as_slice()));

        let tables = tables(&path, &folder.path().join("csv")).unwrap();
        assert_eq!(tables.len(), 2);
        let text = std::fs::read_to_string(folder.path().join("csv/encoder-posterior.csv")).unwrap();
        let head: Vec<&str> = text.lines().next().unwrap().split(',').collect();
        assert_eq!(head[..3], ["capture_time_iso8601", "publish_time_iso8601", "header.capture_time_ns"], "{head:?}");
        assert!(
            head.iter().rposition(|c| c.starts_with("header.")) < head.iter().position(|&c| c == "gaussian.mean.0")
        );
        let column = head.iter().position(|&c| c == "stage_latency_ns").unwrap();
        assert_eq!(text.lines().nth(3).unwrap().split(',').nth(column), Some("2"));
        assert!(head.contains(&"gaussian.mean.7") && head.contains(&"header.frame_id"), "{head:?}");

        assert_eq!(film::export(&path, &folder.path().join("film.mp4")).unwrap(), 3);
        assert_eq!(spans(&path, &folder.path().join("trace.json")).unwrap(), 6);
        assert!((film::frame_rate_hz(&path).unwrap() - 20.0).abs() < 1e-9);

        // The recording is not overwritten by what it is exported to.
        let outputs = Outputs { png: None, csv: None, mp4: None, trace: Some(folder.path().join("./r.mcap")) };
        let error = run(&ExportArgs { recording: path.clone(), outputs }).unwrap_err().to_string();
        assert!(error.contains("r.mcap would overwrite"), "{error}");
        assert_eq!(spans(&path, &folder.path().join("trace.json")).unwrap(), 6);

        let empty = folder.path().join("empty.mcap");
        Writer::create(&empty, &RecordingAbout::default(), &[]).unwrap().finish().unwrap();
        let error = film::export(&empty, &folder.path().join("none.mp4")).unwrap_err().to_string();
        assert!(error.contains("no camera frame") && !folder.path().join("none.mp4").exists(), "{error}");
        let error = super::tables(&empty, folder.path()).unwrap_err().to_string();
        assert!(error.ends_with("empty.mcap contains no messages"), "{error}");
    }

    /// Columns of lists are in numerical order.
    #[test]
    fn columns_are_in_natural_order() {
        let mut columns = ["a.10.x", "a.9.x", "b", "a.9.b"];
        columns.sort_by_key(|c| natural(c));
        assert_eq!(columns, ["a.9.b", "a.9.x", "a.10.x", "b"]);
    }

    /// Tables name the states, and their times are wall-clock times; there is one header line.
    #[test]
    fn tables_name_states_and_times() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("r.mcap");
        let states = ["no actor, t0", "no actor, t1", "truck, t0", "truck, t1"].map(str::to_owned).to_vec();
        let about = RecordingAbout { states, wall_offset_ns: 1_700_000_000_000_000_000, ..RecordingAbout::default() };
        let mut writer = Writer::create(&path, &about, &[]).unwrap();
        for frame in 0..2_u64 {
            let header = Header { publish_time_ns: 250_000_000, ..Header::of_frame(frame, 50_000_000, 1) };
            let dataset_view = DatasetView { known: 1, branch: 1, timestamp: 0, ..DatasetView::UNKNOWN };
            let mut meta = FrameMeta { header, width_px: 1, height_px: 1, dataset_view, ..FrameMeta::default() };
            (meta.intrinsics.fl_x_px, meta.intrinsics.fl_y_px) = (1.0, 1.0);
            writer.write(TopicId::FRAME, AnyMessage::new(&meta, &[0; 3])).unwrap();
            let mut belief = Belief::empty(header.at_step(1), 1);
            (belief.state_count, belief.place_count, belief.component_count, belief.sample_count) = (4, 1, 1, 2);
            (belief.component_weights[0], belief.state_probability[3], belief.resolved_state) = (1.0, 0.5, 3);
            belief.samples[0] = ProbeResult { state: 2, ..ProbeResult::NONE };
            writer.write(TopicId::BELIEF, AnyMessage::new(&belief, &[])).unwrap();
        }
        writer.finish().unwrap();
        super::tables(&path, folder.path()).unwrap();
        let rows = |name: &str| -> Vec<Vec<String>> {
            let text = std::fs::read_to_string(folder.path().join(name)).unwrap();
            text.lines().map(|line| line.split(',').map(str::to_owned).collect()).collect()
        };
        let beliefs = rows("prober-belief.csv");
        assert_eq!(beliefs.len(), 3);
        for row in &beliefs[1..] {
            let cell = |column: &str| row[beliefs[0].iter().position(|c| c == column).expect(column)].as_str();
            assert_eq!(cell("capture_time_iso8601"), "2023-11-14T22:13:20.050000000Z");
            assert_eq!(cell("publish_time_iso8601"), "2023-11-14T22:13:20.250000000Z");
            assert_eq!(
                (cell("resolved_state"), cell("samples.0.state"), cell("samples.1.state")),
                ("truck t1", "truck t0", "")
            );
            assert_eq!((cell("state_probability.truck t1"), cell("state_probability.no actor t0")), ("0.5", "0.0"));
        }
        let frames = rows("camera-frame.csv");
        let branch = frames[0].iter().position(|c| c == "dataset_view.branch").unwrap();
        assert_eq!(frames[1][branch], "truck");
    }
}
