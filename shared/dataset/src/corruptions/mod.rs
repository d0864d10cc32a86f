//! Corruptions of images: the fifteen of ImageNet-C (Hendrycks and Dietterich, ICLR 2019) in five severities, written
//! from their definitions, and further ones of cameras and weather.
//!
//! ImageNet-C defines lengths for images of 224 x 224. Here they scale with the image, so that a severity means the same
//! at every size. Frost is procedural instead of photographed.

mod blur;
mod digital;
mod lens;
mod noise;
mod raster;
mod texture;
mod weather;

use crate::{DatasetError, Image};
use carff_base::random::{Key, tag};
use raster::Raster;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::ops::RangeInclusive;

/// Name of the random streams, so that no other draw of the same run shares them.
const STREAM: u64 = tag("corrupt");

/// A corruption of an image.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Corruption {
    /// Normal noise of each channel.
    GaussianNoise,
    /// Poisson noise of few photons.
    ShotNoise,
    /// Channels of some pixels are black or white.
    ImpulseNoise,
    /// Blur by a disk.
    DefocusBlur,
    /// Pixels change places with near ones.
    GlassBlur,
    /// Blur along a direction.
    MotionBlur,
    /// Blur along the rays from the middle.
    ZoomBlur,
    /// Flakes that fall, over a whitened image. Severity 2 has more and smaller flakes than 3, and is about as strong.
    Snow,
    /// Crystals on the lens. Severities 3 and 4 have the same crystals over an image of another brightness.
    Frost,
    /// A bright veil of uneven density.
    Fog,
    /// A larger value in HSV.
    Brightness,
    /// Colours closer to their mean.
    Contrast,
    /// A random affine map and local shifts. Severities 1 and 2 differ mostly by the map, 3 to 5 by the shifts: severity
    /// 3 changes less of an image than 2.
    ElasticTransform,
    /// Large pixels.
    Pixelate,
    /// Strong JPEG compression.
    JpegCompression,
    /// Thin bright streaks and haze.
    Rain,
    /// Dark blots on the lens.
    Dirt,
    /// Shades of grey.
    Monochrome,
    /// Channels in another order.
    ChannelSwap,
    /// A longer lens: a narrower field of view than the camera reports.
    NarrowLens,
    /// Barrel distortion that the camera does not report.
    BarrelDistortion,
    /// A shifted view: the camera has turned from the pose that it reports.
    TurnedCamera,
}

/// Reason why an image cannot be corrupted.
#[derive(Debug, thiserror::Error)]
pub enum CorruptionError {
    /// The corruption has no such severity.
    #[error("`{name}` has no severity {severity}; from {lowest} to {highest} are allowed")]
    NoSuchSeverity {
        /// Name of the corruption.
        name: &'static str,
        /// Requested severity.
        severity: u8,
        /// Lowest severity.
        lowest: u8,
        /// Highest severity.
        highest: u8,
    },
    /// The image is empty, or its bytes do not match its size.
    #[error("{bytes} bytes are not an image of {width_px}x{height_px} pixels; RGB with at least one pixel is needed")]
    Size {
        /// Number of bytes.
        bytes: usize,
        /// Width, pixels.
        width_px: u32,
        /// Height, pixels.
        height_px: u32,
    },
    /// The image is too large for the JPEG format.
    #[error("the image cannot be compressed: {0}")]
    Encoding(#[from] image::ImageError),
    /// The compressed image cannot be read.
    #[error(transparent)]
    Decoding(#[from] DatasetError),
}

impl Corruption {
    /// All corruptions; the first fifteen are those of ImageNet-C.
    pub const ALL: [Self; 22] = [
        Self::GaussianNoise,
        Self::ShotNoise,
        Self::ImpulseNoise,
        Self::DefocusBlur,
        Self::GlassBlur,
        Self::MotionBlur,
        Self::ZoomBlur,
        Self::Snow,
        Self::Frost,
        Self::Fog,
        Self::Brightness,
        Self::Contrast,
        Self::ElasticTransform,
        Self::Pixelate,
        Self::JpegCompression,
        Self::Rain,
        Self::Dirt,
        Self::Monochrome,
        Self::ChannelSwap,
        Self::NarrowLens,
        Self::BarrelDistortion,
        Self::TurnedCamera,
    ];

    /// Returns the name in files and tables.
    pub fn name(self) -> &'static str {
        match self {
            Self::GaussianNoise => "gaussian_noise",
            Self::ShotNoise => "shot_noise",
            Self::ImpulseNoise => "impulse_noise",
            Self::DefocusBlur => "defocus_blur",
            Self::GlassBlur => "glass_blur",
            Self::MotionBlur => "motion_blur",
            Self::ZoomBlur => "zoom_blur",
            Self::Snow => "snow",
            Self::Frost => "frost",
            Self::Fog => "fog",
            Self::Brightness => "brightness",
            Self::Contrast => "contrast",
            Self::ElasticTransform => "elastic_transform",
            Self::Pixelate => "pixelate",
            Self::JpegCompression => "jpeg_compression",
            Self::Rain => "rain",
            Self::Dirt => "dirt",
            Self::Monochrome => "monochrome",
            Self::ChannelSwap => "channel_swap",
            Self::NarrowLens => "narrow_lens",
            Self::BarrelDistortion => "barrel_distortion",
            Self::TurnedCamera => "turned_camera",
        }
    }

    /// Returns the corruption of this name; `None` if there is none.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|corruption| corruption.name() == name)
    }

