//! The camera stage: takes images from a [`source::Source`] at a fixed rate, or from a recording, and publishes them.
//! The encoder interprets the images.

use anyhow::{Context, bail};
use carff_camera::{DriveSource, FolderSource, FreeDriveSource, Source};
use carff_config::CameraSource;
use carff_messages::{Header, ImageMeta, Stage};
use carff_runtime::{StageContext, frame_span};
use carff_transport::{Woken, monotonic_now_ns, topics};

fn main() -> std::process::ExitCode {
    carff_runtime::main(Stage::Camera, run)
}

fn run(stage: &mut StageContext) -> anyhow::Result<()> {
    match stage.graph.camera.source {
        #[cfg(feature = "recordings")]
        CameraSource::Mcap => {
            let mut source = carff_camera::McapSource::open(&file(stage)?, &stage.graph)?;
            carff_camera::recorded::run(stage, &mut source)
        }
        #[cfg(feature = "video")]
        CameraSource::Video => {
            let mut source = carff_camera::VideoSource::open(&file(stage)?)?;
            carff_camera::recorded::run(stage, &mut source)
        }
        _ => run_drives(stage),
    }
}

#[cfg(any(feature = "recordings", feature = "video"))]
fn file(stage: &StageContext) -> anyhow::Result<std::path::PathBuf> {
    let file = stage.graph.camera.file.as_ref().context("`camera.file` is missing in the graph file")?;
    Ok(stage.graph.resolve(file))
}

fn run_drives(stage: &mut StageContext) -> anyhow::Result<()> {
    let mut source = open_source(stage)?;
    let mut frames = stage.image_output(&topics::FRAME, source.max_image_bytes())?;
    let period_ns = (1e9 / stage.graph.run.frame_rate_hz) as u64;
    let limit = stage.args.frames.unwrap_or(u64::MAX);
    // A camera that is restarted during a run continues after the last frame of its predecessor.
    let mut frame_id = 0;
    while frame_id < stage.args.first_frame && source.advance()?.is_some() {
        frame_id += 1;
    }
    stage.ready();

    let mut next_ns = monotonic_now_ns();
    while frame_id < limit && stage.wait_until(&[], next_ns)? != Woken::Stopped {
        let Some(mut meta) = source.advance()? else { break };
        let capture_time_ns = monotonic_now_ns();
        meta.header = Header::of_frame(frame_id, capture_time_ns, stage.seed());
        let _span = frame_span(&meta.header);
        let mut loan = frames.loan(meta.image_bytes())?;
        source.write(frame_id, loan.bytes_mut())?;
        frames.send_image(loan, meta)?;
        stage.worked(&meta.header, capture_time_ns);
        frame_id += 1;
        // A late frame delays later ones; the camera does not catch up with a burst.
        next_ns = (next_ns + period_ns).max(monotonic_now_ns());
    }
    // The last frames are still in progress, and their views may still be rendered.
    stage.wait_until(&[], monotonic_now_ns() + stage.graph.camera.linger_ms * 1_000_000)?;
    tracing::info!(frames = frame_id, "done");
    Ok(())
}

fn open_source(stage: &mut StageContext) -> anyhow::Result<Box<dyn Source>> {
    match stage.graph.camera.source {
        CameraSource::Drives => {
            let drives = stage.args.drives.unwrap_or(stage.graph.camera.drives);
            Ok(Box::new(DriveSource::open(&stage.dataset, &stage.checkpoint, &stage.graph, drives)?))
        }
        CameraSource::FreeDrives => {
            let drives = stage.args.drives.unwrap_or(stage.graph.camera.drives);
            Ok(Box::new(FreeDriveSource::open(&stage.graph, drives)?))
        }
        CameraSource::Folder => {
            let folder = match &stage.graph.camera.folder {
                Some(folder) => stage.graph.resolve(folder),
                None => stage.dataset.join("images"),
            };
            let (source, unreadable) = FolderSource::open(&folder, &stage.graph)
                .with_context(|| format!("no images from {}", folder.display()))?;
            for error in &unreadable {
                stage.error(error);
            }
            Ok(match carff_runtime::rectifier(stage, None)? {
                Some(rectifier) => Box::new(source.rectified(&rectifier)?),
                None => Box::new(source),
            })
        }
        source @ (CameraSource::Mcap | CameraSource::Video) => {
            bail!("this build of carff-camera has no source {source:?}: build it with `make build`")
        }
        source => bail!("carff-camera has no source {source:?}: `carff launch` starts its program"),
    }
}
