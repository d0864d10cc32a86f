//! The camera stage of RTSP network cameras with H.264 video. `carff launch` starts it for `camera.source = "rtsp"`.
//!
//! Before the first image, an error ends the stage. Later, a lost camera makes the stage stale, and it connects again
//! until the camera is back.

use anyhow::{Context, anyhow, bail, ensure};
use carff_dataset::RawImage;
use carff_messages::Stage;
use carff_runtime::{FrameOutput, StageContext};
use carff_transport::{Woken, monotonic_now_ns};
use futures::{Future, StreamExt};
use openh264::decoder::Decoder;
use openh264::formats::YUVSource;
use retina::client::{Credentials, Demuxed, PlayOptions, Session, SessionOptions, SetupOptions};
use retina::codec::{CodecItem, FrameFormat};
use std::time::{Duration, Instant};
use tokio::runtime::Runtime;
use url::Url;

/// Interval of looking at requests to stop, and of the stage's progress.
const LOOK: Duration = Duration::from_millis(100);
/// Longest time for connecting, and without an image.
const PATIENCE: Duration = Duration::from_secs(5);
/// Pause before another attempt to connect.
const RETRY_NS: u64 = 1_000_000_000;

fn main() -> std::process::ExitCode {
    carff_runtime::main(Stage::Camera, run)
}

fn run(stage: &mut StageContext) -> anyhow::Result<()> {
    let url = stage.graph.camera.url.as_deref().context("`camera.url` is missing in the graph file")?;
    let (url, credentials) = address(url)?;
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    // A connection that is dropped takes leave of the camera in the background.
    let handle = runtime.handle().clone();
    let _context = handle.enter();
    let mut camera = Camera { runtime, url, credentials, output: FrameOutput::open(stage, None)?, is_ready: false };
    loop {
        match camera.watch(stage) {
            Ok(()) => return Ok(()),
            Err(error) if !camera.is_ready => return Err(error.context(format!("no images from {}", camera.url))),
            Err(error) => stage.stalled(&format!("no images from {}: {error:#}; connecting again", camera.url)),
        }
        if !stage.pause_until(monotonic_now_ns() + RETRY_NS)? {
            return Ok(());
        }
    }
}

/// Splits user and password from an address, so that no log line contains them.
fn address(text: &str) -> anyhow::Result<(Url, Option<Credentials>)> {
    let mut url = Url::parse(text).map_err(|e| anyhow!("`camera.url` is not an address ({e}): rtsp://HOST/PATH"))?;
    ensure!(url.scheme() == "rtsp", "`camera.url` begins with `{}://`; supported is `rtsp://`", url.scheme());
    let (username, password) = (url.username().to_owned(), url.password().unwrap_or_default().to_owned());
    let credentials = (!username.is_empty()).then_some(Credentials { username, password });
    // An address with a host can lose its user.
    let _ = (url.set_username(""), url.set_password(None));
    Ok((url, credentials))
}

struct Camera {
    runtime: Runtime,
    url: Url,
    credentials: Option<Credentials>,
    output: FrameOutput,
    is_ready: bool,
}

impl Camera {
    /// Connects, and publishes images until a stop is requested or the connection fails.
    fn watch(&mut self, stage: &mut StageContext) -> anyhow::Result<()> {
        let (url, credentials) = (self.url.clone(), self.credentials.clone());
        let connected = self.drive(stage, connect(url, credentials)).context("cannot connect")?;
        let Some(mut session) = connected else { return Ok(()) };
        let mut decoder = Decoder::new()?;
        let mut image = Vec::new();
        // Images may come faster than the stage looks at requests to stop.
        while !self.output.is_complete() && stage.wait_until(&[], 0)? != Woken::Stopped {
            let Some(item) = self.drive(stage, async { Ok(session.next().await) })? else { return Ok(()) };
            let item = item.context("the camera has closed the connection")??;
            let CodecItem::VideoFrame(frame) = item else { continue };
            let captured_ns = monotonic_now_ns();
            let yuv = match decoder.decode(frame.data()) {
                Ok(Some(yuv)) => yuv,
                Ok(None) => continue,
                Err(error) => {
                    stage.refuse(&anyhow!("an image of {} is damaged: {error}", self.url));
                    continue;
                }
            };
            let (width, height) = yuv.dimensions();
            image.resize(width * height * 3, 0);
            yuv.write_rgb8(&mut image);
            let raw = RawImage::rgb([width as u32, height as u32], &image)?;
            if !self.is_ready {
                self.output.check(&raw)?;
                self.is_ready = true;
                stage.ready();
            }
            self.output.publish(stage, &raw, captured_ns)?;
        }
        Ok(())
    }

    /// Waits for a result. Returns `None` when the stage must end.
    fn drive<T>(
        &self,
        stage: &mut StageContext,
        wanted: impl Future<Output = anyhow::Result<T>>,
    ) -> anyhow::Result<Option<T>> {
        let mut wanted = std::pin::pin!(wanted);
        let begun = Instant::now();
        loop {
            let step = async { tokio::time::timeout(LOOK, &mut wanted).await };
            if let Ok(result) = self.runtime.block_on(step) {
                return result.map(Some);
            }
            if stage.wait_until(&[], 0)? == Woken::Stopped {
                return Ok(None);
            }
            if begun.elapsed() > PATIENCE {
                bail!("nothing has come for {} s", PATIENCE.as_secs());
            }
        }
    }
}

async fn connect(url: Url, credentials: Option<Credentials>) -> anyhow::Result<Demuxed> {
    let mut session = Session::describe(url, SessionOptions::default().creds(credentials)).await?;
    let streams = session.streams();
    let wanted = |stream: &retina::client::Stream| stream.media() == "video" && stream.encoding_name() == "h264";
    let Some(stream) = streams.iter().position(wanted) else {
        let found = streams.iter().map(|s| format!("{} {}", s.media(), s.encoding_name())).collect::<Vec<_>>();
        bail!("it has no H.264 video, only [{}]: set the camera to H.264", found.join(", "));
    };
    session.setup(stream, SetupOptions::default().frame_format(FrameFormat::SIMPLE)).await?;
    Ok(session.play(PlayOptions::default()).await?.demuxed()?)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// User and password leave the address; other schemes and no addresses are refused.
    #[test]
    fn addresses_hide_their_password() {
        let (url, credentials) = address("rtsp://ann:secret@10.0.0.7:8554/stream").unwrap();
        assert_eq!(url.as_str(), "rtsp://10.0.0.7:8554/stream");
        assert_eq!(credentials.map(|c| (c.username, c.password)), Some(("ann".to_owned(), "secret".to_owned())));
        assert!(address("rtsp://10.0.0.7/stream").unwrap().1.is_none());
        for wrong in ["http://10.0.0.7/", "10.0.0.7", ""] {
            assert!(address(wrong).unwrap_err().to_string().contains("camera.url"), "{wrong}");
        }
    }
}
