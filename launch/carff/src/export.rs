//! `carff export`: converts a recording to images, tables, a film or a trace.

#[cfg(feature = "film")]
use crate::film;
use crate::probe::image::named_image;
use crate::spans::{Span, trace_events};
use anyhow::Context;
use carff_recording::Reader;
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
    /// Write the camera's frames as a film (H.264). Each frame is shown from its capture until the next one.
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
    if let Some(folder) = png {
        println!("{}: {} images", folder.display(), pictures(path, folder)?);
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

fn make_folder(folder: &Path) -> anyhow::Result<()> {
    std::fs::create_dir_all(folder).with_context(|| format!("cannot create the folder {}", folder.display()))
}

fn pictures(recording: &Path, folder: &Path) -> anyhow::Result<u64> {
    make_folder(folder)?;
    let mut reader = Reader::open(recording)?;
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

/// Returns a sort key that orders `a.10` after `a.9`.
fn natural(column: &str) -> Vec<(bool, u64, String)> {
    column
        .split('.')
        .map(|part| part.parse().map_or((true, 0, part.to_owned()), |n| (false, n, String::new())))
        .collect()
}

fn tables(recording: &Path, folder: &Path) -> anyhow::Result<Vec<(PathBuf, u64)>> {
    make_folder(folder)?;
    let mut columns: BTreeMap<TopicId, BTreeSet<String>> = BTreeMap::new();
    let cells_of = |each: &mut dyn FnMut(TopicId, BTreeMap<String, String>) -> anyhow::Result<()>| {
        let mut reader = Reader::open(recording)?;
        while let Some(entry) = reader.next()? {
            let mut cells = BTreeMap::new();
            flatten("", &entry.message.as_message().to_json()?, &mut cells);
            each(entry.topic, cells)?;
        }
        Ok::<(), anyhow::Error>(())
    };
    cells_of(&mut |topic, cells| {
        columns.entry(topic).or_default().extend(cells.into_keys());
        Ok(())
    })?;
    let mut files = BTreeMap::new();
    for (topic, columns) in columns {
        let mut columns: Vec<String> = columns.into_iter().collect();
        columns.sort_by_key(|c| natural(c));
        let path = folder.join(format!("{}.csv", topic.name().replace('/', "-")));
        let mut file = csv::Writer::from_path(&path).with_context(|| format!("cannot write {}", path.display()))?;
        file.write_record(&columns)?;
        files.insert(topic, (path, columns, file, 0));
    }
    cells_of(&mut |topic, cells| {
        if let Some((path, columns, file, rows)) = files.get_mut(&topic) {
            let row = columns.iter().map(|c| cells.get(c).map_or("", String::as_str));
            file.write_record(row).with_context(|| format!("cannot write {}", path.display()))?;
            *rows += 1;
        }
        Ok(())
    })?;
    let mut written = Vec::new();
    for (path, _, mut file, rows) in files.into_values() {
        file.flush().with_context(|| format!("cannot write {}", path.display()))?;
        written.push((path, rows));
    }
    Ok(written)
}

fn spans(recording: &Path, file: &Path) -> anyhow::Result<usize> {
    let mut reader = Reader::open(recording)?;
    let mut spans = Vec::new();
    while let Some(entry) = reader.next()? {
        spans.extend(Span::of(entry.message.as_message()));
    }
    let trace = serde_json::to_string(&trace_events(&reader.about().run, &spans))?;
    std::fs::write(file, trace).with_context(|| format!("cannot write {}", file.display()))?;
    Ok(spans.len())
}

#[cfg(test)]
#[cfg(feature = "film")]
mod tests {
    use super::*;
    use carff_messages::forms::AnyMessage;
    use carff_messages::{FrameMeta, Gaussian, Header, Posterior};
    use carff_recording::{About, Writer};

    fn recording(path: &Path) {
        let mut writer = Writer::create(path, &About::default(), &[]).unwrap();
        for frame in 0..3_u64 {
            let at_ns = frame * 50_000_000;
            let header = Header { publish_time_ns: at_ns + 1, ..Header::of_frame(frame, at_ns, 1) };
            let mut meta = FrameMeta { header, width_px: 2, height_px: 1, ..FrameMeta::default() };
            (meta.intrinsics.fl_x_px, meta.intrinsics.fl_y_px) = (1.0, 1.0);
            writer.write(TopicId::FRAME, AnyMessage::new(&meta, &[frame as u8; 6])).unwrap();
            let posterior = Posterior { header, gaussian: Gaussian::standard(), stage_latency_ns: frame };
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
        assert_eq!(pictures(&path, &folder.path().join("png")).unwrap(), 3);
        let picture = image::open(folder.path().join("png/frame-000002.png")).unwrap().into_rgb8();
        assert_eq!((picture.dimensions(), picture.as_raw().as_slice()), ((2, 1), [2; 6].as_slice()));

        let tables = tables(&path, &folder.path().join("csv")).unwrap();
        assert_eq!(tables.len(), 2);
        let text = std::fs::read_to_string(folder.path().join("csv/encoder-posterior.csv")).unwrap();
        let head: Vec<&str> = text.lines().next().unwrap().split(',').collect();
        let column = head.iter().position(|&c| c == "stage_latency_ns").unwrap();
        assert_eq!(text.lines().nth(3).unwrap().split(',').nth(column), Some("2"));
        assert!(head.contains(&"gaussian.mean.7") && head.contains(&"header.frame_id"), "{head:?}");

        assert_eq!(film::export(&path, &folder.path().join("film.mp4")).unwrap(), 3);
        assert_eq!(spans(&path, &folder.path().join("trace.json")).unwrap(), 6);
        assert!((film::frame_rate_hz(&path).unwrap() - 20.0).abs() < 1e-9);

        let empty = folder.path().join("empty.mcap");
        Writer::create(&empty, &About::default(), &[]).unwrap().finish().unwrap();
        let error = film::export(&empty, &folder.path().join("none.mp4")).unwrap_err().to_string();
        assert!(error.contains("no camera frame") && !folder.path().join("none.mp4").exists(), "{error}");
    }

    /// Columns of lists are in numerical order.
    #[test]
    fn columns_are_in_natural_order() {
        let mut columns = ["a.10.x", "a.9.x", "b", "a.9.b"];
        columns.sort_by_key(|c| natural(c));
        assert_eq!(columns, ["a.9.b", "a.9.x", "a.10.x", "b"]);
    }
}
