//! Values of keys with their ranges, and defaults that are not a type's own.

use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::de::Error as _;
use serde::{Deserialize, Deserializer};
use std::borrow::Cow;
use toml::Spanned;

/// Format of colours, for the schema.
pub(super) enum Colour {}

impl JsonSchema for Colour {
    fn schema_name() -> Cow<'static, str> {
        "Colour".into()
    }

    fn inline_schema() -> bool {
        true
    }

    fn json_schema(_: &mut SchemaGenerator) -> Schema {
        json_schema!({ "type": "string", "pattern": "^#[0-9a-fA-F]{6}$" })
    }
}

pub(super) fn first_timestamp() -> Spanned<usize> {
    Spanned::new(0..0, 0)
}

pub(super) fn default_ground() -> [f32; 3] {
    parse_colour("#5d8a3c").unwrap_or([0.1; 3])
}

pub(super) fn default_marking() -> [f32; 3] {
    parse_colour("#e4e4de").unwrap_or([0.8; 3])
}

pub(super) fn default_trim() -> [f32; 3] {
    parse_colour("#d8d2c4").unwrap_or([0.7; 3])
}

pub(super) fn default_clearance() -> f64 {
    0.45
}

pub(super) fn default_shade_reach() -> f64 {
    1.6
}

pub(super) fn one() -> usize {
    1
}

/// Parses `#rrggbb` in sRGB into linear RGB.
pub(super) fn parse_colour(text: &str) -> Option<[f32; 3]> {
    let digits = text.strip_prefix('#').filter(|d| d.len() == 6 && d.is_ascii())?;
    let mut rgb = [0.0; 3];
    for (i, value) in rgb.iter_mut().enumerate() {
        let byte = u8::from_str_radix(&digits[2 * i..2 * i + 2], 16).ok()?;
        let c = f32::from(byte) / 255.0;
        *value = if c <= 0.04045 { c / 12.92 } else { ((c + 0.055) / 1.055).powf(2.4) };
    }
    Some(rgb)
}

pub(super) fn colour<'de, D: Deserializer<'de>>(d: D) -> Result<[f32; 3], D::Error> {
    let text = String::deserialize(d)?;
    parse_colour(&text).ok_or_else(|| D::Error::custom(format!("`{text}` is not a colour; write `#rrggbb`")))
}

pub(super) fn six_colours<'de, D: Deserializer<'de>>(d: D) -> Result<[[f32; 3]; 6], D::Error> {
    let texts = <[String; 6]>::deserialize(d)?;
    let mut colours = [[0.0; 3]; 6];
    for (colour, text) in colours.iter_mut().zip(&texts) {
        *colour =
            parse_colour(text).ok_or_else(|| D::Error::custom(format!("`{text}` is not a colour; write `#rrggbb`")))?;
    }
    Ok(colours)
}

pub(super) fn in_range<'de, D: Deserializer<'de>>(d: D, low: f64, high: f64, what: &str) -> Result<f64, D::Error> {
    let value = f64::deserialize(d)?;
    if (low..=high).contains(&value) {
        Ok(value)
    } else {
        Err(D::Error::custom(format!("{value} is out of range; {what} from {low} to {high} is allowed")))
    }
}

pub(super) fn finite<'de, D: Deserializer<'de>>(d: D) -> Result<f64, D::Error> {
    in_range(d, -1e6, 1e6, "a number")
}

pub(super) fn positive<'de, D: Deserializer<'de>>(d: D) -> Result<f64, D::Error> {
    in_range(d, 1e-3, 1e4, "a length")
}

pub(super) fn not_negative<'de, D: Deserializer<'de>>(d: D) -> Result<f64, D::Error> {
    in_range(d, 0.0, 1e4, "a length")
}

pub(super) fn field_of_view<'de, D: Deserializer<'de>>(d: D) -> Result<f64, D::Error> {
    in_range(d, 5.0, 150.0, "an angle")
}

pub(super) fn elevation<'de, D: Deserializer<'de>>(d: D) -> Result<f64, D::Error> {
    in_range(d, 5.0, 90.0, "an angle")
}

