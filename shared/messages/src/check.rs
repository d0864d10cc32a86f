//! The checks that all messages share; each error names the field.

/// Why a message was refused. Always names the field.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum Invalid {
    /// NaN or infinite.
    #[error("`{field}` is not finite")]
    NotFinite {
        /// Which field.
        field: &'static str,
    },
    /// A number outside its range.
    #[error("`{field}` is {value}, must be in {min}..={max}")]
    OutOfRange {
        /// Which field.
        field: &'static str,
        /// What was found.
        value: f64,
        /// Smallest value allowed.
        min: f64,
        /// Largest value allowed.
        max: f64,
    },
    /// A number that must have one value, or a size that does not fit another.
    #[error("`{field}` is {found}, expected {expected}")]
    Mismatch {
        /// Which field.
        field: &'static str,
        /// What was found.
        found: u64,
        /// What it must be.
        expected: u64,
    },
    /// A code that stands for nothing.
    #[error("`{field}` has the unknown code {code}")]
    UnknownCode {
        /// Which field.
        field: &'static str,
        /// What was found.
        code: i64,
    },
}

/// All are finite.
pub fn finite<'a>(field: &'static str, values: impl IntoIterator<Item = &'a f32>) -> Result<(), Invalid> {
    if values.into_iter().all(|v| v.is_finite()) { Ok(()) } else { Err(Invalid::NotFinite { field }) }
}

/// All are finite.
pub fn finite_f64<'a>(field: &'static str, values: impl IntoIterator<Item = &'a f64>) -> Result<(), Invalid> {
    if values.into_iter().all(|v| v.is_finite()) { Ok(()) } else { Err(Invalid::NotFinite { field }) }
}

/// All are finite and in `min..=max`.
pub fn within<'a>(
    field: &'static str,
    values: impl IntoIterator<Item = &'a f32>,
    min: f32,
    max: f32,
) -> Result<(), Invalid> {
    for &value in values {
        if !value.is_finite() {
            return Err(Invalid::NotFinite { field });
        }
        if !(min..=max).contains(&value) {
            return Err(Invalid::OutOfRange { field, value: value.into(), min: min.into(), max: max.into() });
        }
    }
    Ok(())
}

/// In 0..=1.
pub fn probability(field: &'static str, value: f32) -> Result<(), Invalid> {
    within(field, [&value], 0.0, 1.0)
}

/// In `min..=max`.
pub fn in_range(field: &'static str, value: i64, min: i64, max: i64) -> Result<(), Invalid> {
    if (min..=max).contains(&value) {
        Ok(())
    } else {
        Err(Invalid::OutOfRange { field, value: value as f64, min: min as f64, max: max as f64 })
    }
}

/// In `0..=max`.
pub fn at_most(field: &'static str, value: u64, max: u64) -> Result<(), Invalid> {
    if value <= max {
        Ok(())
    } else {
        Err(Invalid::OutOfRange { field, value: value as f64, min: 0.0, max: max as f64 })
    }
}

/// The same.
pub fn equals(field: &'static str, found: u64, expected: u64) -> Result<(), Invalid> {
    if found == expected { Ok(()) } else { Err(Invalid::Mismatch { field, found, expected }) }
}

/// Weights that sum to 1 within 1e-3.
pub fn distribution(field: &'static str, values: &[f32]) -> Result<(), Invalid> {
    within(field, values, 0.0, 1.0)?;
    let sum: f32 = values.iter().sum();
    if (sum - 1.0).abs() <= 1e-3 {
        Ok(())
    } else {
        Err(Invalid::OutOfRange { field, value: sum.into(), min: 0.999, max: 1.001 })
    }
}
