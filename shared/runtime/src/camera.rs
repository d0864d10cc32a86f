//! The output of a real camera's stage: images are rectified straight into the memory that the encoder reads.

use crate::{StageContext, frame_span};
use anyhow::{Context, ensure};
use carff_base::geometry::PinholeCamera;
use carff_config::Pose;
use carff_dataset::{CameraCalibration, Dataset, RawImage, Rectifier};
use carff_messages::{DatasetView, EgoPose, FrameMeta, Header, ImageMeta, MAX_IMAGE_BYTES, rgb_bytes};
use carff_transport::{ImagePayload, Publisher, Receiver, monotonic_now_ns, topics};

/// Longest side of a thinned image before rectification, pixels, and its most bytes.
const RAW_SIDE_PX: u32 = 640;
const RAW_BYTES: usize = rgb_bytes(RAW_SIDE_PX, RAW_SIDE_PX);
const IDENTITY: Pose = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]];

/// Publishes the images of a real camera as frames.
///
/// ```no_run
/// use carff_dataset::{PixelFormat, RawImage};
/// use carff_messages::Stage;
/// use carff_runtime::FrameOutput;
/// use carff_transport::monotonic_now_ns;
///
/// fn main() -> std::process::ExitCode {
///     carff_runtime::main(Stage::Camera, |stage| {
///         let mut output = FrameOutput::open(stage, None)?;
///         stage.ready();
///         let mut next_ns = monotonic_now_ns();
///         while !output.is_complete() && stage.pause_until(next_ns)? {
///             // Here the driver of the camera delivers an image: 640 x 480 pixels, RGB.
///             let bytes = vec![128; 640 * 480 * 3];
///             let image = RawImage::new([640, 480], 640 * 3, PixelFormat::Rgb8, &bytes)?;
///             output.publish(stage, &image, monotonic_now_ns())?;
///             next_ns += 100_000_000;
///         }
///         Ok(())
///     })
/// }
/// ```
#[derive(Debug)]
pub struct FrameOutput {
    /// Opened at the size of the first image; a larger image opens it again.
    publisher: Option<(usize, Publisher<ImagePayload<FrameMeta>>)>,
    /// Publishes thinned images before rectification, where they are asked for.
    raw: Option<Publisher<ImagePayload<FrameMeta>>>,
    rectifier: Option<Rectifier>,
    world_from_camera: Pose,
    /// The camera's pose on the vehicle, and the vehicle's poses.
    ego: Option<(Pose, Receiver<EgoPose>)>,
    frame_id: u64,
    /// Number of the first frame since the last cut.
    take_start: u64,
    limit: u64,
}

impl FrameOutput {
    /// Prepares the output of a source that has recorded a calibration or none.
    ///
    /// # Errors
    ///
    /// As [`rectifier`].
    pub fn open(stage: &StageContext, recorded: Option<CameraCalibration>) -> anyhow::Result<Self> {
        let camera = &stage.graph.camera;
        let rectifier = rectifier(stage, recorded)?;
        if rectifier.is_none() {
            tracing::warn!(
                "no `camera.calibration`: images are used unchanged, so that the camera must have the field of view of \
                 the training"
            );
        }
        let ego = match camera.vehicle_from_camera {
            Some(pose) => Some((pose, stage.input(&topics::EGO_POSE)?.polled())),
            None => None,
        };
        Ok(Self {
            publisher: None,
            raw: stage.args.raw.then(|| stage.image_output(&topics::RAW, RAW_BYTES)).transpose()?,
            rectifier,
            world_from_camera: camera.world_from_camera.or(camera.vehicle_from_camera).unwrap_or(IDENTITY),
            ego,
            frame_id: stage.args.first_frame,
            take_start: stage.args.first_frame,
            limit: stage.args.frames.unwrap_or(u64::MAX),
        })
    }

    /// Returns true if the stage has published all the frames that it was to publish.
    pub fn is_complete(&self) -> bool {
        self.frame_id >= self.limit
    }

    /// Returns the number of the next frame.
    pub fn next_frame(&self) -> u64 {
        self.frame_id
    }

    /// Starts a new take: the next frame does not follow the last one, for example because a recording starts again.
    pub fn cut(&mut self) {
        self.take_start = self.frame_id;
    }

    /// Checks that an image can become a frame: its size is that of the calibration, or small enough to be published.
    pub fn check(&self, raw: &RawImage<'_>) -> anyhow::Result<()> {
        if let Some(rectifier) = &self.rectifier {
            return Ok(rectifier.check(raw)?);
        }
        let [width_px, height_px] = raw.size_px();
        ensure!(
            rgb_bytes(width_px, height_px) <= MAX_IMAGE_BYTES,
            "an image of {width_px}x{height_px} pixels is too large for a frame: set `camera.calibration`, which scales it"
        );
        Ok(())
    }

