//! Test of the forecaster's memory on the shipped checkpoint, with a test in place of encoder and prober.

#![allow(clippy::unwrap_used, reason = "a helper of a test fails it by panicking")]

use carff_checkpoint::Manifest;
use carff_messages::{Belief, Forecast, Gaussian, Header, Health, HealthState, Posterior, Stage, Unknowns};
use carff_tests::{Process, TestGraph, eventually, shipped_checkpoint};
use carff_transport::{Node, Publisher, Receiver, topics};
use rustix::process::Signal;
use std::path::Path;

/// Images of the take.
const IMAGES: u64 = 14;
/// Image after which the forecaster is killed.
const KILLED_AFTER: u64 = 8;

/// A forecaster with a memory, and the topics next to it.
struct Bench {
    graph: TestGraph,
    posteriors: Publisher<Posterior>,
    comparisons: Publisher<Unknowns>,
    beliefs: Publisher<Belief>,
    forecasts: Receiver<Forecast>,
    health: Receiver<Health>,
    forecaster: Process,
    _node: Node,
}

impl Bench {
    fn new() -> Self {
        let graph = TestGraph::new(Path::new("none"), &shipped_checkpoint(), "memory = \"filter\"\n");
        let node = Node::open(graph.run(), "test").unwrap();
        let mut bench = Self {
            posteriors: node.publisher(&topics::POSTERIOR).unwrap(),
            comparisons: node.publisher(&topics::UNKNOWN).unwrap(),
            beliefs: node.publisher(&topics::BELIEF).unwrap(),
            forecasts: node.receiver(&topics::FORECAST).unwrap(),
            health: node.receiver(topics::health(Stage::Forecaster)).unwrap(),
            forecaster: graph.stage(Stage::Forecaster),
            graph,
            _node: node,
        };
        bench.wait_until_ready();
        bench
    }

    fn wait_until_ready(&mut self) {
        let pid = self.forecaster.id();
        let ready = |health: &Health| health.state == HealthState::Ok.code() && health.pid == pid;
        let came = eventually(|| self.health.newest().unwrap().is_some_and(|health| ready(&health)));
        assert!(came, "{}", self.forecaster.text());
    }

    /// Kills the forecaster, and starts another one.
    fn kill(&mut self) {
        self.forecaster.signal(Signal::KILL);
        self.forecaster = self.graph.stage(Stage::Forecaster);
        self.wait_until_ready();
    }

    /// Publishes the posterior of a frame and returns its forecast.
    fn forecast(&mut self, frame: u64, gaussian: Gaussian) -> Forecast {
        let header = Header::of_frame(frame, 1 + frame * 100_000_000, 1);
        self.posteriors.send(Posterior { header, gaussian, take_start: 0, stage_latency_ns: 0 }).unwrap();
        self.next(frame, 1)
    }

    /// Waits for the forecast of a frame's step.
    fn next(&mut self, frame: u64, step: u32) -> Forecast {
        let mut found = None;
        let came = eventually(|| {
            while let Some(forecast) = self.forecasts.next().unwrap() {
                if (forecast.header.frame_id, forecast.header.step) == (frame, step) {
                    found = Some(*forecast);
                }
            }
            found.is_some()
        });
        assert!(came, "no forecast of frame {frame}:\n{}", self.forecaster.text());
        found.unwrap()
    }

    /// Publishes the comparison of a frame: an image that shows each place as `shown`.
    fn compare(&mut self, frame: u64, shown: &[f32]) {
        let header = Header::of_frame(frame, 1 + frame * 100_000_000, 1);
        let mut unknowns = Unknowns { place_count: shown.len() as u32, ..Unknowns::of_frame(header) };
        unknowns.places[..shown.len()].copy_from_slice(shown);
        self.comparisons.send(unknowns).unwrap();
    }
}

/// A forecaster that is killed in mid-take takes the belief up again from shared memory. It gets the comparisons of its images
/// with the prober's next one: from then on it continues with the same forecasts, bit for bit, as one that was not killed.
#[test]
fn a_killed_forecaster_remembers_its_take() {
    let manifest = Manifest::load(&shipped_checkpoint()).unwrap();
    let (states, hazards) = (manifest.states, manifest.scenario.hazard_states());
    // Views between two states, of which the images show one: the place that the first state takes, and the other does not.
    let between = Gaussian {
        mean: std::array::from_fn(|i| f32::midpoint(states[0].mean[i], states[3].mean[i])),
        log_variance: [0.0; 8],
    };
    let shown = manifest.places.iter().map(|place| place.occupied_in[0] && !place.occupied_in[3]);
    let shown: Vec<f32> = shown.map(f32::from).collect();
    assert!(shown.contains(&1.0));
    let (mut killed, mut undisturbed) = (Bench::new(), Bench::new());
    for frame in 0..IMAGES {
        if frame == KILLED_AFTER {
            killed.kill();
        }
        let [one, other] = [&mut killed, &mut undisturbed].map(|bench| bench.forecast(frame, between));
        assert_eq!((one.images, other.images), (frame + 1, frame + 1), "{}", killed.forecaster.text());
        if frame != KILLED_AFTER {
            assert_eq!((one.weights, one.components), (other.weights, other.components), "frame {frame}");
            assert_eq!(one.samples, other.samples, "frame {frame}");
            assert_eq!(one.state_weights(), other.state_weights(), "frame {frame}");
        }
        // The comparison of an image counts from the next image on.
        let hazard: f32 =
            other.state_weights().iter().zip(&hazards).filter(|(_, hazard)| **hazard).map(|(w, _)| w).sum();
        let expected = if frame > 2 { 0.9..=1.0 } else { 0.3..=0.8 };
        assert!(expected.contains(&hazard), "frame {frame}: {:?}", other.state_weights());
        let nothing = vec![0.0; shown.len()];
        let image = if frame == 2 { &shown } else { &nothing };
        for bench in [&mut killed, &mut undisturbed] {
            bench.compare(frame, image);
        }
    }
}

/// All steps of a frame have the same weights of the present states: the prober weighs each by the frame's image.
#[test]
fn all_steps_have_the_weights() {
    let states = Manifest::load(&shipped_checkpoint()).unwrap().states;
    let mut bench = Bench::new();
    let first = bench.forecast(0, states[1]);
    assert_eq!(first.state_weights().len(), states.len());
    let mut belief = Belief::empty(Header::of_frame(0, 1, 1).at_step(1), 2);
    (belief.state_count, belief.place_count) = (states.len() as u32, 1);
    (belief.component_count, belief.sample_count) = (1, 1);
    (belief.component_weights[0], belief.state_probability[2]) = (1.0, 1.0);
    (belief.resolved_state, belief.resolved) = (2, states[2]);
    bench.beliefs.send(belief).unwrap();
    assert_eq!(bench.next(0, 2).state_weights(), first.state_weights());
}
