//! The limits of the known: how much of an image a known state leaves unexplained, and the file of these limits.

use crate::blobs::Blob;
use crate::camera::CameraLimits;
use crate::compare::{Comparer, Comparison, KnownScene};
use crate::lanes::{ErrorMap, Lanes};
use crate::residuals::ResidualKind;
use crate::sighting::Sighting;
use carff_base::geometry::PinholeCamera;
use carff_field::Field;
use carff_messages::{LATENT_DIM, MAX_UNKNOWNS, UnknownBox};
use ndarray::ArrayView3;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// File name in a checkpoint.
const FILE: &str = "known.json";
/// Version of the file's format. The limits of earlier versions are for other residuals.
const FORMAT_VERSION: u32 = 5;
/// Steepness of the evidence against a state beyond the limit: at 1.5 times the limit, something unknown explains the
/// image 58 times better.
const STEEPNESS: f64 = 10.0;
/// Share of the known images that leave less than the limit of a kind.
const WITHIN: f64 = 0.97;
/// Smallest limit of a kind, in errors of the field: below it, a slightly corrupted image leaves more than a clean one.
const LEAST_LIMIT: f32 = 2.0;
/// Share of the known images' smallest explained share below which a view is of another place.
const OF_LEAST_EXPLAINED: f32 = 0.8;

/// Strength from which on a blob stands in the way of a vehicle that crosses, in limits.
const SUSPICIOUS: f32 = 0.8;
/// Residual of a view of another place, in limits: more than any object's.
const ELSEWHERE: f32 = 100.0;

/// The limits of what a checkpoint takes as known, calibrated on images of known states from poses of no other use.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Known {
    /// Format of this file; 5.
    pub format_version: u32,
    /// The ground on which something unknown counts.
    pub lanes: Lanes,
    /// For each known state, true if it has the hazard.
    pub hazard_states: Vec<bool>,
    /// Limits of the states without the hazard.
    pub clear: KnownLimits,
    /// Limits of the states with the hazard, whose vehicle has no fixed place.
    pub hazard: KnownLimits,
    /// Share of a view's variation that the field explains, from which on the view is of this place.
    pub least_explained: f32,
    /// Limits of images of a camera in order.
    pub camera: CameraLimits,
}

/// Limits of what some of the known states leave unexplained of their own images.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct KnownLimits {
    /// Limits of what the image shows and the state does not have.
    pub unexpected: KindLimits,
    /// Limits of what the state has and the image does not show.
    pub missing: KindLimits,
    /// Number of images that the limits rest on.
    pub images: usize,
}

/// Limits of one kind of residuals.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct KindLimits {
    /// The field's own errors on the lanes.
    pub errors: ErrorMap,
    /// Strength of a blob that 97 of 100 images stay below, at least 2.
    pub limit: f32,
}

/// Reason why the file cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum KnownError {
    /// The file cannot be read or written.
    #[error("{path}: {source}")]
    Io {
        /// Path of the file.
        path: PathBuf,
        /// Error of the system.
        source: std::io::Error,
    },
    /// The file's contents are not valid.
    #[error("{path}: {problem}; make it again with `carff checkpoint known`")]
    Format {
        /// Path of the file.
        path: PathBuf,
        /// Description of the error.
        problem: String,
    },
}

/// The parts of one image that the known states leave unexplained.
#[derive(Clone, Debug, PartialEq)]
pub struct Seen {
    /// For each state, how much better it explains the image than something unknown does.
    pub ratios: Vec<f32>,
    /// Boxes of what the best state does not explain; their probabilities assume that state.
    pub boxes: Vec<UnknownBox>,
    /// Strength of the strongest blob under the best state, in limits.
    pub residual: f32,
}

impl Known {
    /// Fits the limits on comparisons of images, each with the state that it shows.
    pub fn fit(
        lanes: Lanes,
        hazard_states: Vec<bool>,
        comparisons: &[(usize, Comparison)],
        camera: CameraLimits,
    ) -> Self {
        let of_side = |side: bool| {
            let states: Vec<usize> = (0..hazard_states.len()).filter(|&s| hazard_states[s] == side).collect();
            let images: Vec<&Comparison> =
                comparisons.iter().filter(|(state, _)| states.contains(state)).map(|(_, c)| c).collect();
            KnownLimits::fit(&lanes, &states, &images)
        };
        let (clear, hazard) = (of_side(false), of_side(true));
        let least = comparisons.iter().map(|(_, c)| c.fit.explained).fold(1.0, f32::min);
        Self {
            format_version: FORMAT_VERSION,
            least_explained: OF_LEAST_EXPLAINED * least.max(0.0),
            lanes,
            hazard_states,
            clear,
            hazard,
            camera,
        }
    }

