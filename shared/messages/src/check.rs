//! Checks for the fields of messages; each error names the field.

/// Reason why a message was refused. It always names the field.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum Invalid {
    /// A number is NaN or infinite.
    #[error("`{field}` is not finite")]
    NotFinite {
        /// Name of the field.
        field: &'static str,
    },
    /// A number is out of range.
    #[error("`{field}` is {value}, must be in {min}..={max}")]
    OutOfRange {
        /// Name of the field.
        field: &'static str,
        /// Value of the field.
        value: f64,
        /// Smallest allowed value.
        min: f64,
        /// Largest allowed value.
        max: f64,
    },
    /// A number differs from the only valid value, or a size from another one.
    #[error("`{field}` is {found}, expected {expected}")]
    Mismatch {
        /// Name of the field.
        field: &'static str,
        /// Value of the field.
        found: u64,
        /// Expected value.
        expected: u64,
    },
    /// A code is unknown.
    #[error("`{field}` has the unknown code {code}")]
    UnknownCode {
        /// Name of the field.
        field: &'static str,
        /// Code in the field.
        code: i64,
    },
}

/// Checks that all values are finite.
pub fn finite<'a>(field: &'static str, values: impl IntoIterator<Item = &'a f32>) -> Result<(), Invalid> {
    if values.into_iter().all(|v| v.is_finite()) { Ok(()) } else { Err(Invalid::NotFinite { field }) }
}

/// Checks that all values are finite.
pub fn finite_f64<'a>(field: &'static str, values: impl IntoIterator<Item = &'a f64>) -> Result<(), Invalid> {
    if values.into_iter().all(|v| v.is_finite()) { Ok(()) } else { Err(Invalid::NotFinite { field }) }
}

/// Checks that all values are finite and in `min..=max`.
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

/// Checks that a value is in 0..=1.
pub fn probability(field: &'static str, value: f32) -> Result<(), Invalid> {
    within(field, [&value], 0.0, 1.0)
}

/// Checks that a value is in `min..=max`.
pub fn in_range(field: &'static str, value: i64, min: i64, max: i64) -> Result<(), Invalid> {
    if (min..=max).contains(&value) {
        Ok(())
    } else {
        Err(Invalid::OutOfRange { field, value: value as f64, min: min as f64, max: max as f64 })
    }
}

/// Checks that a value is in `0..=max`.
pub fn at_most(field: &'static str, value: u64, max: u64) -> Result<(), Invalid> {
    if value <= max {
        Ok(())
    } else {
        Err(Invalid::OutOfRange { field, value: value as f64, min: 0.0, max: max as f64 })
    }
}

/// Checks that two values are equal.
pub fn equals(field: &'static str, found: u64, expected: u64) -> Result<(), Invalid> {
    if found == expected { Ok(()) } else { Err(Invalid::Mismatch { field, found, expected }) }
}

/// Checks that weights sum to 1 within 1e-3.
pub fn distribution(field: &'static str, values: &[f32]) -> Result<(), Invalid> {
    within(field, values, 0.0, 1.0)?;
    let sum: f32 = values.iter().sum();
    if (sum - 1.0).abs() <= 1e-3 {
        Ok(())
    } else {
        Err(Invalid::OutOfRange { field, value: sum.into(), min: 0.999, max: 1.001 })
    }
}
