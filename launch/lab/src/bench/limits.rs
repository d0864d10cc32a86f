//! Limits of the machine: matrix products in libtorch, and memory bandwidth.

use carff_bench::stats::{Contender, timed};
use tch::{Device, Kind, Tensor};

/// Returns a matrix product of `[m, k]` and `[k, n]`, and its number of operations.
pub(crate) fn matrix_product<'a>(kind: Kind, [m, k, n]: [i64; 3]) -> (Contender<'a>, f64) {
    let a = (Tensor::rand([m, k], (Kind::Float, Device::Cpu)) - 0.5).to_kind(kind);
    let b = (Tensor::rand([k, n], (Kind::Float, Device::Cpu)) - 0.5).to_kind(kind);
    let out = Tensor::zeros([m, n], (kind, Device::Cpu));
    let contender = timed(move || {
        tch::no_grad(|| {
            let _ = a.matmul_out(&out, &b);
        });
    });
    (contender, 2.0 * (m * k * n) as f64)
}

/// Length of each of the three arrays for the bandwidth: far more than the caches can hold.
const TRIAD: usize = 1 << 24;

/// Returns a = b + 3 c over large arrays on `threads` threads, and the number of bytes that it reads and writes.
pub(crate) fn triad<'a>(threads: usize) -> (Contender<'a>, f64) {
    let (mut a, b, c) = (vec![0.0_f32; TRIAD], vec![1.0_f32; TRIAD], vec![2.0_f32; TRIAD]);
    let contender = timed(move || {
        let part = TRIAD.div_ceil(threads.max(1));
        std::thread::scope(|scope| {
            for ((a, b), c) in a.chunks_mut(part).zip(b.chunks(part)).zip(c.chunks(part)) {
                scope.spawn(move || {
                    for ((a, b), c) in a.iter_mut().zip(b).zip(c) {
                        *a = b + 3.0 * c;
                    }
                });
            }
        });
        std::hint::black_box(&mut a);
    });
    (contender, (3 * TRIAD * size_of::<f32>()) as f64)
}