pub(super) fn softness<'de, D: Deserializer<'de>>(d: D) -> Result<f64, D::Error> {
    in_range(d, 0.0, 10.0, "an angle")
}

pub(super) fn heading<'de, D: Deserializer<'de>>(d: D) -> Result<f64, D::Error> {
    in_range(d, -180.0, 180.0, "an angle")
}

pub(super) fn duration<'de, D: Deserializer<'de>>(d: D) -> Result<Option<f64>, D::Error> {
    in_range(d, 0.001, 3600.0, "a duration").map(Some)
}

pub(super) fn whole<'de, D: Deserializer<'de>>(d: D, low: i64, high: i64) -> Result<i64, D::Error> {
    let value = i64::deserialize(d)?;
    if (low..=high).contains(&value) {
        Ok(value)
    } else {
        Err(D::Error::custom(format!("{value} is out of range; a whole number from {low} to {high} is allowed")))
    }
}

pub(super) fn count<'de, D: Deserializer<'de>>(d: D) -> Result<usize, D::Error> {
    whole(d, 1, 64).map(|v| v as usize)
}

pub(super) fn many<'de, D: Deserializer<'de>>(d: D) -> Result<usize, D::Error> {
    whole(d, 1, 10_000).map(|v| v as usize)
}

pub(super) fn side<'de, D: Deserializer<'de>>(d: D) -> Result<u32, D::Error> {
    whole(d, 8, 4096).map(|v| v as u32)
}

pub(super) fn vector<'de, D: Deserializer<'de>, const N: usize>(d: D) -> Result<[f64; N], D::Error>
where
    [f64; N]: Deserialize<'de>,
{
    let value = <[f64; N]>::deserialize(d)?;
    if value.iter().all(|v| v.abs() <= 1e5) {
        Ok(value)
    } else {
        Err(D::Error::custom("a coordinate is out of range; -100000 to 100000 is allowed"))
    }
}

pub(super) fn point2<'de, D: Deserializer<'de>>(d: D) -> Result<[f64; 2], D::Error> {
    vector(d)
}

pub(super) fn point3<'de, D: Deserializer<'de>>(d: D) -> Result<[f64; 3], D::Error> {
    vector(d)
}

pub(super) fn pose4<'de, D: Deserializer<'de>>(d: D) -> Result<[f64; 4], D::Error> {
    vector(d)
}

pub(super) fn edges<'de, D: Deserializer<'de>>(d: D) -> Result<[f64; 3], D::Error> {
    let size = vector(d)?;
    if size.iter().all(|v| (1e-3..=1e4).contains(v)) {
        Ok(size)
    } else {
        Err(D::Error::custom("a length is out of range; 0.001 to 10000 is allowed"))
    }
}

pub(super) fn clearance<'de, D: Deserializer<'de>>(d: D) -> Result<f64, D::Error> {
    in_range(d, 1e-3, 100.0, "a length")
}

pub(super) fn size3<'de, D: Deserializer<'de>>(d: D) -> Result<[f64; 3], D::Error> {
    let size = vector(d)?;
    if size.iter().all(|v| (0.1..=100.0).contains(v)) {
        Ok(size)
    } else {
        Err(D::Error::custom("a size is out of range; 0.1 to 100 is allowed"))
    }
}

pub(super) fn range<'de, D: Deserializer<'de>>(d: D) -> Result<[f64; 2], D::Error> {
    let value: [f64; 2] = vector(d)?;
    if value[0] <= value[1] { Ok(value) } else { Err(D::Error::custom("the lowest value must come first")) }
}

pub(super) fn box3<'de, D: Deserializer<'de>>(d: D) -> Result<[[f64; 3]; 2], D::Error> {
    let value = <[[f64; 3]; 2]>::deserialize(d)?;
    if !value.iter().flatten().all(|v| v.abs() <= 1e5) {
        return Err(D::Error::custom("a coordinate is out of range; -100000 to 100000 is allowed"));
    }
    if (0..3).all(|i| value[0][i] <= value[1][i]) {
        Ok(value)
    } else {
        Err(D::Error::custom("the first corner must not be above the second along any axis"))
    }
}
