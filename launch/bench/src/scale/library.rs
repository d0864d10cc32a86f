//! Axes that are measured on library functions: side of a rendered view, and number of probed places. They run on one
//! thread, as in the stages by default.

use super::{Axis, Law, Row};
use crate::stats::{Contender, Times, alternate, timed};
use anyhow::ensure;
use carff_base::geometry::PinholeCamera;
use carff_checkpoint::{FieldProbe, Manifest, PreparedField, load_field_probe};
use carff_decision::{Draw, Mixture, Place, ProbeCalibration, ProbeLayout};
use carff_field::{Field, LATENT_DIM, RenderBuffer, RenderOptions};
use rustix::time::{ClockId, clock_gettime};
use std::cell::RefCell;
use std::path::Path;

const SIDES_PX: [u32; 7] = [32, 48, 64, 96, 128, 192, 256];
const SIDES_PX_QUICK: [u32; 4] = [32, 64, 128, 256];
/// Numbers of places. A message has at most 48; the library has no limit.
const PLACES: [u32; 8] = [1, 2, 4, 8, 16, 24, 32, 64];
const PLACES_QUICK: [u32; 4] = [1, 8, 32, 64];
/// Number of probed hypotheses: the default number of samples.
const HYPOTHESES: usize = 10;
/// Shift of repeated places, metres, so that all points differ.
const SHIFT_M: f64 = 0.31;

/// Measures the time of rendering over the side of a view.
pub(crate) fn views(checkpoint: &Path, quick: bool) -> anyhow::Result<Axis> {
    let manifest = Manifest::load(checkpoint)?;
    let field = carff_checkpoint::load_field(checkpoint, &manifest)?;
    let states: Vec<[f32; LATENT_DIM]> = manifest.states.iter().map(|s| s.mean).collect();
    ensure!(!states.is_empty(), "checkpoint {} has no states", checkpoint.display());
    let (sides, rounds): (&[u32], _) = if quick { (&SIDES_PX_QUICK, 2) } else { (&SIDES_PX, 40) };
    let options = RenderOptions { threads: 1, ..RenderOptions::default() };
    let rows = measured(sides, rounds, |side_px| {
        let bounds_m = field.config().bounds_m.map(|corner| corner.map(f64::from));
        let camera = PinholeCamera::above(bounds_m, side_px, side_px);
        let (field, states) = (&field, &states);
        let (mut buffer, mut turn) = (RenderBuffer::new(), 0);
        Ok(move || {
            field.render(&camera, &states[turn % states.len()], &options, &mut buffer);
            turn += 1;
        })
    })?;
    Ok(Axis {
        key: "view",
        title: "Rendered view: bird's-eye, one thread",
        x_label: "side of the view (px)",
        each: "px",
        law: Law::Power,
        cost_key: "cpu_ms",
        cost_label: "CPU (ms per view)",
        rows,
    })
}

/// Measures the time of probing over the number of places.
pub(crate) fn candidates(checkpoint: &Path, quick: bool) -> anyhow::Result<Axis> {
    let manifest = Manifest::load(checkpoint)?;
    let mut base = load_field_probe(checkpoint, &manifest)?;
    ensure!(!manifest.states.is_empty(), "checkpoint {} has no states", checkpoint.display());
    let seen: Vec<Vec<f32>> = manifest.states.iter().map(|s| base.probe(&s.mean).occupancies).collect();
    let (counts, rounds): (&[u32], _) = if quick { (&PLACES_QUICK, 20) } else { (&PLACES, 200) };
    let latents: Vec<[f32; LATENT_DIM]> =
        (0..HYPOTHESES).map(|i| manifest.states[i % manifest.states.len()].mean).collect();
    let mut rows = measured(counts, rounds, |count| {
        let places = repeated(base.layout().places(), count as usize);
        let layout = ProbeLayout::new(places, base.layout().hazard_states().to_vec())?;
        // The occupancies of the repeated places; their fit does not affect the speed.
        let seen: Vec<Vec<f32>> =
            seen.iter().map(|row| row.iter().copied().cycle().take(count as usize).collect()).collect();
        let calibration = ProbeCalibration::fit(&layout, &seen)?;
        let field = PreparedField::new(Field::clone(base.field()), &layout);
        let mut probe = FieldProbe::new(field, layout, calibration, manifest.states.clone());
        let latents = &latents;
        Ok(move || {
            let mixture = Mixture { weights: Vec::new(), components: Vec::new() };
            let draws = latents.iter().map(|z| Draw { latent: *z, component: 0 }).collect();
            std::hint::black_box(probe.step(mixture, draws, 1.0, None));
        })
    })?;
    let points_a_place = base.layout().points().len() as f64 / base.layout().places().len() as f64;
    for row in &mut rows {
        row.more.push(("points", f64::from(row.x) * points_a_place));
    }
    Ok(Axis {
        key: "candidates",
        title: "Candidates: probing 10 hypotheses, one thread",
        x_label: "places probed",
        each: "place",
        law: Law::Linear,
        cost_key: "cpu_ms",
        cost_label: "CPU (ms per step)",
        rows,
    })
}

