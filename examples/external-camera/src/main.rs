//! A camera in a process of its own: publishes the images of a dataset with their poses, again and again, to a
//! graph with `camera.source = "external"`. Usage: `external-camera DATASET [RUN] [FRAMES_PER_SECOND]`.

use anyhow::{Context, ensure};
use carff_dataset::Dataset;
use carff_messages::{DatasetView, FrameMeta, Header, ImageMeta, Stage};
use carff_observe::{Attached, attach};
use carff_transport::{Stop, Waiter, Woken, monotonic_now_ns, topics};

fn main() -> anyhow::Result<()> {
    let mut args = std::env::args().skip(1);
    let folder = args.next().context("usage: external-camera DATASET [RUN] [FRAMES_PER_SECOND]")?;
    let run = args.next();
    let rate_hz: f64 = args.next().map_or(Ok(10.0), |text| text.parse()).context("FRAMES_PER_SECOND")?;
    ensure!((0.1..=1000.0).contains(&rate_hz), "FRAMES_PER_SECOND is {rate_hz}; allowed: 0.1 to 1000");
    let dataset = Dataset::open(folder.as_ref())?;
    let images = dataset.load_all_images()?;
    let largest = images.iter().map(|image| image.rgb.len()).max().context("the dataset has no images")?;

    let Attached { node, live } = attach(run.as_deref(), "external-camera")?;
    let mut frames = node.image_publisher(&topics::FRAME, largest)?;
    let waiter = Waiter::new(Stop::on_signals()?);
    // Frame numbers never repeat in a run: a restarted camera continues after the last frame, which the launcher's
    // heartbeat for this camera names. At the first start nothing has been published.
    let mut healths = node.receiver(topics::health(Stage::Camera))?;
    let until_ns = monotonic_now_ns() + 1_000_000_000;
    let first_id = loop {
        if let Some(health) = healths.newest()? {
            break if health.published > 0 { health.header.frame_id + 1 } else { 0 };
        }
        if matches!(waiter.wait_until(&[&healths], until_ns)?, Woken::Timeout | Woken::Stopped) {
            break 0;
        }
    };
    println!("joined run `{}`", live.name);
    let mut next_ns = monotonic_now_ns();
    for (frame_id, (image, frame)) in (first_id..).zip(images.iter().zip(dataset.frames()).cycle()) {
        if waiter.wait_until(&[], next_ns)? == Woken::Stopped || !live.is_alive() {
            break;
        }
        next_ns = monotonic_now_ns() + (1e9 / rate_hz) as u64;
        // Lens and pose. A camera's own come from its calibration, and from how it is mounted.
        let mut meta = FrameMeta::of_camera(&frame.camera, DatasetView::UNKNOWN);
        meta.header = Header::of_frame(frame_id, monotonic_now_ns(), 0);
        let mut loan = frames.loan(meta.image_bytes())?;
        loan.bytes_mut().copy_from_slice(&image.rgb);
        frames.send_image(loan, meta)?;
    }
    println!("left run `{}`", live.name);
    Ok(())
}
