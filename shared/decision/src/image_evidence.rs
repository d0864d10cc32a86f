//! Evidence of an image for the known states, in addition to the encoder: they are rendered and compared with it.

use crate::calibration::most_probable;
use crate::{MemorySettings, ProbeLayout, RememberedStates, Resolved};
use carff_messages::Unknowns;

/// Prior probability of something that no known state explains.
const UNKNOWN_PRIOR: f64 = 0.02;
/// Share of the belief that trusts the encoder's path; the rest starts from equally probable states. The encoder can
/// be wrong with certainty, for example in rain. Rendering the states shows what this image can distinguish at all.
const ENCODER_SHARE: f64 = 0.5;
/// Smallest weight of a state: a belief without the states of one side still weighs its states.
const LEAST_WEIGHT: f64 = 1e-9;
/// Likelihood ratios are limited to this and its inverse, so that no image decides against everything else.
const MAX_RATIO: f64 = 1e4;
/// Largest ratio of a state against something unknown: that of a state whose residuals are at their limit. Below the limit,
/// the state explains the image; how far below depends on the field's errors more than on the scene.
const EXPLAINED: f64 = 1.0;

/// For each known state, how much better it explains an image than something unknown does.
///
/// ```
/// use carff_decision::ImageEvidence;
/// // The image fits state 1 well, and state 0 badly.
/// let evidence = ImageEvidence::new(&[1e-3, 100.0]);
/// // The encoder sees the hazard of state 1 with 0.2: the image supports it.
/// let (hazard, unknown) = evidence.weigh(0.2, &[false, true]);
/// assert!(hazard > 0.9 && unknown < 0.1);
/// ```
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ImageEvidence {
    ratios: Vec<f64>,
    /// Value of each place in the image: -1 for free, 1 for taken, 0 for nothing. Empty if no place was looked at.
    places: Vec<f64>,
    /// Content of the memory before the image; `None` for equally probable states.
    remembered: Option<RememberedStates>,
}

/// Most frames between an image and a later one whose belief may rest on its comparison: longer without a comparison, for
/// example while the camera was covered, anything can have come.
const MOST_FRAMES_BEFORE: u64 = 5;

impl ImageEvidence {
    /// Reports whether the comparison of an image of the same take may count for the belief about frame `frame_id`.
    pub fn counts_later(compared_frame_id: u64, frame_id: u64) -> bool {
        compared_frame_id < frame_id && frame_id - compared_frame_id <= MOST_FRAMES_BEFORE
    }

    /// Evidence of the likelihood ratios of the known states against something unknown, each above 0. A ratio above 1 counts
    /// as 1: the state explains the image. A ratio that is not a number counts as the smallest.
    pub fn new(ratios: &[f32]) -> Self {
        let limited = |ratio: &f32| {
            if ratio.is_nan() { 1.0 / MAX_RATIO } else { f64::from(*ratio).clamp(1.0 / MAX_RATIO, EXPLAINED) }
        };
        Self { ratios: ratios.iter().map(limited).collect(), ..Self::default() }
    }

    /// Returns the same evidence with what the image shows of each place, -1 (free) to 1 (taken). A value that is not a
    /// number shows nothing.
    #[must_use]
    pub fn with_places(self, places: &[f32]) -> Self {
        let shown = |place: &f32| if place.is_nan() { 0.0 } else { f64::from(*place) };
        Self { places: places.iter().map(shown).collect(), ..self }
    }

    /// Returns what the image shows of each place: -1 for free, 1 for taken, 0 for nothing.
    pub fn places(&self) -> &[f64] {
        &self.places
    }

    /// Returns the same evidence for a belief with a memory: `remembered` is what it holds before this image's comparison.
    /// The places count too, with the strength of `settings`. Without weights, nothing changes.
    #[must_use]
    pub fn with_memory(
        mut self,
        remembered: RememberedStates,
        layout: &ProbeLayout,
        settings: &MemorySettings,
    ) -> Self {
        let states = remembered.weights.len();
        if states != self.ratios.len() || states != layout.state_count() {
            return self;
        }
        for (place, shown) in layout.places().iter().zip(&self.places) {
            let factor = (settings.place_strength * shown).clamp(-MAX_RATIO.ln(), MAX_RATIO.ln()).exp();
            let taken = self.ratios.iter_mut().zip(&place.occupied_in).filter(|(_, taken)| **taken);
            taken.for_each(|(ratio, _)| *ratio = (*ratio * factor).clamp(1.0 / MAX_RATIO, MAX_RATIO));
        }
        Self { remembered: Some(remembered), ..self }
    }

