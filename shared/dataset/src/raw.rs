//! Images as cameras and recordings deliver them: borrowed bytes with a pixel format and a row length.

use std::fmt;
use std::str::FromStr;

/// Order of the bytes of a pixel.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PixelFormat {
    /// Red, green, blue.
    Rgb8,
    /// Blue, green, red.
    Bgr8,
    /// Red, green, blue, alpha (ignored).
    Rgba8,
    /// Blue, green, red, alpha (ignored).
    Bgra8,
    /// Brightness.
    Mono8,
    /// Two pixels in four bytes: Y U Y V.
    Yuyv,
    /// Two pixels in four bytes: U Y V Y.
    Uyvy,
}

/// Names of the supported formats, as ROS and Foxglove use them.
const NAMES: [(&str, PixelFormat); 11] = [
    ("rgb8", PixelFormat::Rgb8),
    ("bgr8", PixelFormat::Bgr8),
    ("8UC3", PixelFormat::Bgr8),
    ("rgba8", PixelFormat::Rgba8),
    ("bgra8", PixelFormat::Bgra8),
    ("8UC4", PixelFormat::Bgra8),
    ("mono8", PixelFormat::Mono8),
    ("8UC1", PixelFormat::Mono8),
    ("yuv422_yuy2", PixelFormat::Yuyv),
    ("yuyv", PixelFormat::Yuyv),
    ("uyvy", PixelFormat::Uyvy),
];

/// Reason why a raw image cannot be used.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum RawError {
    /// The encoding is not supported.
    #[error(
        "the encoding `{encoding}` is not supported; supported are {}: convert the images where they are made",
        NAMES.map(|(name, _)| name).join(", ")
    )]
    Encoding {
        /// Name of the encoding.
        encoding: String,
    },
    /// The image has no pixels, or more than a frame may have.
    #[error("an image of {0}x{1} pixels; a camera's image has 1 to {MAX_SIDE_PX} pixels a side: scale it")]
    Size(u32, u32),
    /// The rows are shorter than the width.
    #[error("rows of {step} bytes, but {width_px} pixels need {needed}: correct the image's `step` or width")]
    Step {
        /// Length of a row, bytes.
        step: usize,
        /// Width, pixels.
        width_px: u32,
        /// Bytes of the pixels of a row.
        needed: usize,
    },
    /// Bytes are missing.
    #[error("{found} bytes, but its size needs {needed}: the image is cut off, send it whole")]
    CutOff {
        /// Number of bytes.
        found: usize,
        /// Number of bytes needed.
        needed: usize,
    },
}

/// Largest width or height of a raw image, pixels.
pub const MAX_SIDE_PX: u32 = 8192;

impl FromStr for PixelFormat {
    type Err = RawError;

    fn from_str(name: &str) -> Result<Self, RawError> {
        let found = NAMES.iter().find(|(known, _)| known.eq_ignore_ascii_case(name));
        // ROS 2's older name of UYVY.
        let found = found.map(|(_, format)| *format).or((name == "yuv422").then_some(Self::Uyvy));
        found.ok_or_else(|| RawError::Encoding { encoding: name.to_owned() })
    }
}

impl fmt::Display for PixelFormat {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(NAMES.iter().find(|(_, format)| format == self).map_or("?", |(name, _)| name))
    }
}

impl PixelFormat {
    fn pixel_bytes(self) -> usize {
        match self {
            Self::Rgb8 | Self::Bgr8 => 3,
            Self::Rgba8 | Self::Bgra8 => 4,
            Self::Mono8 => 1,
            Self::Yuyv | Self::Uyvy => 2,
        }
    }
}

/// A borrowed image.
#[derive(Clone, Copy, Debug)]
pub struct RawImage<'a> {
    width_px: u32,
    height_px: u32,
    step: usize,
    format: PixelFormat,
    data: &'a [u8],
}

impl<'a> RawImage<'a> {
    /// Checks the size of an image; `step` is the length of a row, bytes.
    pub fn new(size_px: [u32; 2], step: usize, format: PixelFormat, data: &'a [u8]) -> Result<Self, RawError> {
        let [width_px, height_px] = size_px;
        if width_px == 0 || height_px == 0 || width_px > MAX_SIDE_PX || height_px > MAX_SIDE_PX {
            return Err(RawError::Size(width_px, height_px));
        }
        let row = match format {
            // An odd last pixel has its own pair.
            PixelFormat::Yuyv | PixelFormat::Uyvy => width_px.div_ceil(2) as usize * 4,
            _ => width_px as usize * format.pixel_bytes(),
        };
        if step < row {
            return Err(RawError::Step { step, width_px, needed: row });
        }
        let needed = step.saturating_mul(height_px as usize - 1).saturating_add(row);
        if data.len() < needed {
            return Err(RawError::CutOff { found: data.len(), needed });
        }
        Ok(Self { width_px, height_px, step, format, data })
    }

