//! The comparison of camera images with the known states.

use carff_checkpoint::{CheckpointPlanning, FieldProbe};
use carff_decision::{ImageEvidence, MemorySettings, Place, ProbeLayout, RememberedStates};
use carff_field::Field;
use carff_messages::{Forecast, FrameMeta, Header, LATENT_DIM, MAX_PLACES, MAX_STATES, Unknowns};
use carff_unknown::{Comparer, Known, Lanes, PlaceViews, Seen, Sighting};
use ndarray::ArrayView3;
use std::collections::VecDeque;
use std::path::Path;

/// Number of frames whose comparison is remembered: later steps of a frame's forecast use it too.
const REMEMBERED: usize = 16;

/// Compares images with the known states, and remembers the comparisons of the last frames.
#[derive(Debug)]
pub struct Images {
    known: Known,
    comparer: Comparer,
    states: Vec<[f32; LATENT_DIM]>,
    /// The newest last.
    compared: VecDeque<Compared>,
    /// The clear lanes of the image compared last, with its capture time; `None` for another place.
    sighting: Option<(u64, Sighting)>,
    /// Evidence while no image of a take has been compared.
    nothing_yet: ImageEvidence,
    /// For a belief with a memory: its learned numbers, and the places that each image is searched for.
    memory: Option<(MemorySettings, PlaceViews)>,
}

/// A compared frame.
#[derive(Debug)]
struct Compared {
    /// Capture time: monotonic clock, nanoseconds.
    at_ns: u64,
    /// Number of the frame.
    frame_id: u64,
    /// Number of the first frame of its take.
    take_start: u64,
    /// `None` for a frame without a valid pose.
    evidence: Option<ImageEvidence>,
}

impl Images {
    /// Loads the limits of the known; `None` where the checkpoint has none. With `remembers`, earlier images of a take
    /// count where the checkpoint has learned a memory.
    pub fn load(checkpoint: &Path, probe: &FieldProbe, remembers: bool) -> anyhow::Result<Option<Self>> {
        let Some(known) = Known::load(checkpoint)? else { return Ok(None) };
        let learned = if remembers { CheckpointPlanning::load(checkpoint)?.memory } else { None };
        let places = probe.layout().places().iter();
        let boxes = places.map(|place| (place.oriented_box, place.occupied_in.as_slice()));
        Ok(Some(Self {
            comparer: Comparer::new(probe.field(), &known.lanes),
            states: probe.states().iter().map(|state| state.mean).collect(),
            compared: VecDeque::with_capacity(REMEMBERED),
            sighting: None,
            nothing_yet: ImageEvidence::unexplained(probe.layout().state_count()),
            memory: learned.map(|learned| (learned.settings, PlaceViews::new(boxes, &known.lanes.own))),
            known,
        }))
    }

    /// Compares a frame with the known states. `None` without a valid pose.
    pub fn compare(
        &mut self,
        probe: &FieldProbe,
        frame: &FrameMeta,
        image: ArrayView3<'_, u8>,
        threads: usize,
    ) -> Option<Unknowns> {
        let mut unknowns = self.unknowns(probe, frame, image, threads);
        let evidence = unknowns.as_mut().map(|unknowns| {
            let evidence = ImageEvidence::from(&*unknowns);
            unknowns.probability = evidence.unknown_probability() as f32;
            evidence
        });
        if self.compared.len() == REMEMBERED {
            self.compared.pop_front();
        }
        let Header { capture_time_ns: at_ns, frame_id, .. } = frame.header;
        self.compared.push_back(Compared { at_ns, frame_id, take_start: frame.take_start, evidence });
        unknowns
    }