    /// Returns the hazard probability that stays where the encoder excludes the hazard, and the image is explained by every
    /// state without a hazard and by `hidden` of those with one. A threshold above it would let the encoder decide by itself
    /// about what nobody can see.
    ///
    /// ```
    /// use carff_decision::ImageEvidence;
    /// let states = [true, true, true, false, false, false];
    /// assert!((ImageEvidence::hidden_hazard(&states, 3) - 0.245).abs() < 1e-6);
    /// assert!((ImageEvidence::hidden_hazard(&states, 1) - 0.098).abs() < 1e-3);
    /// ```
    pub fn hidden_hazard(hazard_states: &[bool], hidden: usize) -> f64 {
        let hazards = (0..hazard_states.len()).filter(|state| hazard_states[*state]);
        let excluded: Vec<usize> = hazards.skip(hidden).collect();
        let ratio = |state: usize| if excluded.contains(&state) { 0.0 } else { f32::INFINITY };
        let ratios: Vec<f32> = (0..hazard_states.len()).map(ratio).collect();
        Self::new(&ratios).weigh(0.0, hazard_states).0
    }

    /// Evidence of an image that no state explains: something unknown is nearly certain.
    pub fn unexplained(states: usize) -> Self {
        Self::new(&vec![0.0; states])
    }

    /// Returns the ratios, one a state.
    pub fn ratios(&self) -> &[f64] {
        &self.ratios
    }

    /// Returns the probability of something unknown, 0..=1. It is weighed against the state that explains the image best:
    /// an image that one state explains leaves its prior probability only, however many states the scenario has.
    ///
    /// ```
    /// use carff_decision::ImageEvidence;
    /// let unknown = |ratios: &[f32]| ImageEvidence::new(ratios).unknown_probability();
    /// assert!(unknown(&[1.0, 0.0, 0.0, 0.0]) < 0.03);
    /// assert!(unknown(&[0.0; 4]) > 0.99);
    /// ```
    pub fn unknown_probability(&self) -> f64 {
        let best = self.ratios.iter().fold(0.0, |best: f64, ratio| best.max(*ratio)).min(EXPLAINED);
        UNKNOWN_PRIOR / (UNKNOWN_PRIOR + (1.0 - UNKNOWN_PRIOR) * best)
    }

    /// Returns the probability of a hazard and of something unknown, from the encoder's hazard probability (0..=1).
    /// `hazard_states` marks the states with a hazard, and must have one entry a state.
    ///
    /// The hazard's prior probability is the mean of two: that of the encoder, and what a memory has seen of the places, or
    /// else that of equally probable states. The image weighs it (Bayes' rule), with the states of each side, with and
    /// without a hazard, equally probable: a hazard that is hidden in one of three states and excluded in the others
    /// weighs a third of one that is hidden in all. The image adds to the encoder's hazard and never takes from it: a hazard
    /// may be hidden at a place where no known state has it.
    pub fn weigh(&self, hazard_probability: f32, hazard_states: &[bool]) -> (f64, f64) {
        let encoder = f64::from(hazard_probability).clamp(0.0, 1.0);
        let even = || share_of_hazards(hazard_states);
        let doubt = self.remembered.as_ref().map_or_else(even, |states| f64::from(states.hazard_by_places));
        let prior = ENCODER_SHARE * encoder + (1.0 - ENCODER_SHARE) * doubt;
        let with = prior * self.ratio(true, hazard_states);
        let without = (1.0 - prior) * self.ratio(false, hazard_states);
        let unknown = self.unknown_probability();
        let hazard = (with / (with + without).max(f64::MIN_POSITIVE)).max(encoder);
        (hazard * (1.0 - unknown), unknown)
    }

    /// Likelihood ratio of the states with or without a hazard: their weighted mean, or 0 where there is none.
    fn ratio(&self, hazard: bool, hazard_states: &[bool]) -> f64 {
        let weight = |state: usize| {
            let remembered = self.remembered.as_ref();
            remembered.map_or(1.0, |remembered| f64::from(remembered.weights[state]).max(LEAST_WEIGHT))
        };
        let of = || (0..self.ratios.len()).filter(|&state| hazard_states.get(state) == Some(&hazard));
        let sum: f64 = of().map(|state| weight(state) * self.ratios[state]).sum();
        sum / of().map(weight).sum::<f64>().max(f64::MIN_POSITIVE)
    }
}

