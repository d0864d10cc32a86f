//! Rendering of a scenario's cameras into a dataset.

use super::visibility::Shots;
use super::{ActorView, Detail, Extras, Rendering, Scenario};
use crate::cameras::ScenarioCamera;
use crate::error::ScenarioError;
use carff_dataset::{DatasetWriter, FrameRecord};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::collections::HashMap;
use std::hash::{DefaultHasher, Hash, Hasher};
use std::ops::ControlFlow;
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

impl Scenario {
    /// Renders every camera in every state into a posed dataset, in parallel. `progress` receives the number of
    /// finished images and of all images, from any thread, and may stop the work. `transforms.json` is written last, so
    /// a stopped run is not mistaken for a dataset; the next run continues with the remaining cameras.
    pub fn render_dataset(
        &self,
        out_dir: &Path,
        extras: Extras,
        progress: impl Fn(usize, usize) -> ControlFlow<()> + Sync,
    ) -> Result<(), ScenarioError> {
        let (writer, notes) = DatasetWriter::go_on::<ViewNote>(out_dir, &self.identity(extras))?;
        let states = self.info.state_count();
        let total = self.cameras.len() * states;
        let known = notes.into_iter().filter(|n| n.view < self.cameras.len() && n.actors.len() == states);
        let finished: HashMap<usize, Vec<Option<ActorView>>> = known.map(|n| (n.view, n.actors)).collect();
        let (done, stopped) = (AtomicUsize::new(finished.len() * states), AtomicBool::new(false));
        let of_view = |(view, camera): (usize, &ScenarioCamera)| -> Result<Vec<FrameRecord>, ScenarioError> {
            if let Some(actors) = finished.get(&view) {
                return Ok(self.records(view, camera, actors, extras));
            }
            let mut shots = Shots { scenario: self, camera: &camera.camera, taken: HashMap::new() };
            let mut actors = Vec::with_capacity(states);
            for timestamp in 0..self.info.timestamps {
                shots.taken.clear();
                for branch in 0..self.info.branches.len() {
                    if stopped.load(Ordering::Relaxed) {
                        return Err(ScenarioError::Stopped);
                    }
                    let placement = self.placement_for(camera, branch, timestamp)?;
                    let rendering = self.render_with(&mut shots, &placement, timestamp, Detail::Observability);
                    self.write_frame(&writer, &frame_name(branch, timestamp, view), &rendering, extras)?;
                    actors.push(rendering.actor);
                    if progress(done.fetch_add(1, Ordering::Relaxed) + 1, total).is_break() {
                        stopped.store(true, Ordering::Relaxed);
                    }
                }
            }
            let records = self.records(view, camera, &actors, extras);
            writer.note(&ViewNote { view, actors })?;
            Ok(records)
        };
        let by_view: Vec<_> = self.cameras.par_iter().enumerate().map(of_view).collect();
        let mut records = Vec::with_capacity(total);
        for of_view in by_view {
            records.extend(of_view?);
        }
        if stopped.load(Ordering::Relaxed) {
            return Err(ScenarioError::Stopped);
        }
        records.sort_by_key(|r| (r.branch_and_timestamp, r.view));
        writer.finish(&records, Some(&self.info))?;
        Ok(())
    }

    /// Returns a line that identifies the rendered content; the program's version represents the renderer.
    fn identity(&self, extras: Extras) -> String {
        let mut hasher = DefaultHasher::new();
        format!("{:?}", (&self.config, &self.cameras, extras)).hash(&mut hasher);
        format!("{} {} {:016x}", self.info.name, env!("CARGO_PKG_VERSION"), hasher.finish())
    }

    /// Returns the records of one camera's images, with the actor's visibility by time step, then branch.
    fn records(
        &self,
        view: usize,
        camera: &ScenarioCamera,
        actors: &[Option<ActorView>],
        extras: Extras,
    ) -> Vec<FrameRecord> {
        let states = (0..self.info.timestamps).flat_map(|t| (0..self.info.branches.len()).map(move |b| (b, t)));
        states
            .zip(actors)
            .map(|((branch, timestamp), actor)| {
                let name = frame_name(branch, timestamp, view);
                let with_extras = extras == Extras::DepthAndMasks;
                FrameRecord {
                    branch_and_timestamp: Some((branch, timestamp)),
                    view: Some(view),
                    view_kind: Some(camera.view_kind.clone()),
                    observability: actor.map(|a| a.observability),
                    visible_fraction: actor.map(|a| a.visible_fraction),
                    actor_px: actor.map(|a| a.actor_px),
                    depth_file_path: with_extras.then(|| format!("depth/{name}")),
                    mask_file_path: with_extras.then(|| format!("masks/{name}")),
                    ..FrameRecord::new(format!("images/{name}"), camera.camera)
                }
            })
            .collect()
    }

    fn write_frame(
        &self,
        writer: &DatasetWriter,
        name: &str,
        rendering: &Rendering,
        extras: Extras,
    ) -> Result<(), ScenarioError> {
        writer.write_image(&format!("images/{name}"), &rendering.image)?;
        if extras == Extras::DepthAndMasks {
            let (w, h) = (rendering.image.width_px, rendering.image.height_px);
            writer.write_depth(&format!("depth/{name}"), &rendering.depth_m, w, h)?;
            let object = self.actor.as_ref().map(|a| self.scenery.next_object + a.dynamic as u16);
            let mask: Vec<bool> = rendering.object_id.iter().map(|id| Some(*id) == object).collect();
            writer.write_mask(&format!("masks/{name}"), &mask, w, h)?;
        }
        Ok(())
    }
}

fn frame_name(branch: usize, timestamp: usize, view: usize) -> String {
    format!("b{branch}_t{timestamp}_v{view:03}.png")
}

/// A camera whose images are all written, with the actor's visibility by time step, then branch.
#[derive(Serialize, Deserialize)]
struct ViewNote {
    view: usize,
    actors: Vec<Option<ActorView>>,
}
