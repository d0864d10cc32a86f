//! The camera's frames, each compared with the known states before its belief.

use crate::Images;
use carff_base::geometry::PinholeCamera;
use carff_checkpoint::FieldProbe;
use carff_decision::ImageEvidence;
use carff_messages::{FrameMeta, Header, UnknownBox, Unknowns};
use carff_runtime::StageContext;
use carff_transport::{Image, Input, Publisher, Receiver, monotonic_now_ns, topics};
use carff_unknown::Lanes;

/// Compares the frames of the camera, in order, and publishes the comparisons.
///
/// Frames wait in the topic's buffer. Without a forecast the oldest is compared, while encoder and forecaster work on
/// it. A forecast skips the frames before its own: at rates that the prober cannot keep up with, only frames with a
/// forecast are compared. So each belief rests on the comparison of its own image at any rate.
#[derive(Debug)]
pub struct Frames {
    images: Images,
    input: Receiver<Image<FrameMeta>>,
    output: Publisher<Unknowns>,
    /// The last frame: capture time, camera, and boxes of something unknown.
    last: Option<(u64, PinholeCamera, Vec<UnknownBox>)>,
}

impl Frames {
    /// Opens the topics; `None` where the graph switches the comparison off, or the checkpoint has no limits of the
    /// known. An idle publisher would keep its connections to receivers that have died.
    pub fn open(stage: &StageContext, probe: &FieldProbe) -> anyhow::Result<Option<Self>> {
        if !stage.graph.checks.compare {
            return Ok(None);
        }
        let Some(images) = Images::load(&stage.checkpoint, probe, stage.graph.remembers())? else { return Ok(None) };
        let (input, output) = (stage.input(&topics::FRAME)?, stage.output(&topics::UNKNOWN)?);
        Ok(Some(Self { images, input, output, last: None }))
    }

    /// The input to wait for.
    pub fn input(&self) -> &dyn Input {
        &self.input
    }

    /// Compares the frame of a forecast, unless it has been compared; without a forecast, the next frame.
    pub fn compare(&mut self, probe: &FieldProbe, forecast: Option<&Header>, threads: usize) -> anyhow::Result<()> {
        if forecast.is_some_and(|header| self.images.has_compared(header)) {
            return Ok(());
        }
        while let Some(frame) = self.input.next()? {
            if forecast.is_some_and(|header| frame.header.capture_time_ns < header.capture_time_ns) {
                continue;
            }
            let started_ns = monotonic_now_ns();
            let camera = frame.camera();
            self.last = camera.validate().is_ok().then_some((frame.header.capture_time_ns, camera, Vec::new()));
            if let Some(mut unknowns) = self.images.compare(probe, &frame, frame.image(), threads) {
                if let Some((_, _, boxes)) = &mut self.last {
                    boxes.extend_from_slice(unknowns.boxes());
                }
                unknowns.stage_latency_ns = monotonic_now_ns() - started_ns;
                self.output.send(unknowns)?;
            }
            break;
        }
        Ok(())
    }

    /// The camera of a frame, if it was the last one, with a valid pose.
    pub fn camera_of(&self, header: &Header) -> Option<PinholeCamera> {
        self.last_of(header).map(|(_, camera, _)| *camera)
    }

    /// The boxes of something unknown in a frame, if it was the last one.
    pub fn unknown_boxes(&self, header: &Header) -> &[UnknownBox] {
        self.last_of(header).map_or(&[], |(_, _, boxes)| boxes)
    }

    fn last_of(&self, header: &Header) -> Option<&(u64, PinholeCamera, Vec<UnknownBox>)> {
        self.last.as_ref().filter(|(at_ns, ..)| *at_ns == header.capture_time_ns)
    }

    /// The ground on which something counts.
    pub fn lanes(&self) -> &Lanes {
        self.images.lanes()
    }

    /// The evidence of a forecast's frame, if it shows something to compare.
    ///
    /// # Errors
    ///
    /// The frame has not been compared: it did not arrive, or was overwritten by newer ones.
    pub fn evidence(&self, forecast: &Header) -> anyhow::Result<Option<&ImageEvidence>> {
        anyhow::ensure!(
            self.images.has_compared(forecast),
            "a forecast without its frame on `{}`: its image cannot be compared; set `checks.compare = false` for \
             forecasts of another source",
            topics::FRAME.name
        );
        Ok(self.images.evidence(forecast))
    }
}
