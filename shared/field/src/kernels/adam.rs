//! The optimiser's step.

use super::math::fma;

/// The numbers of one Adam step.
#[derive(Clone, Copy, Debug)]
pub(crate) struct AdamStep {
    /// Learning rate with the bias corrections folded in.
    pub rate: f32,
    /// Decay of the first moment.
    pub beta1: f32,
    /// Decay of the second moment.
    pub beta2: f32,
    /// Epsilon, scaled like the second moment.
    pub epsilon: f32,
    /// Pull of the parameters towards zero.
    pub decay: f32,
}

/// One step of Adam over `parameters` with the sum of `gradients`, which are zeroed. When `sparse`, parameters without
/// a gradient keep their value and their moments.
#[inline(always)]
pub(crate) fn step<const FMA: bool>(
    step: AdamStep,
    sparse: bool,
    parameters: &mut [f32],
    [first, second]: [&mut [f32]; 2],
    gradients: &mut [&mut [f32]],
) {
    const G: usize = 8;
    let (head, tail) = parameters.as_chunks_mut::<G>();
    let n = head.len();
    for (i, p) in head.iter_mut().enumerate() {
        let at = i * G;
        let mut g = [0.0_f32; G];
        for shard in gradients.iter_mut() {
            let s: &mut [f32; G] = (&mut shard[at..at + G]).try_into().expect("G numbers");
            for l in 0..G {
                g[l] += s[l];
            }
        }
        if sparse {
            let mut any = 0_u32;
            for v in &g {
                any |= v.to_bits() & 0x7fff_ffff;
            }
            if any == 0 {
                continue;
            }
        }
        for shard in gradients.iter_mut() {
            shard[at..at + G].fill(0.0);
        }
        let m: &mut [f32; G] = (&mut first[at..at + G]).try_into().expect("G numbers");
        let v: &mut [f32; G] = (&mut second[at..at + G]).try_into().expect("G numbers");
        for l in 0..G {
            let gl = fma::<FMA>(step.decay, p[l], g[l]);
            let live = !sparse || g[l] != 0.0;
            let ml = fma::<FMA>(step.beta1, m[l], (1.0 - step.beta1) * gl);
            let vl = fma::<FMA>(step.beta2, v[l], (1.0 - step.beta2) * gl * gl);
            let pl = p[l] - step.rate * ml / (vl.sqrt() + step.epsilon);
            m[l] = if live { ml } else { m[l] };
            v[l] = if live { vl } else { v[l] };
            p[l] = if live { pl } else { p[l] };
        }
    }
    for (i, p) in tail.iter_mut().enumerate() {
        let at = n * G + i;
        let mut g = 0.0;
        for shard in gradients.iter_mut() {
            g += std::mem::take(&mut shard[at]);
        }
        if sparse && g == 0.0 {
            continue;
        }
        g += step.decay * *p;
        first[at] = step.beta1 * first[at] + (1.0 - step.beta1) * g;
        second[at] = step.beta2 * second[at] + (1.0 - step.beta2) * g * g;
        *p -= step.rate * first[at] / (second[at].sqrt() + step.epsilon);
    }
}
