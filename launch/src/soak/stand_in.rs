//! A camera whose images are bad: a process that stops the camera and publishes in its place. No stage knows it.

use super::graph::Victim;
use super::seen::{LINGER, seen};
use anyhow::Context;
use carff_base::random::Key;
use carff_config::FaultKind;
use carff_dataset::{Corruption, Image};
use carff_messages::{Header, ImageCondition, Stage};
use carff_transport::{Node, Stop, Waiter, Woken, monotonic_now_ns, topics};
use rustix::process::Signal;

/// Passes of the strongest defocus of [`Corruption`]: at most a tenth of a trained image's sharpness remains.
const DEFOCUS_PASSES: usize = 16;
/// Value of a covered pixel.
const COVERED: u8 = 12;
/// Share of its light that an underexposed pixel keeps, and of its distance from white that an overexposed one keeps.
const DARK: f32 = 0.15;
const BRIGHT: f32 = 0.12;
/// Smallest and largest jump of the capture times, nanoseconds.
const JUMP_NS: [u64; 2] = [3_000_000_000, 60_000_000_000];
/// Smallest and largest time between two images, nanoseconds.
const PERIOD_NS: [u64; 2] = [1_000_000, 1_000_000_000];

/// Returns the condition of the images of a fault; `None` if the fault does not stand in for the camera.
pub(super) fn condition(kind: FaultKind) -> Option<ImageCondition> {
    Some(match kind {
        FaultKind::Black => ImageCondition::Black,
        FaultKind::White => ImageCondition::White,
        FaultKind::Frozen => ImageCondition::Frozen,
        FaultKind::Covered => ImageCondition::Covered,
        FaultKind::Unfocused => ImageCondition::Unfocused,
        FaultKind::Underexposed => ImageCondition::Underexposed,
        FaultKind::Overexposed => ImageCondition::Overexposed,
        FaultKind::ClockStall | FaultKind::ClockJump => ImageCondition::Clock,
        _ => return None,
    })
}

/// Stops the camera, prints the number of the first bad frame, waits for a line, and publishes bad frames at the
/// camera's rate until SIGTERM. The camera then continues.
pub(super) fn run(node: &Node, kind: FaultKind, seed: u64) -> anyhow::Result<()> {
    let waiter = Waiter::new(Stop::on_signals()?);
    let mut frames = node.receiver(&topics::FRAME)?;
    let mut healths = node.receiver(topics::health(Stage::Camera))?;
    let seen = seen(&mut frames, &waiter)?;
    let period_ns = period_ns(&seen.iter().map(|(meta, _)| meta.header).collect::<Vec<_>>());
    let (mut meta, rgb) = seen
        .into_iter()
        .next_back()
        .context("no frame of the camera arrived: check with `carff probe top` that it publishes")?;
    let image = spoilt(kind, &Image { width_px: meta.width_px, height_px: meta.height_px, rgb })?;
    let mut output = node.image_publisher(&topics::FRAME, image.rgb.len())?;
    let pid = loop {
        if let Some(health) = healths.newest()? {
            break health.pid;
        }
        if waiter.wait_until(&[&healths], u64::MAX)? == Woken::Stopped {
            return Ok(());
        }
    };
    let camera = Stopped::new(pid)?;
    waiter.wait_until(&[], monotonic_now_ns() + period_ns)?;
    while let Some(frame) = frames.next()? {
        meta.header = frame.header;
    }
    println!("{}", meta.header.frame_id + 1);
    std::io::stdin().read_line(&mut String::new())?;
    let mut due_ns = monotonic_now_ns();
    while waiter.wait_until(&[], due_ns)? != Woken::Stopped {
        let now_ns = monotonic_now_ns();
        meta.header.frame_id += 1;
        meta.header.capture_time_ns = capture_time_ns(kind, meta.header.capture_time_ns, now_ns, seed);
        let mut loan = output.loan(image.rgb.len())?;
        loan.bytes_mut().copy_from_slice(&image.rgb);
        flicker(kind, meta.header.frame_id, loan.bytes_mut());
        output.send_image(loan, meta)?;
        due_ns = (due_ns + period_ns).max(now_ns);
    }
    drop(camera);
    std::thread::sleep(LINGER);
    Ok(())
}

/// A stopped process, which continues when this is dropped.
struct Stopped(Victim);

impl Stopped {
    fn new(pid: u32) -> anyhow::Result<Self> {
        let victim = Victim::new(pid)?;
        anyhow::ensure!(victim.signal(Signal::STOP), "the camera has ended");
        Ok(Self(victim))
    }
}

impl Drop for Stopped {
    fn drop(&mut self) {
        self.0.signal(Signal::CONT);
    }
}

/// Returns the mean time between frames in order, nanoseconds.
fn period_ns(headers: &[Header]) -> u64 {
    let [least, most] = PERIOD_NS;
    let ends = headers.first().zip(headers.last());
    let mean = ends.and_then(|(first, last)| {
        let between_ns = last.capture_time_ns.saturating_sub(first.capture_time_ns);
        between_ns.checked_div(last.frame_id.saturating_sub(first.frame_id))
    });
    mean.unwrap_or(most).clamp(least, most)
}

