//! The comparison of images with the known states of the shipped checkpoint.

#![allow(clippy::unwrap_used, reason = "a helper of a test fails it by panicking")]

use carff_base::geometry::PinholeCamera;
use carff_checkpoint::FieldProbe;
use carff_decision::ImageEvidence;
use carff_field::{RenderBuffer, RenderOptions};
use carff_messages::{DatasetView, Forecast, ForecastSource, FrameMeta, Header, Message};
use carff_prober::{Images, load};
use ndarray::{Array3, s};
use std::path::{Path, PathBuf};

const MS: u64 = 1_000_000;
const SIDE: usize = 128;

fn checkpoint() -> PathBuf {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).ancestors().nth(2).unwrap();
    root.join("configs/checkpoints/approaching-intersection")
}

/// A camera across the road, which has the actor's places in full view. Its image's middle shows the lane at (-10, -2).
fn lane() -> PinholeCamera {
    PinholeCamera::look_at([-10.0, 10.0, 7.0], [-10.0, -2.0, 0.0], [0.0, 0.0, 1.0], 128, 128, 70.0)
}

/// A frame that this camera took at a time.
fn frame(id: u64, at_ms: u64) -> FrameMeta {
    FrameMeta { header: Header::of_frame(id, at_ms * MS, 1), ..FrameMeta::of_camera(&lane(), DatasetView::UNKNOWN) }
}

/// A forecast of a frame's image, without a memory.
fn forecast(id: u64, at_ms: u64) -> Forecast {
    Forecast::empty(Header::of_frame(id, at_ms * MS, 1).at_step(1), ForecastSource::Observed, 1)
}

/// An image of a known state, as the field renders it.
fn image_of(probe: &FieldProbe, state: usize) -> Array3<u8> {
    image_from(&lane(), probe, state)
}

fn image_from(camera: &PinholeCamera, probe: &FieldProbe, state: usize) -> Array3<u8> {
    let mut rendered = RenderBuffer::new();
    let options = RenderOptions::default();
    probe.field().render(camera, &probe.states()[state].mean, &options, &mut rendered);
    Array3::from_shape_fn((SIDE, SIDE, 3), |(y, x, c)| {
        (rendered.rgb[(y * SIDE + x) * 3 + c].clamp(0.0, 1.0) * 255.0) as u8
    })
}

/// The image with a bright patch on the lane.
fn patched(image: &Array3<u8>) -> Array3<u8> {
    let mut patched = image.clone();
    patched.slice_mut(s![56..74, 50..78, ..]).fill(230);
    patched
}

/// An image of a known state has no unknown box. The same image with a bright patch on the lane has one, where the patch
/// is. A belief only uses the comparison of its own image.
#[test]
fn a_patch_on_the_lane_is_unknown() {
    let (probe, _) = load(&checkpoint()).unwrap();
    let known = image_of(&probe, probe.states().len() - 1);
    let patched = patched(&known);
    let mut images = Images::load(&checkpoint(), &probe, true).unwrap().unwrap();
    let before = images.compare(&probe, &frame(1, 100), known.view(), 1).unwrap();
    before.validate().unwrap();
    assert!(before.probability < 0.05 && before.boxes().is_empty(), "{before:?}");
    let after = images.compare(&probe, &frame(2, 200), patched.view(), 1).unwrap();
    after.validate().unwrap();
    assert!(after.probability > 0.5 && after.residual > 1.0, "{after:?}");
    let [x, y, _] = after.boxes()[0].center;
    assert!((x + 10.0).abs() < 2.5 && (y + 2.0).abs() < 3.0, "{:?}", after.boxes());

    let evidence = |images: &Images, id, at_ms: u64| images.evidence(&forecast(id, at_ms), probe.layout());
    assert!(evidence(&images, 2, 200).is_some());
    assert!(evidence(&images, 3, 210).is_none());

    // By a wrong pose the camera sees no lane: the image is then a view of another place.
    let sky = PinholeCamera::look_at([-8.0, -12.0, 9.0], [-8.0, -60.0, 60.0], [0.0, 0.0, 1.0], 128, 128, 60.0);
    for (id, image) in [(3, &known), (4, &patched)] {
        let frame =
            FrameMeta { header: frame(id, 100 * id).header, ..FrameMeta::of_camera(&sky, DatasetView::UNKNOWN) };
        let wrong = images.compare(&probe, &frame, image.view(), 1).unwrap();
        wrong.validate().unwrap();
        assert!(wrong.probability > 0.9 && wrong.ratios().iter().all(|ratio| *ratio == 0.0), "{wrong:?}");
        assert!(wrong.places().iter().all(|shown| *shown == 0.0), "another place shows none of ours: {wrong:?}");
    }

    // By a right pose without lanes, every state explains the image.
    let building = PinholeCamera::look_at([-14.0, -4.0, 9.0], [-14.0, -14.0, 5.5], [0.0, 0.0, 1.0], 128, 128, 25.0);
    let own = image_from(&building, &probe, 0);
    let meta = FrameMeta { header: frame(6, 600).header, ..FrameMeta::of_camera(&building, DatasetView::UNKNOWN) };
    let right = images.compare(&probe, &meta, own.view(), 1).unwrap();
    let ground = images.lanes().ground_points(&building);
    assert!(ground.iter().flatten().all(|ground| !ground.on_lanes));
    assert!(right.probability < 0.05 && right.boxes().is_empty(), "{right:?}");

    // A pose that is not a pose gives no comparison.
    let lost = FrameMeta { world_from_camera: [0.0; 16], ..frame(5, 500) };
    assert!(images.compare(&probe, &lost, known.view(), 1).is_none());
    assert!(evidence(&images, 5, 500).is_none());
}