    fn unknowns(
        &mut self,
        probe: &FieldProbe,
        frame: &FrameMeta,
        image: ArrayView3<'_, u8>,
        threads: usize,
    ) -> Option<Unknowns> {
        let camera = frame.camera();
        camera.validate().ok()?;
        let view = (&camera, image);
        self.sighting = None;
        let (seen, comparison) = self.known.see(&mut self.comparer, probe.field(), &self.states, view, threads)?;
        let sighting = self.known.sighting(&self.comparer, &comparison, &seen);
        self.sighting = sighting.map(|sighting| (frame.header.capture_time_ns, sighting));
        let mut unknowns = Unknowns::of_frame(frame.header);
        (unknowns.noise, unknowns.explained) = (comparison.fit.noise, comparison.fit.explained);
        (unknowns.gain, unknowns.offset) = (comparison.fit.gain(), comparison.fit.offset);
        describe(&seen, probe.layout().places(), &mut unknowns);
        if let Some((_, places)) = &mut self.memory {
            let field = self.comparer.without_own(probe.field());
            let shown = places.look(field, &self.states, view, (&seen, &comparison), threads);
            unknowns.place_count = shown.len().min(MAX_PLACES) as u32;
            unknowns.places.iter_mut().zip(shown).for_each(|(place, shown)| *place = shown);
        }
        Some(unknowns)
    }

    /// The field that renders the states without the vehicle itself.
    pub fn without_own<'a>(&'a self, probe: &'a FieldProbe) -> &'a Field {
        self.comparer.without_own(probe.field())
    }

    /// The ground on which something counts.
    pub fn lanes(&self) -> &Lanes {
        &self.known.lanes
    }

    /// The clear lanes of a frame, if it is the one compared last.
    pub fn sighting(&self, header: &Header) -> Option<&Sighting> {
        self.sighting.as_ref().filter(|(at_ns, _)| *at_ns == header.capture_time_ns).map(|(_, sighting)| sighting)
    }

    /// The evidence of a forecast's frame; `None` also for a frame without a valid pose.
    pub fn evidence(&self, forecast: &Forecast, layout: &ProbeLayout) -> Option<ImageEvidence> {
        let at_ns = forecast.header.capture_time_ns;
        let evidence = self.compared.iter().rev().find(|compared| compared.at_ns == at_ns)?.evidence.clone()?;
        Some(self.with_memory(evidence, forecast, layout))
    }

    /// The evidence of the frame of a take that was compared last before a forecast's frame; `None` if it has no valid
    /// pose. Without a comparison in the take, or after a pause, something unknown is nearly certain.
    pub fn evidence_before(&self, forecast: &Forecast, take_start: u64, layout: &ProbeLayout) -> Option<ImageEvidence> {
        let frame_id = forecast.header.frame_id;
        let counts = |compared: &&Compared| {
            compared.take_start == take_start && ImageEvidence::counts_later(compared.frame_id, frame_id)
        };
        let before = self.compared.iter().rev().find(counts);
        let evidence = before.map_or_else(|| Some(self.nothing_yet.clone()), |compared| compared.evidence.clone());
        // The memory has counted the places of earlier images.
        evidence.map(|evidence| self.with_memory(evidence.with_places(&[]), forecast, layout))
    }

    /// Evidence for the belief of a forecast: with what the forecaster's memory holds, if there is one.
    fn with_memory(&self, evidence: ImageEvidence, forecast: &Forecast, layout: &ProbeLayout) -> ImageEvidence {
        let Some((settings, _)) = &self.memory else { return evidence };
        let weights = forecast.state_weights().to_vec();
        let remembered = RememberedStates { weights, hazard_by_places: forecast.hazard_by_places };
        evidence.with_memory(remembered, layout, settings)
    }
}

/// Writes residual, ratios and boxes.
fn describe(seen: &Seen, places: &[Place], unknowns: &mut Unknowns) {
    unknowns.residual = seen.residual;
    unknowns.state_count = seen.ratios.len().min(MAX_STATES) as u32;
    for (to, from) in unknowns.ratios.iter_mut().zip(&seen.ratios) {
        *to = *from;
    }
    unknowns.box_count = seen.boxes.len() as u64;
    for (to, from) in unknowns.boxes.iter_mut().zip(&seen.boxes) {
        let is_inside = |place: &Place| {
            let [x, y, _] = from.center;
            place.oriented_box.contains([x, y, place.oriented_box.center[2]])
        };
        *to = *from;
        to.place = places.iter().position(is_inside).map_or(-1, |place| place as i32);
    }
}