/// Returns the image of a bad camera that looks at an image. Bad clocks and a frozen camera leave it unchanged.
fn spoilt(kind: FaultKind, image: &Image) -> anyhow::Result<Image> {
    let mapped = |value: &dyn Fn(u8) -> f32| {
        let rgb = image.rgb.iter().map(|&v| value(v).round() as u8).collect();
        Image { rgb, ..*image }
    };
    Ok(match kind {
        FaultKind::Black => mapped(&|_| 0.0),
        FaultKind::White => mapped(&|_| 255.0),
        FaultKind::Underexposed => mapped(&|v| DARK * f32::from(v)),
        FaultKind::Overexposed => mapped(&|v| 255.0 - BRIGHT * (255.0 - f32::from(v))),
        FaultKind::Covered => {
            let mut covered = image.clone();
            covered.paste(&Image::filled(image.width_px.div_ceil(2), image.height_px, [COVERED; 3]), 0, 0);
            covered
        }
        FaultKind::Unfocused => {
            let severity = *Corruption::DefocusBlur.severities().end();
            let key = Key { seed: 0, frame: 0, step: 0, sample: 0 };
            let blur = |image: Image, _| Corruption::DefocusBlur.apply(&image, severity, key);
            (0..DEFOCUS_PASSES).try_fold(image.clone(), blur)?
        }
        _ => image.clone(),
    })
}

/// Changes the brightness of every second image by one step, so that only a frozen camera repeats its images.
fn flicker(kind: FaultKind, frame_id: u64, rgb: &mut [u8]) {
    if kind != FaultKind::Frozen && frame_id.is_multiple_of(2) {
        for value in rgb {
            *value = value.saturating_add(1);
        }
    }
}

/// Returns the capture time of a frame: the one before for a clock that stands still, and far from now, forward or back,
/// for a clock that has jumped.
fn capture_time_ns(kind: FaultKind, before_ns: u64, now_ns: u64, seed: u64) -> u64 {
    let [least_ns, most_ns] = JUMP_NS;
    let jump_ns = least_ns + seed % (most_ns - least_ns);
    match kind {
        FaultKind::ClockStall => before_ns,
        FaultKind::ClockJump if seed & (1 << 62) == 0 => now_ns.saturating_sub(jump_ns),
        FaultKind::ClockJump => now_ns + jump_ns,
        _ => now_ns,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use carff_messages::ImageCheck;
    use carff_unknown::{CameraCheck, CameraLimits, Measured, Measurement};

    const MS: u64 = 1_000_000;
    const FIELD_OF_VIEW_DEG: [f64; 2] = [60.0; 2];

    /// A bright sky over a darker ground, with blocks in front, as bright as trained images are.
    fn scene() -> Image {
        let mut image = Image::filled(128, 128, [210; 3]);
        image.paste(&Image::filled(128, 64, [110; 3]), 0, 64);
        for i in 0..60 {
            let value = 80 + (i * 37 % 120) as u8;
            image.paste(&Image::filled(9 + i % 7, 5 + i % 11, [value; 3]), i * 53 % 120, i * 29 % 120);
        }
        image
    }

    fn limits() -> CameraLimits {
        CameraLimits::fit(&[Measured::of(scene().view().unwrap())], FIELD_OF_VIEW_DEG)
    }

    /// Returns the conditions of a good image at 20 Hz and the bad ones after it, over half a second.
    fn conditions(kind: FaultKind, seed: u64) -> Vec<ImageCondition> {
        let mut check = CameraCheck::new(Some(limits()), Some(300 * MS));
        let (good, bad) = (scene(), spoilt(kind, &scene()).unwrap());
        let mut captured_ns = 0;
        let checked = (0..11).map(|i| {
            let mut image = if i == 0 { good.clone() } else { bad.clone() };
            flicker(kind, i, &mut image.rgb);
            let now_ns = (100_000 + 50 * i) * MS;
            captured_ns = if i == 0 { now_ns } else { capture_time_ns(kind, captured_ns, now_ns, seed) };
            let frame = Measurement {
                capture_time_ns: captured_ns,
                now_ns: now_ns + 5 * MS,
                field_of_view_deg: FIELD_OF_VIEW_DEG,
                has_pose: true,
            };
            let mut message = ImageCheck::of_frame(Header::of_frame(i, captured_ns, 1));
            check.check(image.view().unwrap(), frame, &mut message);
            message.condition().unwrap()
        });
        checked.collect()
    }

    /// Each bad camera has its condition from its first image on; a frozen one after the limit.
    #[test]
    fn bad_cameras_have_their_condition() {
        for kind in FaultKind::ALL.iter().copied().filter(|&kind| condition(kind).is_some()) {
            let wanted = condition(kind).unwrap();
            let good = if kind == FaultKind::Frozen { 6 } else { 1 };
            for seed in [7, u64::MAX / 2 + 3, u64::MAX] {
                let found = conditions(kind, seed);
                assert!(found[..good].iter().all(|&c| c == ImageCondition::Usable), "{}: {found:?}", kind.name());
                assert!(found[good + 1..].iter().all(|&c| c == wanted), "{}: {found:?}", kind.name());
                assert!(kind == FaultKind::Frozen || found[good] == wanted, "{}: {found:?}", kind.name());
            }
        }
    }

    /// The period is the mean over frame numbers, and bounded for a single frame.
    #[test]
    fn the_period_is_measured() {
        let frame = |id: u64| Header::of_frame(id, id * 50 * MS, 1);
        assert_eq!(period_ns(&[frame(3), frame(4), frame(7)]), 50 * MS);
        assert_eq!((period_ns(&[frame(3)]), period_ns(&[])), (PERIOD_NS[1], PERIOD_NS[1]));
    }
}
