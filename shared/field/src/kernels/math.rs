//! Small arithmetic: exponential, spherical harmonics, counter-based random numbers.

/// Fused multiply-add where the instruction exists, else a product and a sum (a library call would be far slower).
#[inline(always)]
pub(crate) fn fma<const FMA: bool>(a: f32, b: f32, c: f32) -> f32 {
    if FMA { a.mul_add(b, c) } else { a * b + c }
}

/// Exponential to about 2 ulp over [-87, 87] (clamped outside), written so that it vectorises (Cephes polynomial).
#[inline(always)]
pub(crate) fn exp(x: f32) -> f32 {
    const MAGIC: f32 = 12_582_912.0;
    let x = x.clamp(-87.0, 87.0);
    let shifted = x * std::f32::consts::LOG2_E + MAGIC;
    let n = shifted - MAGIC;
    let r = x - n * 0.693_359_4 + n * 2.121_944_4e-4;
    let p = 1.987_569_1e-4;
    let p = p * r + 1.398_199_9e-3;
    let p = p * r + 8.333_452e-3;
    let p = p * r + 4.166_579_6e-2;
    let p = p * r + 1.666_666_5e-1;
    let p = p * r + 0.5;
    let p = p * r * r + r + 1.0;
    p * f32::from_bits((shifted.to_bits() << 23).wrapping_add(0x3f80_0000))
}

/// Logistic function.
#[inline(always)]
pub(crate) fn sigmoid(x: f32) -> f32 {
    1.0 / (1.0 + exp(-x))
}

/// Real spherical harmonics of a unit vector up to degree 4; the first `degree * degree` of the 16 numbers are used.
/// Bands and signs as in instant-ngp.
#[inline]
pub(crate) fn spherical_harmonics(direction: [f32; 3]) -> [f32; 16] {
    let [x, y, z] = direction;
    let (xy, xz, yz, x2, y2, z2) = (x * y, x * z, y * z, x * x, y * y, z * z);
    [
        0.282_094_8,
        -0.488_602_5 * y,
        0.488_602_5 * z,
        -0.488_602_5 * x,
        1.092_548_4 * xy,
        -1.092_548_4 * yz,
        0.946_174_7 * z2 - 0.315_391_57,
        -1.092_548_4 * xz,
        0.546_274_2 * (x2 - y2),
        0.590_043_6 * y * (-3.0 * x2 + y2),
        2.890_611_4 * xy * z,
        0.457_045_8 * y * (1.0 - 5.0 * z2),
        0.373_176_34 * z * (5.0 * z2 - 3.0),
        0.457_045_8 * x * (1.0 - 5.0 * z2),
        1.445_305_7 * z * (x2 - y2),
        0.590_043_6 * x * (-x2 + 3.0 * y2),
    ]
}

/// Returns one well-mixed number for each (seed, a, b): no draw depends on earlier ones.
#[inline]
pub(crate) fn hash(seed: u64, a: u64, b: u64) -> u64 {
    let mut h = seed ^ 0x9e37_79b9_7f4a_7c15;
    for word in [a, b] {
        h = h.wrapping_add(word).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        h ^= h >> 29;
        h = h.wrapping_mul(0x94d0_49bb_1331_11eb);
        h ^= h >> 32;
    }
    h
}

/// Maps 24 bits of a hash to a uniform number in [0, 1).
#[inline]
pub(crate) fn unit(bits: u64) -> f32 {
    (bits >> 40) as f32 * (1.0 / 16_777_216.0)
}

/// Rounds to the nearest half-precision value; values beyond its range become the largest finite one.
pub(crate) fn round_to_f16(value: f32) -> f32 {
    let bits = value.to_bits();
    let magnitude = f32::from_bits(bits & 0x7fff_ffff);
    let rounded = if !magnitude.is_finite() {
        magnitude
    } else if magnitude >= 65_504.0 {
        65_504.0
    } else if magnitude < 6.103_515_6e-5 {
        // Subnormal: multiples of 2^-24.
        (magnitude * 16_777_216.0).round_ties_even() / 16_777_216.0
    } else {
        let b = magnitude.to_bits();
        let odd = (b >> 13) & 1;
        f32::from_bits((b + 0x0fff + odd) & !0x1fff)
    };
    f32::from_bits(rounded.to_bits() | (bits & 0x8000_0000))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The polynomial agrees with the library to 4e-7 relative.
    #[test]
    fn exp_is_accurate() {
        for i in -8000..8000 {
            let x = i as f32 * 0.01;
            let (a, b) = (f64::from(exp(x)), f64::from(x).exp());
            assert!((a - b).abs() <= 4e-7 * b, "{x}: {a} {b}");
        }
    }

    /// The harmonics are orthonormal over the sphere (midpoint rule over a 60 x 120 lattice).
    #[test]
    fn harmonics_are_orthonormal() {
        let mut gram = [[0.0_f64; 16]; 16];
        let (rows, columns) = (60, 120);
        for i in 0..rows {
            let z = -1.0 + (2 * i + 1) as f64 / rows as f64;
            for j in 0..columns {
                let a = std::f64::consts::TAU * (j as f64 + 0.5) / columns as f64;
                let s = (1.0 - z * z).sqrt();
                let h = spherical_harmonics([(s * a.cos()) as f32, (s * a.sin()) as f32, z as f32]);
                for p in 0..16 {
                    for q in 0..16 {
                        gram[p][q] += f64::from(h[p] * h[q]) * 2.0 * std::f64::consts::TAU / (rows * columns) as f64;
                    }
                }
            }
        }
        for (p, row) in gram.iter().enumerate() {
            for (q, v) in row.iter().enumerate() {
                let want = if p == q { 1.0 } else { 0.0 };
                assert!((v - want).abs() < 5e-3, "{p} {q} {v}");
            }
        }
    }

    /// Rounding to half precision is idempotent and within half a unit in the last place.
    #[test]
    fn f16_rounding() {
        for value in [0.0_f32, 1.0, -1.0, 0.1, -3.333, 1e-5, 7e-8, 65504.0, 1e9, 2048.5] {
            let r = round_to_f16(value);
            assert_eq!(round_to_f16(r), r);
            if value.abs() < 65504.0 {
                assert!((r - value).abs() <= value.abs() / 2048.0 + 3e-8, "{value} {r}");
            }
        }
        assert_eq!(round_to_f16(1.0 + 1.0 / 2048.0), 1.0);
    }
}
