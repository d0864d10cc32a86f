//! The camera stage of GStreamer pipelines. `carff launch` starts it for `camera.source = "pipeline"`.
//!
//! Before the first image, an error ends the stage. Later, a lost device makes the stage stale, and the pipeline starts
//! again until the device is back.

use anyhow::{Context, anyhow, bail};
use carff_dataset::{PixelFormat, RawImage};
use carff_messages::Stage;
use carff_runtime::{FrameOutput, StageContext};
use carff_transport::{Woken, monotonic_now_ns};
use gstreamer as gst;
use gstreamer::prelude::*;
use gstreamer_app::AppSink;
use gstreamer_video::{VideoCapsBuilder, VideoFormat, VideoFrameExt, VideoFrameRef, VideoInfo};
use std::time::{Duration, Instant};

/// Interval of looking at requests to stop, at messages, and of the stage's progress.
const LOOK: gst::ClockTime = gst::ClockTime::from_mseconds(50);
/// Longest time until the first image.
const START: Duration = Duration::from_secs(10);
/// Longest time without an image, before the pipeline starts again.
const PATIENCE: Duration = Duration::from_secs(5);
/// Pause before the pipeline starts again.
const RETRY_NS: u64 = 1_000_000_000;

fn main() -> std::process::ExitCode {
    carff_runtime::main(Stage::Camera, run)
}

/// Reason why a pipeline delivers no more images.
enum Ended {
    /// The stage must end, or has all the frames that it was to have.
    Stopped,
    /// The stream is over.
    EndOfStream,
}

fn run(stage: &mut StageContext) -> anyhow::Result<()> {
    gst::init().context("GStreamer cannot start: install it as the README of services/camera-gst states")?;
    let text = stage.graph.camera.pipeline.clone().context(
        "`camera.pipeline` is missing in the graph file: set it, for example to `v4l2src ! videoconvert ! appsink`",
    )?;
    let mut output = FrameOutput::open(stage, None)?;
    let mut is_ready = false;
    loop {
        let pipeline = Pipeline::new(&text)?;
        let is_live = pipeline.is_live;
        match pipeline.watch(stage, &mut output, &mut is_ready) {
            Ok(Ended::Stopped) => return Ok(()),
            Ok(Ended::EndOfStream) if !is_ready => {
                bail!("`camera.pipeline` ended before its first image: check its source")
            }
            Ok(Ended::EndOfStream) if stage.graph.camera.repeat => continue,
            Ok(Ended::EndOfStream) if !is_live => {
                stage.wait_until(&[], monotonic_now_ns() + stage.graph.camera.linger_ms * 1_000_000)?;
                return Ok(());
            }
            Ok(Ended::EndOfStream) => stage.stalled("the stream of the pipeline has ended; starting it again"),
            Err(error) if !is_ready => return Err(error),
            Err(error) => stage.stalled(&format!("{error:#}; starting the pipeline again")),
        }
        drop(pipeline);
        if !stage.pause_until(monotonic_now_ns() + RETRY_NS)? {
            return Ok(());
        }
    }
}

/// Returns the error of a buffer that lacks a part.
fn lacking(part: &str) -> String {
    format!("`camera.pipeline` delivered a buffer without {part}: put `videoconvert` before the appsink")
}

/// A playing pipeline. Dropping it stops it.
struct Pipeline {
    pipeline: gst::Pipeline,
    sink: AppSink,
    bus: gst::Bus,
    is_live: bool,
}

impl Pipeline {
    /// Builds the pipeline and starts it. Its sink keeps only the newest image.
    fn new(text: &str) -> anyhow::Result<Self> {
        let built = gst::parse::launch(text)
            .map_err(|e| anyhow!("`camera.pipeline` is wrong: {}; try it with gst-launch-1.0", e.message()))?;
        let pipeline = built
            .downcast::<gst::Pipeline>()
            .map_err(|_| anyhow!("`camera.pipeline` has only one element: end it with `! videoconvert ! appsink`"))?;
        let sinks = pipeline.iterate_sinks().into_iter().filter_map(Result::ok);
        let sink = sinks
            .filter_map(|sink| sink.downcast::<AppSink>().ok())
            .next()
            .context("`camera.pipeline` has no appsink: end it with `! videoconvert ! appsink`")?;
        sink.set_caps(Some(&VideoCapsBuilder::new().format(VideoFormat::Rgb).build()));
        sink.set_max_buffers(1);
        sink.set_drop(true);
        // The system's clock is the monotonic one, which all headers use.
        pipeline.use_clock(Some(&gst::SystemClock::obtain()));
        let bus = pipeline.bus().context("`camera.pipeline` has no bus: install GStreamer again")?;
        let mut started = Self { pipeline, sink, bus, is_live: false };
        match started.pipeline.set_state(gst::State::Playing) {
            // Live images are taken when they come; those of a file at their time.
            Ok(gst::StateChangeSuccess::NoPreroll) => {
                started.is_live = true;
                started.sink.set_property("sync", false);
            }
            Ok(_) => {}
            Err(_) => {
                return Err(started
                    .error()
                    .unwrap_or_else(|| anyhow!("`camera.pipeline` does not start: try it with gst-launch-1.0")));
            }
        }
        Ok(started)
    }