/// An image shows the place of its vehicle taken, and the others in view free, also if it is dimmed. Without a
/// memory, no place is looked at.
#[test]
fn an_image_shows_its_places() {
    let (probe, _) = load(&checkpoint()).unwrap();
    let mut images = Images::load(&checkpoint(), &probe, true).unwrap().unwrap();
    let actors: Vec<usize> = (0..probe.layout().places().len())
        .filter(|&place| probe.layout().hazard_places().any(|p| *p == probe.layout().places()[place]))
        .collect();
    assert_eq!(actors.len(), 3);
    let (mut taken, mut free) = (0, 0);
    for state in 0..probe.states().len() {
        let image = image_of(&probe, state).mapv(|v| (0.6 * f32::from(v) + 20.0) as u8);
        let unknowns = images.compare(&probe, &frame(state as u64, 100), image.view(), 1).unwrap();
        for &place in &actors {
            let shown = unknowns.places()[place];
            let is_taken = probe.layout().places()[place].occupied_in[state];
            assert!(if is_taken { shown >= 0.0 } else { shown <= 0.0 }, "state {state}, place {place}: {shown}");
            taken += usize::from(shown > 0.7);
            free += usize::from(shown < -0.7);
        }
    }
    assert!(taken >= 2 && free >= 8, "{taken} {free}");
    let mut forgets = Images::load(&checkpoint(), &probe, false).unwrap().unwrap();
    let unknowns = forgets.compare(&probe, &frame(1, 100), image_of(&probe, 0).view(), 1).unwrap();
    assert_eq!(unknowns.places(), [0.0; 0]);
}

/// With the weights of a forecast with a memory, the place that an image shows taken raises the belief in its states.
#[test]
fn places_weigh_a_belief_with_a_memory() {
    let (probe, _) = load(&checkpoint()).unwrap();
    let mut images = Images::load(&checkpoint(), &probe, true).unwrap().unwrap();
    let hazard = probe.layout().hazard_states().iter().position(|hazard| *hazard).unwrap();
    images.compare(&probe, &frame(1, 100), image_of(&probe, hazard).view(), 1).unwrap();
    let with_memory = |weights: &[f32]| {
        let mut forecast = forecast(1, 100);
        forecast.state_count = weights.len() as u32;
        forecast.hazard_by_places = 0.5;
        forecast.state_weights[..weights.len()].copy_from_slice(weights);
        images.evidence(&forecast, probe.layout()).unwrap().weigh(0.1, probe.layout().hazard_states()).0
    };
    let even = vec![1.0 / probe.states().len() as f32; probe.states().len()];
    assert!(with_memory(&even) > 0.95 && with_memory(&even) >= with_memory(&[]), "{}", with_memory(&even));
}

/// The evidence before a frame is that of its take's last compared frame; before a take's first one, and after a pause, nothing
/// is explained.
#[test]
fn evidence_of_the_frame_before() {
    let (probe, _) = load(&checkpoint()).unwrap();
    let mut images = Images::load(&checkpoint(), &probe, false).unwrap().unwrap();
    let known = image_of(&probe, 0);
    for (id, take_start, image) in [(1, 1, &known), (2, 1, &patched(&known)), (3, 3, &known)] {
        let meta = FrameMeta { take_start, ..frame(id, 100 * id) };
        assert!(images.compare(&probe, &meta, image.view(), 1).is_some());
    }
    let own = |id: u64| images.evidence(&forecast(id, 100 * id), probe.layout());
    let before = |id: u64, take_start| images.evidence_before(&forecast(id, 100 * id), take_start, probe.layout());
    assert!(own(1).is_some() && own(1) != own(2));
    assert_eq!([before(2, 1), before(3, 1), before(7, 1), before(4, 3)], [own(1), own(2), own(2), own(3)]);
    let nothing = ImageEvidence::unexplained(probe.states().len());
    assert!([before(1, 1), before(3, 3), before(8, 1)].iter().all(|evidence| evidence.as_ref() == Some(&nothing)));
}