    /// Compares an image with the known states; one that leaves something unexplained is aligned first. `None`
    /// without states.
    pub fn see(
        &self,
        comparer: &mut Comparer,
        field: &Field,
        states: &[[f32; LATENT_DIM]],
        (camera, image): (&PinholeCamera, ArrayView3<'_, u8>),
        threads: usize,
    ) -> Option<(Seen, Comparison)> {
        let scene = KnownScene { field, states, hazard_states: &self.hazard_states, lanes: &self.lanes };
        let comparison = comparer.compare(scene, camera, image, threads)?;
        let found = self.judge_with_own(comparer, comparison, scene, threads);
        if found.0.residual <= 1.0 {
            return Some(found);
        }
        // Before something unknown is suspected, the pose is: a camera that has turned a little leaves residuals, too.
        let Some(aligned) = comparer.align(&found.1, scene) else { return Some(found) };
        Some(self.judge_with_own(comparer, aligned, scene, threads))
    }

    /// Judges a comparison; what it leaves unexplained may be the vehicle itself.
    fn judge_with_own(
        &self,
        comparer: &mut Comparer,
        comparison: Comparison,
        scene: KnownScene,
        threads: usize,
    ) -> (Seen, Comparison) {
        let seen = self.judge(&comparison);
        if seen.residual <= SUSPICIOUS {
            return (seen, comparison);
        }
        match comparer.look_closer(&comparison, scene, threads) {
            Some(explained) => (self.judge(&explained), explained),
            None => (seen, comparison),
        }
    }

    /// Describes what the last comparison shows of the lanes. `None` for a view of another place, or without lanes.
    pub fn sighting(&self, comparer: &Comparer, comparison: &Comparison, seen: &Seen) -> Option<Sighting> {
        if !comparison.sees_lanes() {
            return None;
        }
        let clear = (0..seen.ratios.len()).filter(|state| self.hazard_states.get(*state) == Some(&false));
        let best = clear.max_by(|&a, &b| seen.ratios[a].total_cmp(&seen.ratios[b]))?;
        let best_ratio = Some(seen.ratios[best]).filter(|ratio| *ratio > 0.0)?;
        let blobs = ResidualKind::ALL.into_iter().flat_map(|kind| {
            let KindLimits { errors, limit } = self.clear.of(kind);
            let blobs = comparison.blobs(best, kind, errors);
            blobs.into_iter().filter(move |blob| blob.strength > SUSPICIOUS * limit)
        });
        let (blobs, depth_m) = (blobs.collect::<Vec<_>>(), comparer.depth_m(best));
        Some(Sighting::new(comparison, &seen.ratios, best_ratio, &blobs, depth_m, self.lanes.ground_m))
    }

    /// Judges a comparison. No state explains a view of another place, and nothing has a box in it.
    pub fn judge(&self, comparison: &Comparison) -> Seen {
        if comparison.fit.explained < self.least_explained {
            let ratios = vec![0.0; comparison.states()];
            return Seen { ratios, boxes: Vec::new(), residual: ELSEWHERE };
        }
        let limits =
            |state: usize| if self.hazard_states.get(state) == Some(&true) { &self.hazard } else { &self.clear };
        let of_states: Vec<InLimits> = (0..comparison.states()).map(|s| limits(s).judge(comparison, s)).collect();
        let strongest = |state: usize| of_states[state].first().map_or(0.0, |(strength, _)| *strength);
        let ratio = |in_limits: f32| f64::from(1.0 / in_limits.max(0.25)).powf(STEEPNESS);
        let ratios = (0..of_states.len()).map(|s| ratio(strongest(s)) as f32).collect();
        let best = (0..of_states.len()).min_by(|&a, &b| strongest(a).total_cmp(&strongest(b)));
        let Some(best) = best else { return Seen { ratios, boxes: Vec::new(), residual: 0.0 } };
        let unknown = of_states[best].iter().take(MAX_UNKNOWNS).filter(|(strength, _)| *strength > 1.0);
        let boxes = unknown.map(|(strength, blob)| {
            let (center, half_size) = blob.upright_box(&comparison.camera, self.lanes.ground_m);
            let probability = (1.0 / (1.0 + ratio(*strength))) as f32;
            UnknownBox { center, half_size, probability, place: -1 }
        });
        Seen { ratios, boxes: boxes.collect(), residual: strongest(best) }
    }

    /// Reads the file of a checkpoint; `None` if the checkpoint has none.
    pub fn load(checkpoint: &Path) -> Result<Option<Self>, KnownError> {
        let path = checkpoint.join(FILE);
        let text = match std::fs::read_to_string(&path) {
            Ok(text) => text,
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(None),
            Err(source) => return Err(KnownError::Io { path, source }),
        };
        let format = |problem: String| KnownError::Format { path: path.clone(), problem };
        let known: Self = serde_json::from_str(&text).map_err(|e| format(e.to_string()))?;
        if known.format_version != FORMAT_VERSION {
            let found = known.format_version;
            return Err(format(format!("`format_version` is {found}, this program reads {FORMAT_VERSION}")));
        }
        for limits in [&known.clear, &known.hazard] {
            if !ResidualKind::ALL.iter().all(|kind| limits.of(*kind).is_valid()) {
                return Err(format("`errors` and `limit` must be positive numbers".to_owned()));
            }
        }
        Ok(Some(known))
    }

    /// Writes the file into a checkpoint folder, atomically.
    pub fn save(&self, checkpoint: &Path) -> Result<(), KnownError> {
        let path = checkpoint.join(FILE);
        let text = serde_json::to_string(self)
            .map_err(|e| KnownError::Format { path: path.clone(), problem: e.to_string() })?;
        let partial = path.with_extension("partial");
        std::fs::write(&partial, text + "\n")
            .and_then(|()| std::fs::rename(&partial, &path))
            .map_err(|source| KnownError::Io { path, source })
    }
}

/// Blobs of one state and kind with their strengths in limits, the strongest first.
type InLimits = Vec<(f32, Blob)>;

impl KnownLimits {
    /// Fits the limits of some states on comparisons of their images, each under its best one of these states.
    /// Residuals of the first half of the images make the error maps, and those of the second half the limits.
    fn fit(lanes: &Lanes, states: &[usize], images: &[&Comparison]) -> Self {
        let (for_errors, for_limit) = images.split_at(images.len() / 2);
        let mut points = [Vec::new(), Vec::new()];
        for comparison in for_errors {
            let of = |s: usize| ResidualKind::ALL.into_iter().flat_map(move |kind| comparison.on_lanes(s, kind));
            let Some(best) = best(states, |s| of(s).map(|(_, r)| r * r).sum()) else { continue };
            for kind in ResidualKind::ALL {
                points[kind as usize].extend(comparison.on_lanes(best, kind));
            }
        }
        let errors = ResidualKind::ALL.map(|kind| ErrorMap::fit(lanes, &points[kind as usize]));
        let mut strengths = [Vec::new(), Vec::new()];
        for comparison in for_limit {
            let of_kind = |s: usize, kind: ResidualKind| {
                comparison.blobs(s, kind, &errors[kind as usize]).first().map_or(0.0, |blob| blob.strength)
            };
            let of = |s: usize| ResidualKind::ALL.map(|kind| of_kind(s, kind));
            let Some(best) = best(states, |s| of(s).into_iter().fold(0.0, f32::max)) else { continue };
            strengths.iter_mut().zip(of(best)).for_each(|(all, strength)| all.push(strength));
        }
        let images = strengths[0].len();
        let of_kind = |errors, mut strengths: Vec<f32>| {
            strengths.sort_by(f32::total_cmp);
            let at = ((strengths.len() as f64 * WITHIN).ceil() as usize).saturating_sub(1);
            KindLimits { errors, limit: strengths.get(at).copied().unwrap_or_default().max(LEAST_LIMIT) }
        };
        let ([unexpected_errors, missing_errors], [unexpected, missing]) = (errors, strengths);
        Self { unexpected: of_kind(unexpected_errors, unexpected), missing: of_kind(missing_errors, missing), images }
    }

