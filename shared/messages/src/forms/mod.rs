//! The JSON form of each message, and the conversions to it and back.
//!
//! People, recordings and other tools read these forms. A form writes codes as names, arrays with their used entries,
//! and `null` for "none". A message converted to its form and back is the same message bit for bit; unused entries
//! become zero. [`schema`] describes a form as JSON Schema. A message without optional fields and lists is its own
//! form.
//!
//! ```
//! use carff_messages::forms::{Readable, read};
//! use carff_messages::{Gaussian, Header, Posterior};
//! let header = Header::of_frame(7, 1_000, 42);
//! let posterior = Posterior { header, gaussian: Gaussian::standard(), take_start: 0, stage_latency_ns: 5 };
//! let text = serde_json::to_string(&posterior.to_form())?;
//! assert!(text.contains(r#""frame_id":7"#));
//! assert_eq!(read::<Posterior>(text.as_bytes())?, posterior);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod any;
mod decision;
mod frame;
mod latent;
mod novelty;
mod occupancy;
mod text;

pub use any::{AnyMessage, DynMessage, OwnedMessage, Readable, read};
pub use decision::ActionForm;
pub use frame::{DatasetViewForm, FrameForm, ViewForm};
pub use latent::{BeliefForm, ComponentForm, DrawForm, ForecastForm, ProbeForm};
pub use novelty::UnknownsForm;
pub use occupancy::OccupancyForm;
pub use text::as_text;

use crate::Invalid;
use schemars::JsonSchema;

/// Reason why a form cannot become a message.
#[derive(Debug, thiserror::Error)]
pub enum FormError {
    /// A name is unknown.
    #[error("`{field}` is `{found}`, must be one of: {known}")]
    UnknownName {
        /// Name of the field.
        field: &'static str,
        /// Value of the field.
        found: String,
        /// Allowed names.
        known: String,
    },
    /// A list has the wrong length.
    #[error("`{field}` has {found} entries, must have {expected}")]
    Length {
        /// Name of the field.
        field: &'static str,
        /// Length of the list.
        found: usize,
        /// Allowed length.
        expected: String,
    },
    /// The text is not valid JSON of this form.
    #[error(transparent)]
    Json(#[from] serde_json::Error),
    /// The resulting message is not valid.
    #[error(transparent)]
    Invalid(#[from] Invalid),
}

/// Returns a form's JSON Schema.
pub fn schema<T: JsonSchema>() -> serde_json::Value {
    schemars::schema_for!(T).to_value()
}

/// Returns the name of a code; `unknown` for an unknown code.
macro_rules! name_of {
    ($kind:ty, $code:expr) => {
        <$kind>::try_from($code).map_or("unknown", <$kind>::name).to_owned()
    };
}
/// Returns the code of a name.
macro_rules! code_of {
    ($kind:ty, $field:literal, $name:expr) => {
        <$kind>::from_name(&$name).map(<$kind>::code).ok_or_else(|| $crate::forms::FormError::UnknownName {
            field: $field,
            found: $name.to_owned(),
            known: <$kind>::names(),
        })
    };
}
use {code_of, name_of};

/// Converts a list to an array of the same length.
fn array<T: Copy, const N: usize>(field: &'static str, list: &[T]) -> Result<[T; N], FormError> {
    list.try_into().map_err(|_| FormError::Length { field, found: list.len(), expected: N.to_string() })
}

/// Converts a list to the start of an array.
fn begin<T: Copy, const N: usize>(field: &'static str, list: &[T], rest: T) -> Result<[T; N], FormError> {
    if list.len() > N {
        return Err(FormError::Length { field, found: list.len(), expected: format!("at most {N}") });
    }
    let mut array = [rest; N];
    array[..list.len()].copy_from_slice(list);
    Ok(array)
}

/// Returns an index; -1 is `None`.
fn index(value: i32) -> Option<u32> {
    u32::try_from(value).ok()
}

/// Converts an index back; the message's validation refuses values that are too large.
fn signed(value: Option<u32>) -> i32 {
    value.map_or(-1, |v| i32::try_from(v).unwrap_or(i32::MAX))
}

#[cfg(test)]
mod tests;
