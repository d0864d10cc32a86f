//! The camera's frames, each compared with the known states before its belief, or before the next frame's.

use crate::Images;
use anyhow::Context;
use carff_base::geometry::PinholeCamera;
use carff_checkpoint::FieldProbe;
use carff_config::CompareImages;
use carff_decision::{ImageEvidence, ProbeLayout};
use carff_field::Field;
use carff_messages::{Belief, Forecast, FrameMeta, Header, UnknownBox, Unknowns};
use carff_runtime::StageContext;
use carff_transport::{ImagePayload, Input, Publisher, Receiver, Sample, monotonic_now_ns, topics};
use carff_unknown::{Lanes, Sighting};
use std::collections::VecDeque;

/// Number of frames that are remembered: later steps of a frame's forecast may follow those of newer frames.
const REMEMBERED: usize = 16;

/// Compares the frames of the camera, in order, and publishes the comparisons.
///
/// Frames wait in the topic's buffer. A forecast skips the frames before its own: at rates that the prober cannot keep
/// up with, only frames with a forecast are compared. With `checks.compare = "same-frame"`, the oldest frame is compared
/// while encoder and forecaster work on it, and its belief rests on it. With `"next-frame"`, it is compared after its
/// last belief, and the beliefs about the next frame of the take rest on it. So each belief rests on the same comparison
/// at any rate.
#[derive(Debug)]
pub struct Frames {
    images: Images,
    input: Receiver<ImagePayload<FrameMeta>>,
    output: Publisher<Unknowns>,
    /// True if a belief rests on the comparison of the frame before.
    is_late: bool,
    /// The frame that is compared after its last belief.
    pending: Option<Sample<ImagePayload<FrameMeta>>>,
    /// The last frames, the newest last.
    taken: VecDeque<Taken>,
    /// Boxes of something unknown in the last comparison.
    boxes: Vec<UnknownBox>,
}

/// A frame that was taken from the topic.
#[derive(Debug)]
struct Taken {
    /// Capture time: monotonic clock, nanoseconds.
    at_ns: u64,
    /// Number of the first frame of its take.
    take_start: u64,
    /// `None` for a pose that is not valid.
    camera: Option<PinholeCamera>,
}

impl Frames {
    /// Opens the topics; `None` where the graph switches the comparison off, or the checkpoint has no limits of the
    /// known. An idle publisher would keep its connections to receivers that have died.
    pub fn open(stage: &StageContext, probe: &FieldProbe) -> anyhow::Result<Option<Self>> {
        let compare = stage.graph.checks.compare;
        if compare == CompareImages::Off {
            return Ok(None);
        }
        let Some(images) = Images::load(&stage.checkpoint, probe, stage.graph.remembers())? else { return Ok(None) };
        let (input, output) = (stage.input(&topics::FRAME)?, stage.output(&topics::UNKNOWN)?);
        let is_late = compare == CompareImages::NextFrame;
        Ok(Some(Self { images, input, output, is_late, pending: None, taken: VecDeque::new(), boxes: Vec::new() }))
    }

    /// The input to wait for; `None` while a frame waits for its belief.
    pub fn input(&self) -> Option<&dyn Input> {
        self.pending.is_none().then_some(&self.input)
    }

    /// Takes the frame of a forecast, unless it has been taken; without a forecast, the next frame. Compares it if its
    /// own belief rests on it.
    pub fn take(&mut self, probe: &FieldProbe, forecast: Option<&Header>, threads: usize) -> anyhow::Result<()> {
        if forecast.is_some_and(|header| self.of(header).is_some()) {
            return Ok(());
        }
        if forecast.is_none() && self.pending.is_some() {
            return Ok(());
        }
        while let Some(frame) = self.input.next()? {
            if forecast.is_some_and(|header| frame.header.capture_time_ns < header.capture_time_ns) {
                continue;
            }
            let camera = frame.camera();
            let camera = camera.validate().is_ok().then_some(camera);
            if self.taken.len() == REMEMBERED {
                self.taken.pop_front();
            }
            self.taken.push_back(Taken { at_ns: frame.header.capture_time_ns, take_start: frame.take_start, camera });
            self.pending = None;
            if self.is_late {
                self.pending = Some(frame);
            } else {
                self.compare(probe, &frame, threads)?;
            }
            break;
        }
        Ok(())
    }

    /// Compares the frame that waits for its belief, after its last one.
    pub fn after(&mut self, probe: &FieldProbe, belief: &Belief, threads: usize) -> anyhow::Result<()> {
        let is_last = |frame: &mut Sample<ImagePayload<FrameMeta>>| {
            belief.is_final() && frame.header.capture_time_ns == belief.header.capture_time_ns
        };
        self.pending.take_if(is_last).map_or(Ok(()), |frame| self.compare(probe, &frame, threads))
    }

    fn compare(
        &mut self,
        probe: &FieldProbe,
        frame: &Sample<ImagePayload<FrameMeta>>,
        threads: usize,
    ) -> anyhow::Result<()> {
        let started_ns = monotonic_now_ns();
        self.boxes.clear();
        if let Some(mut unknowns) = self.images.compare(probe, frame, frame.image(), threads) {
            self.boxes.extend_from_slice(unknowns.boxes());
            unknowns.stage_latency_ns = monotonic_now_ns() - started_ns;
            self.output.send(unknowns)?;
        }
        Ok(())
    }

    /// The camera of a frame, if its pose is valid.
    pub fn camera_of(&self, header: &Header) -> Option<PinholeCamera> {
        self.of(header)?.camera
    }

    /// The boxes of something unknown that a frame's belief rests on, if the frame was the last one.
    pub fn unknown_boxes(&self, header: &Header) -> &[UnknownBox] {
        let last = self.taken.back().filter(|taken| taken.at_ns == header.capture_time_ns);
        last.map_or(&[], |_| &self.boxes)
    }

    fn of(&self, header: &Header) -> Option<&Taken> {
        self.taken.iter().rev().find(|taken| taken.at_ns == header.capture_time_ns)
    }

    /// The clear lanes of a frame, if it is the one compared last.
    pub fn sighting(&self, header: &Header) -> Option<&Sighting> {
        self.images.sighting(header)
    }

    /// The field that renders the states without the vehicle itself.
    pub fn without_own<'a>(&'a self, probe: &'a FieldProbe) -> &'a Field {
        self.images.without_own(probe)
    }

    /// The ground on which something counts.
    pub fn lanes(&self) -> &Lanes {
        self.images.lanes()
    }

    /// The evidence that a forecast's belief rests on; `None` if the compared frame has no valid pose.
    ///
    /// # Errors
    ///
    /// The frame has not been taken: it did not arrive, or was overwritten by newer ones.
    pub fn evidence(&self, forecast: &Forecast, layout: &ProbeLayout) -> anyhow::Result<Option<ImageEvidence>> {
        let taken = self.of(&forecast.header).with_context(|| {
            format!(
                "a forecast without its frame on `{}`: its image cannot be compared; set `checks.compare = \"off\"` \
                 for forecasts of another source",
                topics::FRAME.name
            )
        })?;
        Ok(if self.is_late {
            self.images.evidence_before(forecast, taken.take_start, layout)
        } else {
            self.images.evidence(forecast, layout)
        })
    }
}
