//! The density probe of a checkpoint: its field, places, calibration and state posteriors.

use crate::{CheckpointError, Manifest, files, load_field};
use carff_decision::{Localiser, ProbeCalibration, ProbeLayout, SceneProbe};
use carff_field::{Field, PreparedPoints};
use carff_messages::LATENT_DIM;
use std::ops::Deref;
use std::path::Path;

/// The density probe of a trained field.
pub type FieldProbe = SceneProbe<PreparedField>;

/// A trained field with the prepared points of one probe layout.
#[derive(Clone, Debug)]
pub struct PreparedField {
    field: Field,
    points: PreparedPoints,
    densities: Vec<f32>,
}

impl PreparedField {
    /// Prepares the points of a layout.
    pub fn new(field: Field, layout: &ProbeLayout) -> Self {
        let points = field.prepare(layout.points());
        Self { field, points, densities: Vec::new() }
    }
}

impl Deref for PreparedField {
    type Target = Field;

    fn deref(&self) -> &Field {
        &self.field
    }
}

impl Localiser for PreparedField {
    fn occupancies(&mut self, layout: &ProbeLayout, latents: &[[f32; LATENT_DIM]], occupancies: &mut [f32]) {
        let (points, places) = (layout.points().len().max(1), layout.places().len().max(1));
        self.densities.resize(points * latents.len(), 0.0);
        self.field.density_prepared(&self.points, latents, &mut self.densities);
        for (densities, row) in self.densities.chunks_exact(points).zip(occupancies.chunks_exact_mut(places)) {
            layout.occupancies(densities, row);
        }
    }
}

/// Reads the density probe of a checkpoint.
pub fn load_field_probe(dir: &Path, manifest: &Manifest) -> Result<FieldProbe, CheckpointError> {
    let (layout, calibration) = load_probing(dir, manifest)?;
    let field = PreparedField::new(load_field(dir, manifest)?, &layout);
    Ok(SceneProbe::new(field, layout, calibration, manifest.states.clone()))
}

/// Returns the probe layout of a checkpoint and its calibration.
pub fn load_probing(dir: &Path, manifest: &Manifest) -> Result<(ProbeLayout, ProbeCalibration), CheckpointError> {
    let missing = || CheckpointError::Missing { path: dir.into(), part: "probe calibration", phase: "nerf" };
    let calibration = manifest.probing.clone().ok_or_else(missing)?;
    let layout = ProbeLayout::new(manifest.places.clone(), manifest.scenario.hazard_states())
        .map_err(|source| CheckpointError::Probing { path: dir.into(), source })?;
    if calibration.fits(&layout) {
        Ok((layout, calibration))
    } else {
        Err(CheckpointError::Manifest {
            path: dir.join(files::MANIFEST),
            what: "`probing.places` and `places` differ in number".into(),
        })
    }
}
