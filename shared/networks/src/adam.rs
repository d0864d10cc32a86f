//! An Adam optimiser with a state that can be saved. The state of tch's own optimiser cannot, and training must resume.

use crate::weights::Tensors;
use tch::{Tensor, nn::VarStore};

/// Adam (Kingma and Ba 2015) with decoupled weight decay.
pub struct Adam {
    slots: Vec<Slot>,
    weight_decay: f64,
}

struct Slot {
    name: String,
    variable: Tensor,
    first: Tensor,
    second: Tensor,
    steps: i64,
}

const BETA1: f64 = 0.9;
const BETA2: f64 = 0.999;
const EPSILON: f64 = 1e-8;

impl Adam {
    /// Creates an optimiser of all trainable variables of the stores; their names must be unique.
    pub fn new(stores: &[&VarStore], weight_decay: f64) -> Self {
        let mut slots: Vec<Slot> = stores
            .iter()
            .flat_map(|store| store.variables())
            .filter(|(_, variable)| variable.requires_grad())
            .map(|(name, variable)| Slot {
                name,
                first: variable.zeros_like().detach(),
                second: variable.zeros_like().detach(),
                steps: 0,
                variable,
            })
            .collect();
        slots.sort_by(|a, b| a.name.cmp(&b.name));
        Self { slots, weight_decay }
    }

    /// Makes one step down the gradient of `loss`, with gradients clipped to a norm of `max_norm` over all variables.
    /// Variables without a gradient keep their values and moments: decayed moments would make their next step too long.
    pub fn step(&mut self, loss: &Tensor, learning_rate: f64, max_norm: f64) {
        for slot in &mut self.slots {
            slot.variable.zero_grad();
        }
        loss.backward();
        tch::no_grad(|| {
            let gradients: Vec<Tensor> = self.slots.iter().map(|s| s.variable.grad()).collect();
            let square = |g: &Tensor| g.square().sum(tch::Kind::Float).double_value(&[]);
            let squares: Vec<f64> = gradients.iter().map(|g| if g.defined() { square(g) } else { 0.0 }).collect();
            let scale = (max_norm / (squares.iter().sum::<f64>().sqrt() + 1e-12)).min(1.0);
            for ((slot, gradient), square) in self.slots.iter_mut().zip(gradients).zip(squares) {
                if square == 0.0 {
                    continue;
                }
                slot.steps += 1;
                let correct1 = 1.0 - BETA1.powi(slot.steps as i32);
                let correct2 = 1.0 - BETA2.powi(slot.steps as i32);
                let gradient = gradient * scale;
                let _ = slot.first.g_mul_scalar_(BETA1);
                let _ = slot.first.g_add_(&(&gradient * (1.0 - BETA1)));
                let _ = slot.second.g_mul_scalar_(BETA2);
                let _ = slot.second.g_add_(&(gradient.square() * (1.0 - BETA2)));
                let update = (&slot.first / correct1) / ((&slot.second / correct2).sqrt() + EPSILON);
                if self.weight_decay > 0.0 {
                    let _ = slot.variable.g_mul_scalar_(1.0 - learning_rate * self.weight_decay);
                }
                let _ = slot.variable.g_add_(&(update * -learning_rate));
            }
        });
    }

    /// Returns the state for a later resume: moments and counts of steps.
    pub fn state(&self) -> Tensors {
        let mut state = Tensors::new();
        for slot in &self.slots {
            state.insert(format!("first.{}", slot.name), slot.first.copy());
            state.insert(format!("second.{}", slot.name), slot.second.copy());
            state.insert(format!("steps.{}", slot.name), Tensor::from_slice(&[slot.steps]));
        }
        state
    }

    /// Restores a saved state; `false` if it belongs to other variables.
    #[must_use]
    pub fn restore(&mut self, state: &Tensors) -> bool {
        let fits = self.slots.iter().all(|s| {
            let has =
                |part: &str, size: &[i64]| state.get(&format!("{part}.{}", s.name)).is_some_and(|t| t.size() == size);
            has("first", &s.variable.size()) && has("second", &s.variable.size()) && has("steps", &[1])
        });
        if !fits {
            return false;
        }
        for slot in &mut self.slots {
            slot.first.copy_(&state[&format!("first.{}", slot.name)]);
            slot.second.copy_(&state[&format!("second.{}", slot.name)]);
            slot.steps = state[&format!("steps.{}", slot.name)].int64_value(&[0]);
        }
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tch::{Device, Kind, nn};

    fn problem() -> (VarStore, Tensor) {
        let store = VarStore::new(Device::Cpu);
        let x = store.root().var("x", &[3], nn::Init::Const(0.0));
        (store, x)
    }

    /// A variable without gradients in some steps ends where it would without those steps.
    #[test]
    fn a_variable_out_of_reach_stays() {
        let trained = |others: usize| {
            let store = VarStore::new(Device::Cpu);
            let [near, far] = ["near", "far"].map(|name| store.root().var(name, &[2], nn::Init::Const(1.0)));
            let mut adam = Adam::new(&[&store], 0.05);
            for _ in 0..3 {
                adam.step(&(near.square() + far.square()).sum(Kind::Float), 0.1, 100.0);
                for _ in 0..others {
                    let before = near.copy();
                    adam.step(&near.square().sum(Kind::Float), 0.01, 100.0);
                    assert!((&near - before).abs().min().double_value(&[]) > 0.0);
                }
            }
            far.copy()
        };
        assert_eq!(trained(4), trained(0));
    }

    /// A step after a restore equals the step without the interruption, bit for bit.
    #[test]
    fn resumes_exactly() {
        let loss = |x: &Tensor| (x - Tensor::from_slice(&[1.0_f32, -2.0, 0.5])).square().sum(Kind::Float);
        let (store_a, a) = problem();
        let mut adam_a = Adam::new(&[&store_a], 0.01);
        for _ in 0..5 {
            adam_a.step(&loss(&a), 0.1, 1.0);
        }
        let (store_b, mut b) = problem();
        let mut adam_b = Adam::new(&[&store_b], 0.01);
        assert!(adam_b.restore(&adam_a.state()));
        tch::no_grad(|| b.copy_(&a));
        for _ in 0..200 {
            adam_a.step(&loss(&a), 0.1, 1.0);
            adam_b.step(&loss(&b), 0.1, 1.0);
        }
        assert_eq!(Vec::<f32>::try_from(&a).unwrap(), Vec::<f32>::try_from(&b).unwrap());
        assert!((Vec::<f32>::try_from(&a).unwrap()[1] + 2.0).abs() < 0.1);
    }

    /// A state of other variables is refused and changes nothing.
    #[test]
    fn refuses_a_foreign_state() {
        let (store, _x) = problem();
        let mut adam = Adam::new(&[&store], 0.0);
        assert!(!adam.restore(&Tensors::new()));
    }
}