    /// Returns the limits of one kind.
    pub fn of(&self, kind: ResidualKind) -> &KindLimits {
        match kind {
            ResidualKind::Unexpected => &self.unexpected,
            ResidualKind::Missing => &self.missing,
        }
    }

    /// Multiplies the limits.
    #[must_use]
    pub fn times(mut self, factor: f32) -> Self {
        self.unexpected.limit *= factor;
        self.missing.limit *= factor;
        self
    }

    /// Returns the blobs of a state, of the kind that has the strongest one: an object covers what a state has there.
    fn judge(&self, comparison: &Comparison, state: usize) -> InLimits {
        let [unexpected, missing] = ResidualKind::ALL.map(|kind| -> InLimits {
            let KindLimits { errors, limit } = self.of(kind);
            let in_limits = |blob: Blob| (blob.strength / limit, blob);
            comparison.blobs(state, kind, errors).into_iter().map(in_limits).collect()
        });
        let strongest = |blobs: &InLimits| blobs.first().map_or(0.0, |(strength, _)| *strength);
        if strongest(&missing) > strongest(&unexpected) { missing } else { unexpected }
    }
}

impl KindLimits {
    /// Reports whether the limits can be used: numbers above 0.
    fn is_valid(&self) -> bool {
        self.errors.is_valid() && self.limit.is_finite() && self.limit > 0.0
    }
}

/// The state with the smallest value.
fn best(states: &[usize], value: impl Fn(usize) -> f32) -> Option<usize> {
    states.iter().copied().min_by(|&a, &b| value(a).total_cmp(&value(b)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use carff_base::geometry::OrientedBox;
    use carff_field::FieldConfig;

    fn known() -> Known {
        let lanes = Lanes {
            areas: vec![OrientedBox { center: [0.0; 3], half_size: [9.0, 3.0, 1.0], yaw: 0.3 }],
            ground_m: 0.0,
            bounds_m: [[-9.0, -9.0], [9.0, 9.0]],
            nearest_m: 1.0,
            own: Vec::new(),
        };
        let of_kind = KindLimits { errors: ErrorMap::even(&lanes, 1.0), limit: 5.0 };
        let limits = KnownLimits { unexpected: of_kind.clone(), missing: of_kind, images: 10 };
        Known {
            format_version: FORMAT_VERSION,
            lanes,
            hazard_states: vec![false],
            clear: limits.clone(),
            hazard: limits,
            least_explained: 0.5,
            camera: CameraLimits::fit(&[], [60.0; 2]),
        }
    }

    /// A small field with little density anywhere.
    fn thin_field() -> Field {
        let config = FieldConfig {
            log2_table_size: 10,
            occupancy_resolution: 16,
            density_offset: -9.0,
            ..FieldConfig::default()
        };
        Field::new(config, 4).unwrap()
    }

    /// A written file is read back; a missing file is not an error; another version and damaged limits are refused.
    #[test]
    fn the_file_is_checked() {
        let folder = tempfile::tempdir().unwrap();
        assert_eq!(Known::load(folder.path()).unwrap(), None);
        let known = known();
        known.save(folder.path()).unwrap();
        assert_eq!(Known::load(folder.path()).unwrap(), Some(known.clone()));
        for (broken, word) in [
            (Known { format_version: FORMAT_VERSION - 1, ..known.clone() }, "format_version"),
            (Known { format_version: 9, ..known.clone() }, "format_version"),
            (Known { clear: known.clear.clone().times(-1.0), ..known.clone() }, "limit"),
        ] {
            broken.save(folder.path()).unwrap();
            assert!(Known::load(folder.path()).unwrap_err().to_string().contains(word));
        }
        std::fs::write(folder.path().join(FILE), "{}").unwrap();
        assert!(Known::load(folder.path()).unwrap_err().to_string().contains("carff checkpoint known"));
    }

    /// A field's own image is explained by the state that it was rendered from; the same image with a patch on the lane
    /// is explained by none, and the patch has a box on the ground where it stands.
    #[test]
    fn a_patch_on_the_lane_is_unknown() {
        let field = thin_field();
        let camera = PinholeCamera::look_at([0.0, -8.0, 6.0], [0.0; 3], [0.0, 0.0, 1.0], 96, 96, 60.0);
        let (known, states, mut comparer) = (known(), [[0.0; LATENT_DIM]], Comparer::default());
        let mut rendered = carff_field::RenderBuffer::new();
        field.render(&camera, &states[0], &carff_field::RenderOptions::default(), &mut rendered);
        let mut image = ndarray::Array3::from_shape_fn((96, 96, 3), |(y, x, c)| {
            (rendered.rgb[(y * 96 + x) * 3 + c].clamp(0.0, 1.0) * 255.0) as u8
        });
        let mut see = |image: &ndarray::Array3<u8>| {
            known.see(&mut comparer, &field, &states, (&camera, image.view()), 1).unwrap().0
        };
        let clean = see(&image);
        assert!(clean.boxes.is_empty() && clean.ratios[0] > 100.0, "{clean:?}");
        image.slice_mut(ndarray::s![40..52, 40..58, ..]).mapv_inplace(|v| if v > 128 { 0 } else { 255 });
        let patched = see(&image);
        assert!(patched.ratios[0] < 0.1 && patched.residual > 1.0, "{patched:?}");
        let [x, y, _] = patched.boxes[0].center;
        assert!(x.abs() < 1.5 && y.abs() < 2.5, "{:?}", patched.boxes);
        let mut comparison =
            known.see(&mut Comparer::default(), &field, &states, (&camera, image.view()), 1).unwrap().1;
        // What only the image has, and what only a state has, count in limits of their own.
        let residual = comparison.residual(0, ResidualKind::Unexpected).to_vec();
        let nothing = || vec![0.0; residual.len()];
        let of_either = vec![[residual.clone(), nothing()], [nothing(), residual.clone()]];
        let of_either = comparison.clone().with_residuals(of_either);
        let excluded = |unexpected: f32, missing: f32| {
            let mut known = Known { hazard_states: vec![false; 2], ..known.clone() };
            (known.clear.unexpected.limit, known.clear.missing.limit) = (unexpected, missing);
            known.judge(&of_either).ratios.into_iter().map(|ratio| ratio < 0.1).collect::<Vec<_>>()
        };
        let (within, beyond) = (1e6, 5.0);
        assert_eq!(excluded(within, within), [false, false]);
        assert_eq!(excluded(beyond, within), [true, false]);
        assert_eq!(excluded(within, beyond), [false, true]);
        // No state explains a view of another place.
        comparison.fit.explained = 0.4;
        let elsewhere = known.judge(&comparison);
        assert!(elsewhere.boxes.is_empty() && elsewhere.ratios == [0.0], "{elsewhere:?}");
    }

    /// Images that leave nothing have the smallest limits; those that leave more have larger ones.
    #[test]
    fn limits_have_a_floor() {
        let known = known();
        let field = thin_field();
        let camera = PinholeCamera::look_at([0.0, -8.0, 6.0], [0.0; 3], [0.0, 0.0, 1.0], 64, 64, 60.0);
        let image = ndarray::Array3::from_elem((64, 64, 3), 90);
        let states = [[0.0; LATENT_DIM]];
        let any = known.see(&mut Comparer::default(), &field, &states, (&camera, image.view()), 1).unwrap().1;
        let on_lane = |i: usize| (27..35).contains(&(i / 64)) && (27..39).contains(&(i % 64));
        let comparison = |left: f32| {
            let residual = (0..64 * 64).map(|i| if on_lane(i) { left } else { 0.0 }).collect();
            any.clone().with_residuals(vec![[residual, vec![0.0; 64 * 64]]])
        };
        let limit = |left: f32| {
            let (for_errors, for_limit) = (comparison(1.0), comparison(left));
            let images: Vec<&Comparison> = (0..40).map(|i| if i < 20 { &for_errors } else { &for_limit }).collect();
            KnownLimits::fit(&known.lanes, &[0], &images).unexpected.limit
        };
        assert_eq!(limit(1.5), LEAST_LIMIT);
        assert!((limit(4.0) - 4.0).abs() < 0.5, "{}", limit(4.0));
        assert_eq!(KnownLimits::fit(&known.lanes, &[0], &[]).unexpected.limit, LEAST_LIMIT);
    }

    /// An image is not explained if by its pose the camera sees no lane, and nothing by which to recognise the place.
    #[test]
    fn a_pose_that_shows_nothing_explains_nothing() {
        let config = FieldConfig { log2_table_size: 10, occupancy_resolution: 16, ..FieldConfig::default() };
        let field = Field::new(config, 4).unwrap();
        assert_eq!(field.changing().occupied_share(), 1.0, "no still part");
        let away = PinholeCamera::look_at([0.0, -8.0, 6.0], [0.0, -60.0, 40.0], [0.0, 0.0, 1.0], 96, 96, 60.0);
        let (known, mut comparer) = (known(), Comparer::default());
        let image = ndarray::Array3::from_elem((96, 96, 3), 90);
        let (seen, comparison) =
            known.see(&mut comparer, &field, &[[0.0; LATENT_DIM]], (&away, image.view()), 1).unwrap();
        assert!(seen.ratios == [0.0] && seen.residual > 1.0 && seen.boxes.is_empty(), "{seen:?}");
        assert!(!comparison.sees_lanes() && known.sighting(&comparer, &comparison, &seen).is_none());
    }
}
