//! State of the trainer, for saving and resuming.

use super::trainer::FieldTrainer;
use crate::config::{FieldError, TrainerConfig};
use crate::model::field::Field;
use crate::model::tensors::{
    NamedTensor, load_tensors, names_and_shapes, network_tensors, set_network_tensor, table_tensor,
};

/// State of the optimiser and of the occupancy grid.
#[derive(Clone, Debug, PartialEq)]
pub struct TrainerState<'a> {
    /// Steps done.
    pub step: u64,
    /// Moments and cell densities by name; names and shapes only depend on the field's configuration.
    pub tensors: Vec<NamedTensor<'a>>,
}

impl FieldTrainer {
    /// Returns the trainer's state. Together with the field's tensors it resumes training bit by bit.
    pub fn state(&self) -> TrainerState<'_> {
        let layout = &self.field.layout;
        let mut tensors = vec![
            table_tensor("first.grid.table", layout, &self.table_moments[0]),
            table_tensor("second.grid.table", layout, &self.table_moments[1]),
        ];
        for (prefix, moments) in ["first.", "second."].iter().zip(&self.network_moments) {
            tensors.extend(network_tensors(layout, moments, prefix));
        }
        let r = self.field.config.occupancy_resolution;
        tensors.push(NamedTensor {
            name: "occupancy.density".into(),
            shape: vec![r, r, r],
            data: (&self.cell_density).into(),
        });
        tensors.push(NamedTensor { name: "step_scale".into(), shape: vec![1], data: vec![self.step_scale].into() });
        TrainerState { step: self.step, tensors }
    }

    /// Makes a trainer that continues from a state. `field` is the field of that step. The error lists every key that
    /// is missing, unknown, of another shape or not finite.
    pub fn from_state(
        field: Field,
        config: TrainerConfig,
        step: u64,
        tensors: impl IntoIterator<Item = (String, Vec<usize>, Vec<f32>)>,
    ) -> Result<Self, FieldError> {
        let mut trainer = Self::new(field, config)?;
        trainer.step = step;
        load_tensors(&names_and_shapes(trainer.state().tensors), tensors, |name, data| {
            let layout = &trainer.field.layout;
            match name.split_once('.') {
                Some(("first", "grid.table")) => trainer.table_moments[0] = data,
                Some(("second", "grid.table")) => trainer.table_moments[1] = data,
                Some(("first", rest)) => set_network_tensor(layout, &mut trainer.network_moments[0], rest, &data),
                Some(("second", rest)) => set_network_tensor(layout, &mut trainer.network_moments[1], rest, &data),
                _ if name == "step_scale" => trainer.step_scale = data[0],
                _ => trainer.cell_density = data,
            }
            Ok(())
        })?;
        Ok(trainer)
    }
}
