//! Contract of the loss terms: their gradients agree with central differences.

#![allow(clippy::unwrap_used, reason = "a helper of a test fails it by panicking")]

use carff_checkpoint::shapes::MixtureConfig;
use carff_networks::mixture::MixtureNet;
use carff_training::{
    VaeTraining,
    losses::{contrastive, cross_entropy, kl_divergence, reconstruction_error, reparameterised},
};
use std::sync::{Mutex, MutexGuard, PoisonError};
use tch::{Device, Kind, Tensor, nn::VarStore, no_grad};

/// Half of the distance between the two inputs of a central difference.
const STEP: f64 = 2e-3;

/// Allowed error relative to the input's largest gradient, from f32 and the loss's curvature.
const TOLERANCE: f64 = 0.05;

/// Seeds libtorch's generator, which all tests share, and locks it against the other tests.
fn seeded(seed: i64) -> MutexGuard<'static, ()> {
    static ALONE: Mutex<()> = Mutex::new(());
    let alone = ALONE.lock().unwrap_or_else(PoisonError::into_inner);
    tch::manual_seed(seed);
    alone
}

fn random(shape: &[i64]) -> Tensor {
    Tensor::randn(shape, (Kind::Float, Device::Cpu))
}

/// Compares the gradient of `loss` at every number of `inputs` with central differences; no gradient may be 0
/// everywhere.
fn agrees(name: &str, inputs: &[Tensor], loss: impl Fn(&[Tensor]) -> Tensor) {
    let leaves: Vec<Tensor> = inputs.iter().map(|t| t.copy().set_requires_grad(true)).collect();
    loss(&leaves).backward();
    for (at, leaf) in leaves.iter().enumerate() {
        let gradient: Vec<f64> = leaf.grad().flatten(0, -1).try_into().unwrap();
        let largest = gradient.iter().fold(0.0_f64, |most, g| most.max(g.abs()));
        assert!(largest > 1e-4, "{name}, input {at}: no gradient");
        for (i, grad) in gradient.into_iter().enumerate() {
            let moved = |by: f64| {
                let places: Vec<Tensor> = inputs.iter().map(Tensor::copy).collect();
                let mut number = places[at].view(-1).get(i as i64);
                let _ = number.g_add_scalar_(by);
                no_grad(|| loss(&places)).double_value(&[])
            };
            let found = (moved(STEP) - moved(-STEP)) / (2.0 * STEP);
            assert!((grad - found).abs() <= TOLERANCE * largest, "{name}, input {at}, number {i}: {grad}, not {found}");
        }
    }
}

/// Holds for the divergence, the contrastive term, and the read-out's cross entropy with states that look the same.
#[test]
fn latent_terms() {
    let _alone = seeded(1);
    agrees("divergence", &[random(&[4, 8]), random(&[4, 8])], |t| kl_divergence(&t[0], &t[1]));
    let states = Tensor::from_slice(&[0_i64, 1, 0, 2, 1]);
    agrees("contrastive", &[random(&[5, 8])], |t| contrastive(&t[0], &states, 0.5));
    let wanted = Tensor::from_slice(&[0.5_f32, 0.5, 0.0, 0.0, 0.0, 1.0]).view([2, 3]);
    agrees("read-out", &[random(&[2, 3])], |t| cross_entropy(&t[0], &wanted));
}

/// Holds for the reconstruction of the image and of its residual over the mean image, also through the draw to mean and
/// log-variance.
#[test]
fn reconstruction_through_the_draw() {
    let _alone = seeded(2);
    let (targets, means) = (random(&[3, 3, 2, 4]).sigmoid(), random(&[3, 3, 2, 4]).sigmoid());
    let (noise, map) = (random(&[3, 8]), random(&[8, 24]) * 0.1);
    for residual in [false, true] {
        let settings = VaeTraining { residual, ..VaeTraining::default() };
        agrees("reconstruction", &[random(&[3, 8]), random(&[3, 8])], |t| {
            let made = reparameterised(&t[0], &t[1], &noise).matmul(&map).view([3, 3, 2, 4]);
            reconstruction_error(&made, &targets, &means, &settings)
        });
    }
}

/// Holds for the mixture's negative log-likelihood: at each number of the targets, and along the gradients of the
/// inputs and of each of the network's weights, because single numbers of these cross kinks.
#[test]
fn likelihood() {
    let _alone = seeded(3);
    let store = VarStore::new(Device::Cpu);
    let net = MixtureNet::new(&store.root(), &MixtureConfig::default()).unwrap();
    let [mean, log_variance, targets] = [(); 3].map(|()| random(&[6, 8]) * 0.5);
    let mut places: Vec<(String, Tensor)> = store.variables().into_iter().collect();
    for (name, input) in [("mean", &mean), ("log-variance", &log_variance)] {
        places.push((name.into(), input.set_requires_grad(true)));
    }
    let loss = || net.negative_log_likelihood(&mean, &log_variance, &targets);
    loss().backward();
    for (name, mut place) in places {
        let gradient = place.grad();
        let length = gradient.norm().double_value(&[]);
        assert!(length > 1e-4, "{name}: no gradient");
        let along = &gradient * (STEP / length);
        let mut moved = |by: f64| {
            no_grad(|| {
                let _ = place.g_add_(&(&along * by));
                let value = loss().double_value(&[]);
                let _ = place.g_sub_(&(&along * by));
                value
            })
        };
        let found = (moved(1.0) - moved(-1.0)) / (2.0 * STEP);
        assert!((length - found).abs() <= TOLERANCE * length, "{name}: {length}, not {found}");
    }
    agrees("likelihood", &[targets], |t| net.negative_log_likelihood(&mean, &log_variance, &t[0]));
}