    /// Returns a borrowed RGB image without gaps between its rows.
    pub fn rgb(size_px: [u32; 2], data: &'a [u8]) -> Result<Self, RawError> {
        Self::new(size_px, size_px[0] as usize * 3, PixelFormat::Rgb8, data)
    }

    /// Returns width and height, pixels.
    pub fn size_px(&self) -> [u32; 2] {
        [self.width_px, self.height_px]
    }

    /// Returns the colour of a pixel inside the image.
    pub fn pixel(&self, x: usize, y: usize) -> [u8; 3] {
        let row = &self.data[y * self.step..];
        let at = |i: usize| row[i];
        let i = x * self.format.pixel_bytes();
        match self.format {
            PixelFormat::Rgb8 | PixelFormat::Rgba8 => [at(i), at(i + 1), at(i + 2)],
            PixelFormat::Bgr8 | PixelFormat::Bgra8 => [at(i + 2), at(i + 1), at(i)],
            PixelFormat::Mono8 => [at(i); 3],
            PixelFormat::Yuyv => rgb_of(at(i), at(x / 2 * 4 + 1), at(x / 2 * 4 + 3)),
            PixelFormat::Uyvy => rgb_of(at(i + 1), at(x / 2 * 4), at(x / 2 * 4 + 2)),
        }
    }

    /// Writes the image as RGB without gaps; `out` has width x height x 3 bytes.
    pub fn write_rgb(&self, out: &mut [u8]) {
        let (width, row_bytes) = (self.width_px as usize, self.width_px as usize * 3);
        for (y, row) in out.chunks_exact_mut(row_bytes).enumerate() {
            if self.format == PixelFormat::Rgb8 {
                row.copy_from_slice(&self.data[y * self.step..][..row_bytes]);
                continue;
            }
            for (pixel, x) in row.chunks_exact_mut(3).zip(0..width) {
                pixel.copy_from_slice(&self.pixel(x, y));
            }
        }
    }
}

/// Returns the colour of ITU-R BT.601 in limited range, which cameras deliver.
fn rgb_of(y: u8, u: u8, v: u8) -> [u8; 3] {
    let (y, u, v) = (298 * (i32::from(y) - 16), i32::from(u) - 128, i32::from(v) - 128);
    [y + 409 * v, y - 100 * u - 208 * v, y + 516 * u].map(|c| ((c + 128) >> 8).clamp(0, 255) as u8)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Each format gives the same colours; gaps between rows and alpha are ignored.
    #[test]
    fn formats_agree() {
        let rgb = [[10, 20, 30], [200, 100, 50]];
        let of = |name: &str, step: usize, data: &[u8]| {
            let image = RawImage::new([2, 1], step, name.parse().unwrap(), data).unwrap();
            let mut out = [0; 6];
            image.write_rgb(&mut out);
            assert_eq!([image.pixel(0, 0), image.pixel(1, 0)].concat(), out);
            out
        };
        assert_eq!(of("rgb8", 8, &[10, 20, 30, 200, 100, 50, 7, 7]), *rgb.concat());
        assert_eq!(of("bgr8", 6, &[30, 20, 10, 50, 100, 200]), *rgb.concat());
        assert_eq!(of("BGRA8", 8, &[30, 20, 10, 9, 50, 100, 200, 9]), *rgb.concat());
        assert_eq!(of("8UC1", 2, &[5, 6]), [5, 5, 5, 6, 6, 6]);
        // White and black without colour.
        assert_eq!(of("yuyv", 4, &[235, 128, 16, 128]), [255, 255, 255, 0, 0, 0]);
        assert_eq!(of("yuv422", 4, &[128, 235, 128, 16]), [255, 255, 255, 0, 0, 0]);
    }

    /// Unknown encodings, empty images, short rows and missing bytes are refused.
    #[test]
    fn wrong_images_are_refused() {
        let error = "bayer_rggb8".parse::<PixelFormat>().unwrap_err().to_string();
        assert!(error.contains("bayer_rggb8") && error.contains("rgb8") && error.contains("convert"), "{error}");
        let new = |size, step, data: &[u8]| RawImage::new(size, step, PixelFormat::Rgb8, data).map(|_| ());
        assert_eq!(new([0, 4], 0, &[]), Err(RawError::Size(0, 4)));
        assert_eq!(new([4, 9000], 12, &[]), Err(RawError::Size(4, 9000)));
        assert!(matches!(new([4, 4], 11, &[0; 48]), Err(RawError::Step { needed: 12, .. })));
        assert!(matches!(new([4, 4], 12, &[0; 47]), Err(RawError::CutOff { needed: 48, .. })));
        assert!(new([4, 4], usize::MAX, &[0; 48]).unwrap_err().to_string().contains("cut off"));
    }
}
