//! Test of the forecaster's memory on the shipped checkpoint, with a test in place of the encoder.

#![allow(clippy::unwrap_used, reason = "a helper of a test fails it by panicking")]

use carff_checkpoint::Manifest;
use carff_messages::{Forecast, Gaussian, Header, Health, HealthState, Posterior, Stage};
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
        let mut found = None;
        let came = eventually(|| {
            while let Some(forecast) = self.forecasts.next().unwrap() {
                if forecast.header.frame_id == frame {
                    found = Some(*forecast);
                }
            }
            found.is_some()
        });
        assert!(came, "no forecast of frame {frame}:\n{}", self.forecaster.text());
        found.unwrap()
    }
}

/// A forecaster that is killed in mid-take takes the belief up again from shared memory: it continues with the same
/// forecasts, bit for bit, as one that was not killed.
#[test]
fn a_killed_forecaster_remembers_its_take() {
    let states = Manifest::load(&shipped_checkpoint()).unwrap().states;
    // One state in sight, then views between two states.
    let between = Gaussian {
        mean: std::array::from_fn(|i| f32::midpoint(states[0].mean[i], states[3].mean[i])),
        log_variance: [0.0; 8],
    };
    let image = |frame: u64| if frame < 3 { states[0] } else { between };
    let (mut killed, mut undisturbed) = (Bench::new(), Bench::new());
    for frame in 0..IMAGES {
        if frame == KILLED_AFTER {
            killed.kill();
        }
        let [one, other] = [&mut killed, &mut undisturbed].map(|bench| bench.forecast(frame, image(frame)));
        assert_eq!((one.images, other.images), (frame + 1, frame + 1), "{}", killed.forecaster.text());
        assert_eq!((one.weights, one.components), (other.weights, other.components), "frame {frame}");
        assert_eq!(one.samples, other.samples, "frame {frame}");
    }
}
