//! The memory over the frames of a run.

use carff_checkpoint::FieldProbe;
use carff_decision::{
    ImageEvidence, Memory, MemorySettings, ProbeLayout, Remembered, StepLength, TakeFrame, TakeMemory,
};
use carff_inference::MixtureNet;
use carff_messages::Gaussian;
use std::collections::BTreeMap;

/// An image of a run, with its place in its take.
#[derive(Clone, Debug, PartialEq)]
pub struct TakenImage {
    /// Frame, with the take that it belongs to.
    pub frame: TakeFrame,
    /// Posterior of the encoder.
    pub posterior: Gaussian,
    /// Evidence of the image, if it was compared with the known states.
    pub image: Option<ImageEvidence>,
}

/// The memory at each frame of a run.
pub struct RunMemory {
    settings: MemorySettings,
    frames: BTreeMap<u64, Remembered>,
}

impl RunMemory {
    /// Remembers the images of a run, in the order of their frames.
    pub fn new(
        net: &MixtureNet,
        probe: &FieldProbe,
        settings: MemorySettings,
        step: StepLength,
        images: &[TakenImage],
    ) -> Self {
        let memory = Memory::new(probe.layout(), probe.states().to_vec(), |state| net.forecast(state), settings);
        let mut memory = TakeMemory::new(memory, step);
        let see = |taken: &TakenImage| {
            let remembered = memory.see(taken.frame, &net.forecast(&taken.posterior));
            if let Some(image) = &taken.image {
                memory.compare(taken.frame.frame, image.places());
            }
            (taken.frame.frame, remembered)
        };
        Self { settings, frames: images.iter().map(see).collect() }
    }

    /// Returns what the memory holds at a frame; `None` if the frame has no posterior.
    pub fn of(&self, frame: u64) -> Option<&Remembered> {
        self.frames.get(&frame)
    }

    /// Returns the evidence of a frame's own image for the belief with this memory.
    pub fn weighed(&self, image: ImageEvidence, frame: &Remembered, layout: &ProbeLayout) -> ImageEvidence {
        image.with_memory(frame.states.clone(), layout, &self.settings)
    }
}