    /// Publishes an image that was captured at a time on the monotonic clock. An image that cannot become a frame is
    /// counted and logged; the stage continues.
    ///
    /// # Errors
    ///
    /// If the transport fails.
    pub fn publish(
        &mut self,
        stage: &mut StageContext,
        raw: &RawImage<'_>,
        capture_time_ns: u64,
    ) -> anyhow::Result<()> {
        let started_ns = monotonic_now_ns();
        self.publish_raw(stage, raw, capture_time_ns)?;
        if let Err(error) = self.check(raw) {
            stage.refuse(&error);
            return Ok(());
        }
        // Without a new pose the vehicle is where it was; at first it is at the origin.
        if let Some((vehicle_from_camera, poses)) = &mut self.ego
            && let Some(ego) = poses.newest()?
        {
            self.world_from_camera = ego.world_from_camera(vehicle_from_camera);
        }
        let mut meta = FrameMeta::of_camera(&self.camera(raw), DatasetView::UNKNOWN);
        meta.header = Header::of_frame(self.frame_id, capture_time_ns, stage.seed());
        meta.take_start = self.take_start;
        let _span = frame_span(&meta.header);
        let bytes = meta.image_bytes();
        if self.publisher.as_ref().is_some_and(|(max_bytes, _)| *max_bytes < bytes) {
            self.publisher = None;
        }
        let (_, publisher) = match &mut self.publisher {
            Some(open) => open,
            None => self.publisher.insert((bytes, stage.image_output(&topics::FRAME, bytes)?)),
        };
        let mut loan = publisher.loan(bytes)?;
        match &self.rectifier {
            Some(rectifier) => rectifier.write(raw, loan.bytes_mut())?,
            None => raw.write_rgb(loan.bytes_mut()),
        }
        publisher.send_image(loan, meta)?;
        stage.worked(&meta.header, started_ns);
        self.frame_id += 1;
        Ok(())
    }

    /// Publishes every nth pixel of an image, where it is asked for.
    fn publish_raw(&mut self, stage: &StageContext, raw: &RawImage<'_>, capture_time_ns: u64) -> anyhow::Result<()> {
        let Some(publisher) = &mut self.raw else { return Ok(()) };
        let [width_px, height_px] = raw.size_px();
        let step = width_px.max(height_px).div_ceil(RAW_SIDE_PX);
        let [width_px, height_px] = [width_px / step, height_px / step].map(|side| side.max(1));
        let camera = assumed_camera(width_px, height_px);
        let mut meta = FrameMeta::of_camera(&camera, DatasetView::UNKNOWN);
        meta.header = Header::of_frame(self.frame_id, capture_time_ns, stage.seed());
        let mut loan = publisher.loan(meta.image_bytes())?;
        for (i, pixel) in loan.bytes_mut().chunks_exact_mut(3).enumerate() {
            let (x, y) = (i % width_px as usize, i / width_px as usize);
            let inside = |at: usize, side: u32| (at * step as usize).min(side as usize - 1);
            let [width_px, height_px] = raw.size_px();
            pixel.copy_from_slice(&raw.pixel(inside(x, width_px), inside(y, height_px)));
        }
        Ok(publisher.send_image(loan, meta)?)
    }

    fn camera(&self, raw: &RawImage<'_>) -> PinholeCamera {
        let [width_px, height_px] = raw.size_px();
        let camera = match &self.rectifier {
            Some(rectifier) => *rectifier.camera(),
            None => assumed_camera(width_px, height_px),
        };
        PinholeCamera { world_from_camera: self.world_from_camera, ..camera }
    }
}

fn assumed_camera(width_px: u32, height_px: u32) -> PinholeCamera {
    let [eye, ahead, up] = [[0.0; 3], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]];
    PinholeCamera::look_at(eye, ahead, up, width_px, height_px, PinholeCamera::ASSUMED_FOV_DEG)
}

/// Computes the map of a calibrated camera to the field of view of the dataset: of the graph file's calibration, or
/// else of the one that the source has recorded.
///
/// # Errors
///
/// If the calibration or the dataset cannot be read, or the lens does not show the trained field of view.
pub fn rectifier(stage: &StageContext, recorded: Option<CameraCalibration>) -> anyhow::Result<Option<Rectifier>> {
    let Some(calibration) = stage.graph.calibration()?.or(recorded) else { return Ok(None) };
    Ok(Some(Rectifier::new(&calibration, &trained_camera(stage)?)?))
}

/// Returns the camera whose field of view and image size the models were trained for.
fn trained_camera(stage: &StageContext) -> anyhow::Result<PinholeCamera> {
    let dataset = Dataset::open(&stage.dataset).context(
        "a calibration needs the dataset that the checkpoint was trained on, which has the trained field of view",
    )?;
    dataset.usual_camera().with_context(|| format!("{} has no frames", stage.dataset.display()))
}
