//! What a frame shows of the others' lanes, and the value of a look from further on: the expected information of images
//! from poses ahead of the vehicle.

use crate::Frames;
use carff_checkpoint::FieldProbe;
use carff_config::GraphConfig;
use carff_decision::{Approach, Place, look_gain_bits};
use carff_messages::{Belief, EgoMotion, Header, LATENT_DIM, LookGain};
use carff_runtime::StageContext;
use carff_transport::{Publisher, Receiver, topics};
use carff_unknown::{Crossing, LaneVehicle, Lanes, Sight, Track};
use std::f64::consts::FRAC_PI_2;

/// Ways ahead of the vehicle from where a look is judged, metres.
const AHEAD_M: [f64; 4] = [1.5, 3.0, 4.5, 6.0];

/// Longest way that counts as clear, metres: no lane of a field is longer.
const MOST_CLEAR_M: f64 = 500.0;
/// Highest speed in a message, m/s.
const MOST_MPS: f64 = 100.0;

/// Publishes the value of a look from further on with each belief about the next step.
#[derive(Debug)]
pub struct Outlook {
    sight: Sight,
    states: Vec<[f32; LATENT_DIM]>,
    hazards: Vec<bool>,
    input: Receiver<EgoMotion>,
    output: Publisher<LookGain>,
    motion: Option<EgoMotion>,
    track: Track,
}

impl Outlook {
    /// Opens the topics; `None` where the controller does not ask.
    pub fn open(stage: &StageContext, probe: &FieldProbe) -> anyhow::Result<Option<Self>> {
        if !is_asked(&stage.graph) {
            return Ok(None);
        }
        let (input, output) = (stage.input(&topics::EGO_MOTION)?.polled(), stage.output(&topics::LOOK)?);
        let states = probe.states().iter().map(|state| state.mean).collect();
        let hazards = probe.layout().hazard_states().to_vec();
        Ok(Some(Self {
            sight: Sight::default(),
            states,
            hazards,
            input,
            output,
            motion: None,
            track: Track::default(),
        }))
    }

    /// Publishes the value of a look for the vehicle's motion and the camera of the belief's frame. Without one of them
    /// there is none.
    pub fn publish(
        &mut self,
        probe: &FieldProbe,
        frames: &Frames,
        belief: &Belief,
        StageContext { graph, threads, .. }: &StageContext,
    ) -> anyhow::Result<()> {
        while let Some(motion) = self.input.next()? {
            self.motion = Some(*motion);
        }
        let Some((camera, motion)) = frames.camera_of(&belief.header).zip(self.motion) else { return Ok(()) };
        let probabilities = &belief.state_probability[..self.states.len().min(belief.state_probability.len())];
        // More than all that is uncertain cannot be gained, and nothing needs to be rendered for nothing.
        let most = look_gain_bits(probabilities, &self.hazards, |a, b| a == b);
        let (mut gain_bits, mut ahead_m) = (0.0, 0.0);
        for at_m in AHEAD_M.into_iter().filter(|at_m| most > 0.0 && *at_m < motion.to_conflict_m) {
            let mut ahead = camera;
            ahead.world_from_camera[0][3] += at_m * motion.heading_rad.cos();
            ahead.world_from_camera[1][3] += at_m * motion.heading_rad.sin();
            let lanes: &Lanes = frames.lanes();
            if !self.sight.look(frames.without_own(probe), &self.states, lanes, &ahead, *threads) {
                continue;
            }
            let gain = look_gain_bits(probabilities, &self.hazards, |a, b| self.sight.alike(a, b));
            if gain > gain_bits {
                (gain_bits, ahead_m) = (gain, at_m);
            }
        }
        let clear_m = clear_m(probe, frames, belief, &motion).min(MOST_CLEAR_M);
        let (vehicles, heading_rad) = vehicles(probe, frames, belief, &motion);
        let Header { frame_id, capture_time_ns, .. } = belief.header;
        let speed_mps = self.track.see(graph.frame_time_s(frame_id, capture_time_ns), vehicles.first());
        let mut gain = LookGain {
            header: belief.header,
            gain_bits: gain_bits as f32,
            ahead_m: ahead_m as f32,
            clear_m: clear_m as f32,
            vehicles: vehicles.len() as u32,
            vehicle_mps: speed_mps.unwrap_or(0.0).clamp(-MOST_MPS, MOST_MPS) as f32,
            has_vehicle_mps: speed_mps.is_some().into(),
            ..LookGain::default()
        };
        if let Some(vehicle) = vehicles.first() {
            gain.vehicle_m = vehicle.center_m.map(|at| at as f32);
            gain.vehicle_within_m = (0.5 * (vehicle.range_m[1] - vehicle.range_m[0])) as f32;
            gain.vehicle_heading_rad = heading_rad as f32;
        }
        Ok(self.output.send(gain)?)
    }
}

/// The way along the lanes of the hazard's places that a belief's frame shows clear, metres: that of the least clear one.
fn clear_m(probe: &FieldProbe, frames: &Frames, belief: &Belief, motion: &EgoMotion) -> f64 {
    let Some(sighting) = frames.sighting(&belief.header) else { return 0.0 };
    let places = probe.layout().hazard_places();
    places.map(|place| sighting.clear_m(&crossing(place, motion), &place.occupied_in)).reduce(f64::min).unwrap_or(0.0)
}

/// The vehicles on the lane of the hazard's first place in a belief's frame, the next to the crossing first, and the
/// lane's heading, radians.
fn vehicles(probe: &FieldProbe, frames: &Frames, belief: &Belief, motion: &EgoMotion) -> (Vec<LaneVehicle>, f64) {
    let Some((sighting, place)) = frames.sighting(&belief.header).zip(probe.layout().hazard_places().next()) else {
        return (Vec::new(), 0.0);
    };
    (sighting.vehicles(&crossing(place, motion)), place.oriented_box.yaw)
}

/// The lane of a place, and the point of it that is next to the place where the vehicle gets in the way of others.
fn crossing(place: &Place, motion: &EgoMotion) -> Crossing {
    let heading_rad = place.oriented_box.yaw + FRAC_PI_2;
    Crossing { place: place.oriented_box, from_m: motion.crossing_m, heading_rad }
}

fn is_asked(graph: &GraphConfig) -> bool {
    graph.controller.approach == Approach::Look
}
