//! The motion of the ego along its way: speed, with limits of acceleration, braking and jerk.

/// Largest acceleration and braking, m/s².
const ACCELERATION_MPS2: f64 = 3.0;
const BRAKING_MPS2: f64 = 6.0;
/// Largest change of the acceleration, m/s³.
const JERK_MPS3: f64 = 20.0;
/// Time in which the vehicle aims to reach its target speed, seconds.
const RESPONSE_S: f64 = 0.3;

/// A vehicle on its way.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Vehicle {
    /// Distance of its centre from the start of the way, metres.
    pub(super) at_m: f64,
    /// Speed, m/s, not negative.
    pub(super) speed_mps: f64,
    acceleration_mps2: f64,
}

impl Vehicle {
    /// A vehicle at the start, at a steady speed.
    pub(super) fn at_start(speed_mps: f64) -> Self {
        Self { at_m: 0.0, speed_mps, acceleration_mps2: 0.0 }
    }

    /// Moves towards a target speed, for a time over which the acceleration is constant.
    pub(super) fn substep(&mut self, target_mps: f64, time_s: f64) {
        let wanted = ((target_mps - self.speed_mps) / RESPONSE_S).clamp(-BRAKING_MPS2, ACCELERATION_MPS2);
        let change = JERK_MPS3 * time_s;
        self.acceleration_mps2 += (wanted - self.acceleration_mps2).clamp(-change, change);
        let before_mps = self.speed_mps;
        self.speed_mps = (before_mps + self.acceleration_mps2 * time_s).max(0.0);
        if self.speed_mps == 0.0 {
            self.acceleration_mps2 = self.acceleration_mps2.max(0.0);
        }
        self.at_m += f64::midpoint(before_mps, self.speed_mps) * time_s;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use carff_decision::{Approach, Look, Motion, Speeds};
    use carff_messages::ActionCode;

    const SUBSTEP_S: f64 = 0.02;

    /// A vehicle that brakes hard from 5 m/s stands within the limits of braking and jerk, and stays; one that starts
    /// keeps the limit of acceleration and reaches its target.
    #[test]
    fn limits_hold() {
        let mut vehicle = Vehicle::at_start(5.0);
        for target_mps in [0.0, 8.0] {
            let mut last = vehicle;
            for _ in 0..400 {
                vehicle.substep(target_mps, SUBSTEP_S);
                let acceleration = (vehicle.speed_mps - last.speed_mps) / SUBSTEP_S;
                assert!((-BRAKING_MPS2 - 1e-9..=ACCELERATION_MPS2 + 1e-9).contains(&acceleration), "{acceleration}");
                assert!(vehicle.at_m >= last.at_m && vehicle.speed_mps <= 8.0 + 1e-9);
                last = vehicle;
            }
            assert!((vehicle.speed_mps - target_mps).abs() < 0.01);
            if target_mps == 0.0 {
                assert!((5.0_f64.powi(2) / (2.0 * BRAKING_MPS2)..4.5).contains(&vehicle.at_m), "{}", vehicle.at_m);
            }
        }
    }

    /// Wherever a controller has the vehicle stop ahead of the place where others drive, it stops ahead of it.
    #[test]
    fn a_stop_ahead_of_the_place_is_possible() {
        let speeds = Speeds { advance_mps: 8.0, creep_mps: 1.5, others_mps: 0.0 };
        for (tenths_mps, tenths_m) in (1..80).flat_map(|v| (1..100).map(move |d| (v, d))) {
            let (speed_mps, to_conflict_m) = (f64::from(tenths_mps) / 10.0, f64::from(tenths_m) / 10.0);
            let through_conflict_m = to_conflict_m + 6.0;
            let motion = Some(Motion { speed_mps, to_conflict_m, through_conflict_m, along_conflict_m: 0.0 });
            if Approach::Stop.drive(true, Look::default(), motion, speeds).0 != ActionCode::Halt {
                continue;
            }
            let mut vehicle = Vehicle::at_start(speed_mps);
            for _ in 0..400 {
                vehicle.substep(0.0, SUBSTEP_S);
            }
            assert!(vehicle.at_m <= to_conflict_m + 0.05, "{speed_mps} m/s, {to_conflict_m} m: {}", vehicle.at_m);
        }
    }

    /// Wherever a controller has the vehicle cross a lane that is clear up to somebody, it has left the lane before that
    /// somebody arrives at the highest speed. One that merges stays ahead of them all the way, also where others are slow.
    #[test]
    fn a_crossing_is_over_in_time() {
        for (others_mps, length_m, along_conflict_m) in [(6.0, 7.0, 0.0), (6.0, 10.0, 7.0), (3.0, 10.0, 7.0)] {
            let speeds = Speeds { advance_mps: 5.0, creep_mps: 1.5, others_mps };
            let mut crossings = 0;
            for (tenths_mps, tenths_m) in (0..=50).step_by(2).flat_map(|v| (10..200).step_by(3).map(move |d| (v, d))) {
                let (speed_mps, to_conflict_m) = (f64::from(tenths_mps) / 10.0, f64::from(tenths_m) / 10.0);
                let through_conflict_m = to_conflict_m + length_m;
                let motion = Motion { speed_mps, to_conflict_m, through_conflict_m, along_conflict_m };
                let crosses = |clear_m: &f64| {
                    let look = Look { gain_bits: 0.0, clear_m: *clear_m };
                    Approach::Look.drive(true, look, Some(motion), speeds).0 == ActionCode::Advance
                };
                // A vehicle that can no longer stop crosses in any case.
                let clear_m = (0..400).map(|half| f64::from(half) / 2.0).find(crosses).filter(|clear_m| *clear_m > 0.0);
                crossings += usize::from(clear_m.is_some_and(|clear_m| stays_ahead(motion, clear_m, speeds)));
            }
            assert!(crossings > 1000, "{crossings}");
        }
    }

    /// Drives through the conflict ahead of somebody who is at the end of the clear way.
    fn stays_ahead(motion: Motion, clear_m: f64, speeds: Speeds) -> bool {
        let (mut vehicle, mut time_s) = (Vehicle::at_start(motion.speed_mps), 0.0);
        while vehicle.at_m < motion.through_conflict_m {
            vehicle.substep(speeds.advance_mps, SUBSTEP_S);
            time_s += SUBSTEP_S;
            let ahead_m = motion.along_conflict_m - (motion.through_conflict_m - vehicle.at_m);
            let is_merging = motion.along_conflict_m > 0.0 && vehicle.at_m > motion.to_conflict_m;
            let is_ahead = !is_merging || time_s * speeds.others_mps < clear_m + ahead_m;
            assert!(is_ahead, "{motion:?}, {clear_m} m: {time_s} s");
        }
        assert!(time_s * speeds.others_mps < clear_m + motion.along_conflict_m, "{motion:?}: {time_s} s");
        true
    }
}
