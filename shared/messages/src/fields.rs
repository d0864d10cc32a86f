//! JSON forms of single fields, for `#[serde(with = ..)]`.

#![allow(clippy::trivially_copy_pass_by_ref, reason = "serde passes fields by reference")]

use crate::{HealthState, ImageCondition, Stage};
use serde::de::{Deserialize, Deserializer, Error};
use serde::ser::Serializer;

/// A number as 16 hexadecimal digits.
pub(crate) mod hex {
    use super::{Deserialize, Deserializer, Error, Serializer};

    pub(crate) fn serialize<S: Serializer>(value: &u64, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(&format!("{value:016x}"))
    }

    pub(crate) fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<u64, D::Error> {
        let text = String::deserialize(deserializer)?;
        u64::from_str_radix(&text, 16).map_err(|_| D::Error::custom(format!("`{text}` must be 16 hexadecimal digits")))
    }
}

macro_rules! named {
    ($module:ident: $kind:ident) => {
        /// A code as its name.
        pub(crate) mod $module {
            use super::{Deserialize, Deserializer, Error, Serializer, $kind};

            pub(crate) fn serialize<S: Serializer>(code: &u32, serializer: S) -> Result<S::Ok, S::Error> {
                serializer.serialize_str($kind::try_from(*code).map_or("unknown", $kind::name))
            }

            pub(crate) fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<u32, D::Error> {
                let name = String::deserialize(deserializer)?;
                $kind::from_name(&name).map($kind::code).ok_or_else(|| {
                    let (field, known) = (stringify!($module), $kind::names());
                    D::Error::custom(format!("`{field}` is `{name}`, must be one of: {known}"))
                })
            }
        }
    };
}

named!(stage: Stage);
named!(state: HealthState);
named!(condition: ImageCondition);
