//! Place and speed of vehicles on the others' lane, at places and speeds that no dataset has.

use crate::trials::lane_images::{LaneImage, Visibility};
use crate::{Progress, Subject};
use carff_base::random::Key;
use carff_base::statistics::{mean, percentile};
use carff_dataset::{Image, sensor::apply_noise_into};
use carff_trials::KnownStates;
use carff_unknown::{Crossing, LaneVehicle, Track};
use serde::{Deserialize, Serialize};

/// Distance from the camera that separates near vehicles from far ones, metres.
const NEAR_M: f64 = 12.0;

/// Figures of some images with a vehicle in sight.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PlaceFigures {
    /// Images.
    pub images: usize,
    /// Drives that these images are from, which are what is independent.
    pub drives: usize,
    /// Images in which the vehicle was found.
    pub found: usize,
    /// Root mean square error of its place along the lane, metres.
    pub rmse_m: f64,
    /// Mean error along the direction of travel, metres.
    pub bias_m: f64,
    /// Median and 95th percentile of the error's amount, metres.
    pub percentiles_m: [f64; 2],
}

/// Figures of the vehicles on the lane.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct VehicleTable {
    /// Whole vehicles at most 12 m away.
    pub near: PlaceFigures,
    /// Whole vehicles farther away.
    pub far: PlaceFigures,
    /// Vehicles of which a part is in sight.
    pub partial: PlaceFigures,
    /// Images that show nothing of a vehicle.
    pub empty_images: usize,
    /// Vehicles found in these.
    pub invented: usize,
    /// Images with a whole vehicle and a known speed.
    pub speeds: usize,
    /// Root mean square error of these speeds, m/s.
    pub speed_rmse_mps: f64,
}

/// Errors of one kind of image.
#[derive(Default)]
struct Errors {
    images: usize,
    drives: Vec<usize>,
    along_m: Vec<f64>,
}

impl Errors {
    fn add(&mut self, drive: usize, error_m: Option<f64>) {
        self.images += 1;
        self.along_m.extend(error_m);
        if self.drives.last() != Some(&drive) {
            self.drives.push(drive);
        }
    }

    fn figures(&self) -> PlaceFigures {
        let amounts: Vec<f64> = self.along_m.iter().map(|error| error.abs()).collect();
        PlaceFigures {
            images: self.images,
            drives: self.drives.len(),
            found: self.along_m.len(),
            rmse_m: root_mean_square(&self.along_m),
            bias_m: mean(&self.along_m).unwrap_or(0.0),
            percentiles_m: [0.5, 0.95].map(|q| percentile(&amounts, q).unwrap_or(0.0)),
        }
    }
}

fn root_mean_square(errors: &[f64]) -> f64 {
    mean(&errors.iter().map(|e| e * e).collect::<Vec<_>>()).unwrap_or(0.0).sqrt()
}

/// Computes the table, or returns the reason why there is none.
pub fn vehicles(subject: &Subject, on_progress: &dyn Fn(&Progress)) -> Result<VehicleTable, String> {
    let probe = subject.probe.as_ref().map_err(Clone::clone)?;
    let known = subject.known.as_ref().ok_or("the checkpoint has no `known.json`")?;
    let place = probe.layout().hazard_places().next().ok_or("no place belongs to a hazard only")?.oriented_box;
    if subject.lane_drives.is_empty() {
        return Err("the dataset has no scenario file with closed-loop drives".into());
    }
    let states = KnownStates::new(known, probe, subject.options.threads);
    let [mut near, mut far, mut partial] = [(); 3].map(|()| Errors::default());
    let mut speeds: Vec<f64> = Vec::new();
    let (mut table, total) = (VehicleTable::default(), subject.lane_drives.len());
    let ahead = [place.yaw.cos(), place.yaw.sin()];
    for (done, drive) in subject.lane_drives.iter().enumerate() {
        on_progress(&Progress { phase: "vehicles", done, total, line: String::new() });
        let mut track = Track::default();
        for (frame, shot) in drive.iter().enumerate() {
            let image = noisy(subject, shot, (done * drive.len() + frame) as u64);
            let [x, y, _] = shot.camera.position_m();
            let crossing = Crossing { place, from_m: [x, y], heading_rad: shot.heading_rad };
            let sighting = states.sighting(&shot.camera, &image);
            let found = sighting.map_or(Vec::new(), |sighting| sighting.vehicles(&crossing));
            let speed_mps = track.see(shot.time_s, found.first());
            let error = |v: &LaneVehicle| (0..2).map(|i| (v.center_m[i] - shot.vehicle_m[i]) * ahead[i]).sum::<f64>();
            let nearest = found.iter().map(error).min_by(|a, b| a.abs().total_cmp(&b.abs()));
            let errors = match shot.visibility {
                Visibility::Whole if (shot.vehicle_m[0] - x).hypot(shot.vehicle_m[1] - y) <= NEAR_M => &mut near,
                Visibility::Whole => &mut far,
                Visibility::Partial => &mut partial,
                Visibility::Hardly => continue,
                Visibility::None => {
                    table.empty_images += 1;
                    table.invented += found.len();
                    continue;
                }
            };
            errors.add(done, nearest);
            let is_whole = shot.visibility == Visibility::Whole;
            speeds.extend(speed_mps.filter(|_| is_whole).map(|mps| mps - shot.speed_mps));
        }
    }
    (table.near, table.far, table.partial) = (near.figures(), far.figures(), partial.figures());
    (table.speeds, table.speed_rmse_mps) = (speeds.len(), root_mean_square(&speeds));
    Ok(table)
}

/// The image with the sensor noise of a camera in use.
fn noisy(subject: &Subject, shot: &LaneImage, number: u64) -> Image {
    let mut noisy = shot.image.clone();
    let key = Key::named("lane", subject.options.seed, number);
    if apply_noise_into(&shot.image.rgb, &mut noisy.rgb, &subject.noise(), key).is_err() {
        // Only settings out of range are refused; those of a checkpoint were validated.
        noisy.rgb.copy_from_slice(&shot.image.rgb);
    }
    noisy
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Images are counted with and without a found vehicle, and drives once.
    #[test]
    fn errors_are_counted() {
        let mut errors = Errors::default();
        for (drive, error_m) in [(0, Some(0.3)), (0, Some(-0.4)), (2, None), (2, Some(0.0))] {
            errors.add(drive, error_m);
        }
        let figures = errors.figures();
        assert_eq!((figures.images, figures.drives, figures.found), (4, 2, 3));
        assert!((figures.rmse_m - (0.25_f64 / 3.0).sqrt()).abs() < 1e-9);
        assert!((figures.bias_m + 0.1 / 3.0).abs() < 1e-9 && (figures.percentiles_m[0] - 0.3).abs() < 1e-9);
        assert_eq!(Errors::default().figures(), PlaceFigures::default());
    }
}