    /// Publishes images until the end.
    fn watch(&self, stage: &mut StageContext, output: &mut FrameOutput, is_ready: &mut bool) -> anyhow::Result<Ended> {
        let mut newest = Instant::now();
        while !output.is_complete() {
            if let Some(sample) = self.sink.try_pull_sample(LOOK) {
                newest = Instant::now();
                self.publish(&sample, stage, output, is_ready)?;
            }
            if stage.wait_until(&[], 0)? == Woken::Stopped {
                return Ok(Ended::Stopped);
            }
            if let Some(error) = self.error() {
                return Err(error);
            }
            if self.sink.is_eos() {
                return Ok(Ended::EndOfStream);
            }
            let patience = if *is_ready { PATIENCE } else { START };
            if newest.elapsed() > patience {
                bail!(
                    "no image from `camera.pipeline` for {} s: check that its source is connected and delivers",
                    patience.as_secs()
                );
            }
        }
        Ok(Ended::Stopped)
    }

    fn publish(
        &self,
        sample: &gst::Sample,
        stage: &mut StageContext,
        output: &mut FrameOutput,
        is_ready: &mut bool,
    ) -> anyhow::Result<()> {
        let captured_ns = self.capture_time_ns(sample);
        let buffer = sample.buffer().with_context(|| lacking("an image"))?;
        let info = VideoInfo::from_caps(sample.caps().with_context(|| lacking("a format"))?)?;
        let frame =
            VideoFrameRef::from_buffer_ref_readable(buffer, &info).with_context(|| lacking("readable pixels"))?;
        let step = usize::try_from(frame.plane_stride()[0]).with_context(|| lacking("rows from the top"))?;
        let data = frame.plane_data(0).with_context(|| lacking("pixels"))?;
        let raw = RawImage::new([frame.width(), frame.height()], step, PixelFormat::Rgb8, data)?;
        if !*is_ready {
            output.check(&raw)?;
            *is_ready = true;
            stage.ready();
        }
        output.publish(stage, &raw, captured_ns)
    }

    /// Returns the capture time: the buffer's running time on the monotonic clock; without one, the time of arrival.
    fn capture_time_ns(&self, sample: &gst::Sample) -> u64 {
        let now_ns = monotonic_now_ns();
        let running = || {
            let segment = sample.segment()?.downcast_ref::<gst::ClockTime>()?;
            segment.to_running_time(sample.buffer()?.pts()?)
        };
        let captured = running().zip(self.pipeline.base_time()).map(|(running, base)| (base + running).nseconds());
        captured.unwrap_or(now_ns).min(now_ns)
    }

    /// Returns the first error on the bus.
    fn error(&self) -> Option<anyhow::Error> {
        let message = self.bus.pop_filtered(&[gst::MessageType::Error])?;
        let gst::MessageView::Error(error) = message.view() else { return None };
        let source = error.src().map(|source| source.name().to_string()).unwrap_or_default();
        let cause = error.error().message().to_owned();
        let advice = if cause.contains("data stream error") || cause.contains("negotiat") {
            "; the formats of two elements may not fit: put `videoconvert` before the appsink"
        } else {
            ""
        };
        Some(anyhow!("the element `{source}` of `camera.pipeline` failed: {cause}{advice}"))
    }
}

impl Drop for Pipeline {
    fn drop(&mut self) {
        // A pipeline that does not stop ends with the process.
        let _ = self.pipeline.set_state(gst::State::Null);
    }
}