    /// Returns the severities, from mild to strong: 1 to 5, or only 1.
    pub fn severities(self) -> RangeInclusive<u8> {
        match self {
            Self::Monochrome | Self::ChannelSwap => 1..=1,
            _ => 1..=5,
        }
    }

    /// Returns a corrupted copy of an image, of the same size. The same key gives the same bytes. Severities share their
    /// draws, so that a blot of dirt keeps its place; corruptions do not.
    ///
    /// ```
    /// use carff_base::random::Key;
    /// use carff_dataset::{Corruption, Image};
    /// # fn main() -> Result<(), carff_dataset::CorruptionError> {
    /// let grey = Image::filled(32, 24, [90; 3]);
    /// let foggy = Corruption::Fog.apply(&grey, 3, Key::named("fog", 7, 0))?;
    /// assert_eq!((foggy.width_px, foggy.height_px), (32, 24));
    /// assert_ne!(foggy, grey);
    /// # Ok(())
    /// # }
    /// ```
    ///
    /// # Errors
    ///
    /// The severity is not one of [`Self::severities`], or the image is not valid.
    pub fn apply(self, image: &Image, severity: u8, key: Key) -> Result<Image, CorruptionError> {
        let allowed = self.severities();
        if !allowed.contains(&severity) {
            let (name, lowest, highest) = (self.name(), *allowed.start(), *allowed.end());
            return Err(CorruptionError::NoSuchSeverity { name, severity, lowest, highest });
        }
        let (width_px, height_px) = (image.width_px, image.height_px);
        let source =
            Raster::from_image(image).ok_or(CorruptionError::Size { bytes: image.rgb.len(), width_px, height_px })?;
        if self == Self::JpegCompression {
            return digital::jpeg(image, usize::from(severity) - 1);
        }
        let stream = STREAM.wrapping_add(self as u64);
        let rng = &mut carff_base::random::stream(Key { seed: key.seed ^ stream, ..key });
        let level = usize::from(severity) - 1;
        let corrupted = match self {
            Self::GaussianNoise => noise::gaussian(source, level, rng),
            Self::ShotNoise => noise::shot(source, level, rng),
            Self::ImpulseNoise => noise::impulse(source, level, rng),
            Self::DefocusBlur => blur::defocus(&source, level),
            Self::GlassBlur => blur::glass(&source, level, rng),
            Self::MotionBlur => blur::motion(&source, level, rng),
            Self::ZoomBlur => blur::zoom(&source, level),
            Self::Snow => weather::snow(&source, level, rng),
            Self::Frost => weather::frost(&source, level, rng),
            Self::Fog => weather::fog(&source, level, rng),
            Self::Brightness => digital::brightness(source, level),
            Self::Contrast => digital::contrast(source, level),
            Self::ElasticTransform => digital::elastic(&source, level, rng),
            Self::Pixelate => digital::pixelate(&source, level),
            Self::JpegCompression => source,
            Self::Rain => weather::rain(source, level, rng),
            Self::Dirt => lens::dirt(source, level, rng),
            Self::Monochrome => lens::monochrome(source),
            Self::ChannelSwap => lens::channel_swap(source, rng),
            Self::NarrowLens => lens::narrow(&source, level),
            Self::BarrelDistortion => lens::barrel(&source, level),
            Self::TurnedCamera => lens::turned(&source, level, rng),
        };
        Ok(corrupted.into_image())
    }
}
