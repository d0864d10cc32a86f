//! The comparison of camera images with the known states.

use carff_checkpoint::FieldProbe;
use carff_config::{ChecksConfig, CompareWhen};
use carff_decision::{ImageEvidence, Place};
use carff_messages::{FrameMeta, Header, LATENT_DIM, MAX_STATES, Unknowns};
use carff_unknown::{Comparer, Known, Seen};
use ndarray::ArrayView3;
use std::path::Path;

/// Largest difference of the capture times of a belief's frame and the compared one, nanoseconds.
const LATEST_NS: u64 = 300_000_000;

/// Compares images with the known states, and remembers the last comparison.
#[derive(Debug)]
pub struct Images {
    known: Known,
    comparer: Comparer,
    states: Vec<[f32; LATENT_DIM]>,
    when: CompareWhen,
    period_ns: u64,
    next_ns: u64,
    last: Option<(Header, ImageEvidence)>,
}

impl Images {
    /// Loads the limits of the known; `None` where the graph switches the comparison off, or the checkpoint has none.
    pub fn load(checkpoint: &Path, checks: &ChecksConfig, probe: &FieldProbe) -> anyhow::Result<Option<Self>> {
        if checks.compare == CompareWhen::Off {
            return Ok(None);
        }
        Ok(Known::load(checkpoint)?.map(|known| Self {
            known,
            comparer: Comparer::default(),
            states: probe.states().iter().map(|state| state.mean).collect(),
            when: checks.compare,
            period_ns: (1e9 / checks.compare_rate_hz) as u64,
            next_ns: 0,
            last: None,
        }))
    }

    /// Reports whether the belief of an image waits for its comparison.
    pub fn goes_first(&self) -> bool {
        self.when == CompareWhen::SameFrame
    }

    /// Reports whether a frame of this capture time is compared. With `same-frame` every frame is; with `next-frame`,
    /// rates above the limit leave frames out.
    pub fn is_due(&mut self, capture_time_ns: u64) -> bool {
        let is_due = self.goes_first() || capture_time_ns >= self.next_ns;
        if is_due {
            // A tenth of a period is jitter.
            self.next_ns = capture_time_ns + self.period_ns - self.period_ns / 10;
        }
        is_due
    }

    /// Compares a frame with the known states. `None` without a valid pose, or where the camera sees no lane.
    pub fn compare(
        &mut self,
        probe: &FieldProbe,
        frame: &FrameMeta,
        image: ArrayView3<'_, u8>,
        threads: usize,
    ) -> Option<Unknowns> {
        let camera = frame.camera();
        camera.validate().ok()?;
        let view = (&camera, image);
        let (seen, comparison) = self.known.see(&mut self.comparer, probe.field(), &self.states, view, threads)?;
        // Rounded as in the message: every reader of the message computes the same belief.
        let ratios: Vec<f64> = seen.ratios.iter().map(|&ratio| f64::from(ratio as f32)).collect();
        let evidence = ImageEvidence::new(&ratios);
        let mut unknowns = Unknowns::of_frame(frame.header);
        unknowns.probability = evidence.unknown_probability(probe.layout().hazard_states()) as f32;
        unknowns.noise = comparison.fit.noise;
        (unknowns.gain, unknowns.offset) = (comparison.fit.gain, comparison.fit.offset);
        describe(&seen, probe.layout().places(), &mut unknowns);
        self.last = Some((frame.header, evidence));
        Some(unknowns)
    }

    /// The evidence for a belief's frame: of its own image; with `next-frame`, also of an earlier one that is not too
    /// old.
    pub fn evidence(&self, header: &Header) -> Option<&ImageEvidence> {
        let (compared, evidence) = self.last.as_ref()?;
        let age_ns = header.capture_time_ns.checked_sub(compared.capture_time_ns)?;
        let latest_ns = if self.goes_first() { 0 } else { LATEST_NS };
        (age_ns <= latest_ns).then_some(evidence)
    }
}

/// Writes residual, ratios and boxes.
fn describe(seen: &Seen, places: &[Place], unknowns: &mut Unknowns) {
    unknowns.residual = seen.residual;
    unknowns.state_count = seen.ratios.len().min(MAX_STATES) as u32;
    for (to, from) in unknowns.ratios.iter_mut().zip(&seen.ratios) {
        *to = *from as f32;
    }
    unknowns.box_count = seen.boxes.len() as u32;
    for (to, from) in unknowns.boxes.iter_mut().zip(&seen.boxes) {
        let is_inside = |place: &Place| {
            let [x, y, _] = from.center;
            place.oriented_box.contains([x, y, place.oriented_box.center[2]])
        };
        *to = *from;
        to.place = places.iter().position(is_inside).map_or(-1, |place| place as i32);
    }
}