/// Returns `count` places: the given ones repeatedly, with a shift per repetition.
fn repeated(places: &[Place], count: usize) -> Vec<Place> {
    let moved = |i: usize, place: &Place| {
        let mut place = place.clone();
        place.oriented_box.center[0] += SHIFT_M * (i / places.len()) as f64;
        place
    };
    places.iter().cycle().take(count).enumerate().map(|(i, place)| moved(i, place)).collect()
}

/// Measures an action for all values alternately: wall-clock time, and processor time of the whole process.
fn measured<A: FnMut()>(
    values: &[u32],
    rounds: usize,
    mut action_of: impl FnMut(u32) -> anyhow::Result<A>,
) -> anyhow::Result<Vec<Row>> {
    let cpu_ms: Vec<RefCell<Vec<f64>>> = vec![RefCell::default(); values.len()];
    let mut contenders: Vec<Contender<'_>> = Vec::new();
    for (value, cpu_ms) in values.iter().zip(&cpu_ms) {
        let mut clock = timed(action_of(*value)?);
        contenders.push(Box::new(move || {
            let before_s = process_cpu_s();
            let seconds = clock();
            cpu_ms.borrow_mut().push((process_cpu_s() - before_s) * 1e3);
            seconds
        }));
    }
    let seconds = alternate(rounds, &mut contenders);
    drop(contenders);
    let milliseconds = |seconds: Vec<f64>| Times::new(seconds.iter().map(|s| s * 1e3).collect());
    Ok(values
        .iter()
        .zip(seconds.into_iter().zip(cpu_ms))
        .map(|(value, (seconds, cpu_ms))| {
            Row::new(*value, &milliseconds(seconds), Times::new(cpu_ms.into_inner()).median())
        })
        .collect())
}

fn process_cpu_s() -> f64 {
    let now = clock_gettime(ClockId::ProcessCPUTime);
    now.tv_sec as f64 + now.tv_nsec as f64 * 1e-9
}

#[cfg(test)]
mod tests {
    use super::*;
    use carff_base::geometry::OrientedBox;

    /// Any number of places is possible: first the given ones, then shifted copies.
    #[test]
    fn places_are_repeated_but_never_the_same() {
        let place = |x: f64| Place {
            name: "place".into(),
            oriented_box: OrientedBox { center: [x, 0.0, 0.0], half_size: [1.0; 3], yaw: 0.0 },
            occupied_in: vec![true, false],
        };
        let given = [place(0.0), place(100.0), place(200.0)];
        assert_eq!(repeated(&given, 2), given[..2]);
        let many = repeated(&given, 8);
        assert_eq!(many[..3], given);
        assert_eq!(many.len(), 8);
        for (i, a) in many.iter().enumerate() {
            assert!(many[i + 1..].iter().all(|b| a.oriented_box != b.oriented_box), "{i}");
        }
    }

    /// Each value is measured once per round, in order, and both clocks run.
    #[test]
    fn every_value_is_measured() {
        let rows = measured(&[3, 5], 4, |count| {
            Ok(move || {
                std::hint::black_box((0..u64::from(count) * 100_000).fold(0_u64, |a, b| a ^ b.wrapping_mul(a + 1)));
            })
        })
        .unwrap();
        assert_eq!(rows.iter().map(|r| (r.x, r.counted)).collect::<Vec<_>>(), [(3, 4), (5, 4)]);
        assert!(rows.iter().all(|r| r.p50_ms > 0.0 && r.max_ms >= r.p99_ms && r.cost > 0.0));
    }
}