impl From<&Unknowns> for ImageEvidence {
    fn from(unknowns: &Unknowns) -> Self {
        Self::new(unknowns.ratios()).with_places(unknowns.places())
    }
}

fn share_of_hazards(hazard_states: &[bool]) -> f64 {
    hazard_states.iter().filter(|h| **h).count() as f64 / hazard_states.len().max(1) as f64
}

impl Resolved {
    /// Weighs the belief by an image's evidence: states with a hazard share the weighed hazard probability, the others
    /// the rest, and something unknown takes its own.
    pub fn weigh(&mut self, layout: &ProbeLayout, evidence: &ImageEvidence) {
        if evidence.ratios.len() != layout.state_count() {
            return;
        }
        let (hazard, unknown) = evidence.weigh(self.hazard_probability, layout.hazard_states());
        let sum = |probabilities: &[f32], hazard: bool| -> f64 {
            let of = probabilities.iter().zip(layout.hazard_states()).filter(|(_, h)| **h == hazard);
            of.map(|(p, _)| f64::from(*p)).sum()
        };
        let sides = [false, true].map(|side| sum(&self.state_probabilities, side));
        let counts = [false, true].map(|side| layout.hazard_states().iter().filter(|h| **h == side).count());
        let wanted = [1.0 - hazard - unknown, hazard];
        for (p, &is_hazard) in self.state_probabilities.iter_mut().zip(layout.hazard_states()) {
            let side = usize::from(is_hazard);
            // A side that the encoder excludes is spread evenly.
            let share = if sides[side] > 1e-6 { f64::from(*p) / sides[side] } else { 1.0 / counts[side].max(1) as f64 };
            *p = (share * wanted[side]) as f32;
        }
        self.hazard_probability = hazard as f32;
        self.unknown_probability = unknown as f32;
        self.state = most_probable(layout, |s| f64::from(self.state_probabilities[s]));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Place;
    use carff_base::geometry::OrientedBox;

    const STATES: [bool; 4] = [true, true, false, false];

    /// An even encoder's answer is kept, and nothing is unknown, where every state explains the image alike.
    #[test]
    fn hidden_views_stay_even() {
        let (hazard, unknown) = ImageEvidence::new(&[50.0; 4]).weigh(0.5, &STATES);
        assert!((hazard - 0.49).abs() < 1e-6 && (unknown - 0.02).abs() < 1e-6, "{hazard} {unknown}");
        // How far below its limit a state is does not count.
        assert_eq!(ImageEvidence::new(&[50.0, 1.0, 9.0, 1.0]), ImageEvidence::new(&[1.0; 4]));
    }

    /// An image that only a hazard state explains is a hazard, for an encoder that is sure of the opposite.
    #[test]
    fn a_visible_hazard_overrules_the_encoder() {
        let (hazard, unknown) = ImageEvidence::new(&[1e-3, 80.0, 1e-3, 1e-3]).weigh(0.0, &STATES);
        assert!(hazard > 0.9, "{hazard} {unknown}");
    }

    /// An image that the hazard states do not explain leaves the encoder's probability unchanged.
    #[test]
    fn no_hazard_is_argued_away() {
        let (hazard, unknown) = ImageEvidence::new(&[1e-3, 1e-3, 80.0, 80.0]).weigh(0.3, &STATES);
        assert!((hazard - 0.3).abs() < 0.01 && (unknown - 0.02).abs() < 1e-3, "{hazard} {unknown}");
    }

    /// An encoder that is wrongly sure leaves a quarter of the probability to the hazard, where the image shows no
    /// difference.
    #[test]
    fn what_cannot_be_seen_stays_possible() {
        let (hazard, _) = ImageEvidence::new(&[50.0; 4]).weigh(0.0, &STATES);
        assert!((0.2..0.3).contains(&hazard), "{hazard}");
        // No threshold may be above it.
        for ratio in [50.0, 1e3, f32::INFINITY] {
            let (hazard, unknown) = ImageEvidence::new(&[ratio; 4]).weigh(0.0, &STATES);
            assert!(hazard + unknown >= ImageEvidence::hidden_hazard(&STATES, 2), "{ratio}");
        }
    }

    /// A hazard that the image leaves possible in one of several states weighs its share of them.
    #[test]
    fn a_hazard_hidden_in_one_state_weighs_one_state() {
        let evidence = ImageEvidence::new(&[80.0, 1e-3, 1e-3, 80.0, 80.0, 80.0]);
        let states = [true, true, true, false, false, false];
        // The prior probability is a quarter with an encoder that excludes the hazard; a third of it is left.
        let (hazard, unknown) = evidence.weigh(0.0, &states);
        assert!((hazard - 0.098).abs() < 1e-3 && unknown < 0.021, "{hazard} {unknown}");
        let (visible, unknown) = ImageEvidence::new(&[1e-3, 80.0, 1e-3, 1e-3, 1e-3, 1e-3]).weigh(0.5, &states);
        assert!(visible > 0.95 && visible + unknown > 0.99, "{visible} {unknown}");
    }

    /// With a memory, a vehicle of which the image shows only a part is a hazard; at the place of a state that is excluded
    /// already, it is none.
    #[test]
    fn places_count_for_a_belief_with_a_memory() {
        let oriented_box = OrientedBox { center: [0.0; 3], half_size: [1.0; 3], yaw: 0.0 };
        let place =
            |state| Place { name: "actor".into(), oriented_box, occupied_in: (0..4).map(|s| s == state).collect() };
        let layout = ProbeLayout::new(vec![place(0), place(1)], STATES.to_vec()).unwrap();
        let settings = MemorySettings { place_strength: 8.0, ..MemorySettings::default() };
        let weighed = |weights: [f32; 4], hazard_by_places, encoder| {
            let evidence = ImageEvidence::new(&[50.0; 4]).with_places(&[1.0, f32::NAN]);
            let remembered = RememberedStates { weights: weights.to_vec(), hazard_by_places };
            evidence.with_memory(remembered, &layout, &settings).weigh(encoder, &STATES).0
        };
        assert!(weighed([0.5, 0.0, 0.5, 0.0], 0.5, 0.5) > 0.979);
        assert!(weighed([0.0, 0.5, 0.0, 0.5], 0.5, 0.5) < 0.6);
        let plain = ImageEvidence::new(&[50.0; 4]).with_places(&[1.0, 0.0]);
        assert_eq!(plain.clone().with_memory(RememberedStates::default(), &layout, &settings), plain, "no memory");
        // The places were seen clear, and are hidden now: the doubt is gone. If they were never seen, half of it stays.
        let hidden = |hazard_by_places| {
            let remembered = RememberedStates { weights: vec![0.25; 4], hazard_by_places };
            ImageEvidence::new(&[1.0; 4]).with_memory(remembered, &layout, &settings).weigh(0.0, &STATES).0
        };
        assert!(hidden(0.01) < 0.01 && (hidden(0.5) - 0.245).abs() < 1e-3, "{} {}", hidden(0.01), hidden(0.5));
    }

    /// An image that one state explains leaves something unknown its prior probability only, with any number of states.
    #[test]
    fn one_state_explains_an_image() {
        let mut ratios = [0.0; 16];
        ratios[3] = 1.0;
        let mut states = [false; 16];
        states[15] = true;
        let (hazard, unknown) = ImageEvidence::new(&ratios).weigh(0.0, &states);
        assert!(hazard < 0.01 && (unknown - 0.02).abs() < 1e-6, "{hazard} {unknown}");
        // A known vehicle in full sight, in one state.
        let (hazard, unknown) = ImageEvidence::new(&[1.0, 0.0, 0.0, 0.0]).weigh(0.9, &STATES);
        assert!(hazard > 0.95 && (unknown - 0.02).abs() < 1e-6, "{hazard} {unknown}");
    }

    /// An image that no state explains is unknown; ratios that are not numbers explain nothing.
    #[test]
    fn what_nothing_explains_is_unknown() {
        let evidence = [ImageEvidence::new(&[1e-3; 4]), ImageEvidence::new(&[f32::NAN; 4])];
        for evidence in evidence.into_iter().chain([ImageEvidence::unexplained(4)]) {
            let (hazard, unknown) = evidence.weigh(0.0, &STATES);
            assert!(unknown > 0.8 && hazard < 0.1, "{hazard} {unknown}");
        }
    }

    /// A comparison counts for the next frames only: neither for its own, nor for one after a pause.
    #[test]
    fn comparisons_do_not_count_forever() {
        let counts = |frame| ImageEvidence::counts_later(7, frame);
        assert_eq!([6, 7, 8, 12, 13].map(counts), [false, false, true, true, false]);
    }
}
