//! Images in memory and as PNG files.

use std::fs::File;
use std::io::{BufReader, BufWriter};
use std::path::Path;

use image::codecs::jpeg::JpegDecoder;
use image::codecs::png::{PngDecoder, PngEncoder};
use image::{ColorType, ExtendedColorType, ImageDecoder, ImageEncoder, ImageFormat, ImageReader, Limits};

use ndarray::{ArrayView3, ArrayViewMut3, s};

use crate::error::DatasetError;

/// Maximum width or height of an image, pixels.
pub const MAX_IMAGE_SIDE_PX: u32 = 8192;
/// Two images look the same if at most this many pixels differ by more than [`PIXEL_TOLERANCE`].
pub const MAX_DIFFERENT_PIXELS: usize = 8;
/// Largest difference in any channel, of 255, that is ignored.
pub const PIXEL_TOLERANCE: u8 = 12;

/// An 8-bit RGB image, row-major from the top left.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Image {
    /// Width, pixels.
    pub width_px: u32,
    /// Height, pixels.
    pub height_px: u32,
    /// Height x width x 3 values, HWC, 0..=255.
    pub rgb: Vec<u8>,
}

impl Image {
    /// Returns an image of one colour.
    pub fn filled(width_px: u32, height_px: u32, colour: [u8; 3]) -> Self {
        Self { width_px, height_px, rgb: colour.repeat(width_px as usize * height_px as usize) }
    }

    /// Returns the image as (height, width, channel); `None` if the number of bytes does not match its size.
    pub fn view(&self) -> Option<ArrayView3<'_, u8>> {
        ArrayView3::from_shape(self.shape(), &self.rgb).ok()
    }

    fn view_mut(&mut self) -> Option<ArrayViewMut3<'_, u8>> {
        ArrayViewMut3::from_shape(self.shape(), &mut self.rgb).ok()
    }

    fn shape(&self) -> (usize, usize, usize) {
        (self.height_px as usize, self.width_px as usize, 3)
    }

    /// Returns the colour at column `x_px` and row `y_px`; `None` outside the image.
    pub fn pixel(&self, x_px: u32, y_px: u32) -> Option<[u8; 3]> {
        let image = self.view()?;
        let channel = |c| image.get((y_px as usize, x_px as usize, c)).copied();
        Some([channel(0)?, channel(1)?, channel(2)?])
    }

    /// Copies `other` into this image with its top left corner at (`x_px`, `y_px`), cut off at the edges.
    pub fn paste(&mut self, other: &Image, x_px: u32, y_px: u32) {
        let columns = other.width_px.min(self.width_px.saturating_sub(x_px)) as usize;
        let rows = other.height_px.min(self.height_px.saturating_sub(y_px)) as usize;
        let (x, y) = (x_px as usize, y_px as usize);
        if let (Some(mut to), Some(from), true) = (self.view_mut(), other.view(), rows * columns > 0) {
            to.slice_mut(s![y..y + rows, x..x + columns, ..]).assign(&from.slice(s![..rows, ..columns, ..]));
        }
    }

    /// Returns the peak signal-to-noise ratio against an image of the same size, decibels (peak 255); infinite if
    /// equal, `None` if the sizes differ.
    pub fn psnr_db(&self, other: &Image) -> Option<f64> {
        if (self.width_px, self.height_px) != (other.width_px, other.height_px) {
            return None;
        }
        let sum: f64 =
            self.rgb.iter().zip(&other.rgb).map(|(&a, &b)| (f64::from(a) - f64::from(b)).powi(2)).sum::<f64>();
        Some(10.0 * (255.0_f64 * 255.0 * self.rgb.len() as f64 / sum).log10())
    }

    /// Reads a PNG image with eight bits per channel. Grey becomes RGB with equal channels. An opaque alpha channel is
    /// dropped; a transparent pixel is an error, because its background is unknown.
    pub fn load_png(path: &Path) -> Result<Self, DatasetError> {
        let problem = |problem: String| DatasetError::Image { path: path.to_owned(), problem };
        let file = File::open(path).map_err(|source| DatasetError::Io { path: path.to_owned(), source })?;
        let mut limits = Limits::default();
        limits.max_image_width = Some(MAX_IMAGE_SIDE_PX);
        limits.max_image_height = Some(MAX_IMAGE_SIDE_PX);
        let decoder = PngDecoder::with_limits(BufReader::new(file), limits)
            .map_err(|error| problem(format!("not a readable PNG image: {error}")))?;
        let (width_px, height_px) = decoder.dimensions();
        if width_px > MAX_IMAGE_SIDE_PX || height_px > MAX_IMAGE_SIDE_PX {
            return Err(problem(format!("{width_px}x{height_px} pixels; at most {MAX_IMAGE_SIDE_PX} a side")));
        }
        let color = decoder.color_type();
        let channels = match color {
            ColorType::Rgb8 => 3,
            ColorType::Rgba8 => 4,
            ColorType::L8 => 1,
            ColorType::La8 => 2,
            other => return Err(problem(format!("pixel type {other:?}; RGB with 8 bits per channel is needed"))),
        };
        let mut bytes = vec![0; decoder.total_bytes() as usize];
        decoder.read_image(&mut bytes).map_err(|error| problem(format!("not a readable PNG image: {error}")))?;
        let opaque_part = if channels % 2 == 0 {
            if let Some(at) = bytes.chunks_exact(channels).position(|pixel| pixel[channels - 1] != 255) {
                let (x, y) = (at % width_px as usize, at / width_px as usize);
                return Err(problem(format!(
                    "pixel ({x}, {y}) is transparent; only opaque images are accepted, so compose it over its \
                     background first"
                )));
            }
            channels - 1
        } else {
            channels
        };
        let rgb = if channels == 3 {
            bytes
        } else {
            bytes
                .chunks_exact(channels)
                .flat_map(|pixel| if opaque_part == 1 { [pixel[0]; 3] } else { [pixel[0], pixel[1], pixel[2]] })
                .collect()
        };
        Ok(Self { width_px, height_px, rgb })
    }

    /// Writes the image as an 8-bit RGB PNG file.
    pub fn save_png(&self, path: &Path) -> Result<(), DatasetError> {
        write_png(path, &self.rgb, self.width_px, self.height_px, ExtendedColorType::Rgb8)
    }
}

/// Returns true if two images look the same: equal size, and at most [`MAX_DIFFERENT_PIXELS`] pixels differ by more
/// than [`PIXEL_TOLERANCE`] in any channel.
pub fn looks_same(a: &Image, b: &Image) -> bool {
    (a.width_px, a.height_px) == (b.width_px, b.height_px)
        && different_pixels(a, b).take(MAX_DIFFERENT_PIXELS + 1).count() <= MAX_DIFFERENT_PIXELS
}

fn different_pixels<'a>(a: &'a Image, b: &'a Image) -> impl Iterator<Item = usize> + 'a {
    a.rgb.chunks_exact(3).zip(b.rgb.chunks_exact(3)).enumerate().filter_map(|(i, (a, b))| {
        let differs = a.iter().zip(b).any(|(a, b)| a.abs_diff(*b) > PIXEL_TOLERANCE);
        differs.then_some(i)
    })
}

/// Returns true if a file's name is that of a JPEG image.
fn is_jpeg(path: &Path) -> bool {
    path.extension().is_some_and(|e| e.eq_ignore_ascii_case("jpg") || e.eq_ignore_ascii_case("jpeg"))
}

/// Reads width and height from the header of a PNG or JPEG file, pixels.
pub(crate) fn dimensions(path: &Path) -> Result<(u32, u32), DatasetError> {
    let file = File::open(path).map_err(|source| DatasetError::Io { path: path.to_owned(), source })?;
    let file = BufReader::new(file);
    let found = if is_jpeg(path) {
        JpegDecoder::new(file).map(|decoder| decoder.dimensions())
    } else {
        PngDecoder::new(file).map(|decoder| decoder.dimensions())
    };
    found.map_err(|error| DatasetError::Image {
        path: path.to_owned(),
        problem: format!("not a readable image: {error}"),
    })
}

/// Reads a PNG or JPEG file of any pixel type as RGB, over `background` where it is transparent.
pub(crate) fn load_any(path: &Path, background: [u8; 3]) -> Result<Image, DatasetError> {
    let problem = |problem: String| DatasetError::Image { path: path.to_owned(), problem };
    let file = File::open(path).map_err(|source| DatasetError::Io { path: path.to_owned(), source })?;
    let mut limits = Limits::default();
    limits.max_image_width = Some(MAX_IMAGE_SIDE_PX);
    limits.max_image_height = Some(MAX_IMAGE_SIDE_PX);
    let format = if is_jpeg(path) { ImageFormat::Jpeg } else { ImageFormat::Png };
    let mut reader = ImageReader::with_format(BufReader::new(file), format);
    reader.limits(limits);
    let rgba = reader.decode().map_err(|error| problem(format!("not a readable image: {error}")))?.into_rgba8();
    let over = |value: u8, below: u8, alpha: u8| {
        ((u32::from(value) * u32::from(alpha) + u32::from(below) * u32::from(255 - alpha) + 127) / 255) as u8
    };
    let rgb = rgba.pixels().flat_map(|p| [0, 1, 2].map(|c| over(p.0[c], background[c], p.0[3]))).collect();
    Ok(Image { width_px: rgba.width(), height_px: rgba.height(), rgb })
}

/// Writes bytes of the given type as a PNG file.
pub(crate) fn write_png(
    path: &Path,
    bytes: &[u8],
    width_px: u32,
    height_px: u32,
    color: ExtendedColorType,
) -> Result<(), DatasetError> {
    let expected = (u64::from(width_px) * u64::from(height_px) * u64::from(color.bits_per_pixel())).div_ceil(8);
    if bytes.len() as u64 != expected || width_px == 0 || height_px == 0 {
        return Err(DatasetError::Image {
            path: path.to_owned(),
            problem: format!("{} bytes do not make an image of {width_px}x{height_px} pixels", bytes.len()),
        });
    }
    let file = File::create(path).map_err(|source| DatasetError::Io { path: path.to_owned(), source })?;
    PngEncoder::new(BufWriter::new(file))
        .write_image(bytes, width_px, height_px, color)
        .map_err(|error| DatasetError::Image { path: path.to_owned(), problem: format!("cannot be written: {error}") })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn gradient() -> Image {
        let rgb = (0..5 * 4 * 3).map(|v| (v * 4) as u8).collect();
        Image { width_px: 5, height_px: 4, rgb }
    }

    /// An image is read back as it was written, byte for byte.
    #[test]
    fn png_round_trip() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.png");
        gradient().save_png(&path).unwrap();
        assert_eq!(Image::load_png(&path).unwrap(), gradient());
    }

    /// Opaque alpha is dropped, transparency is refused with its position, grey becomes RGB, and 16 bits are refused.
    #[test]
    fn other_pixel_types() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.png");
        let mut rgba: Vec<u8> = gradient().rgb.chunks(3).flat_map(|p| [p[0], p[1], p[2], 255]).collect();
        write_png(&path, &rgba, 5, 4, ExtendedColorType::Rgba8).unwrap();
        assert_eq!(Image::load_png(&path).unwrap(), gradient());
        rgba[7 * 4 + 3] = 254;
        write_png(&path, &rgba, 5, 4, ExtendedColorType::Rgba8).unwrap();
        let message = Image::load_png(&path).unwrap_err().to_string();
        assert!(message.contains("a.png: pixel (2, 1) is transparent"), "{message}");
        write_png(&path, &[9; 20], 5, 4, ExtendedColorType::L8).unwrap();
        assert_eq!(Image::load_png(&path).unwrap(), Image::filled(5, 4, [9; 3]));
        write_png(&path, &[9; 40], 5, 4, ExtendedColorType::L16).unwrap();
        let message = Image::load_png(&path).unwrap_err().to_string();
        assert!(message.contains("L16") && message.contains("8 bits per channel"), "{message}");
    }

    /// A file that is not PNG, a cut-off file and a missing file are errors that name the file.
    #[test]
    fn broken_files_are_named() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("broken.png");
        std::fs::write(&path, b"not an image").unwrap();
        assert!(Image::load_png(&path).unwrap_err().to_string().contains("broken.png: not a readable PNG"));
        gradient().save_png(&path).unwrap();
        let bytes = std::fs::read(&path).unwrap();
        std::fs::write(&path, &bytes[..bytes.len() / 2]).unwrap();
        assert!(Image::load_png(&path).unwrap_err().to_string().contains("broken.png: not a readable PNG"));
        let missing = dir.path().join("missing.png");
        assert!(Image::load_png(&missing).unwrap_err().to_string().contains("missing.png"));
    }

    /// One channel that is off by 1 in every pixel of a black image gives 10 log10(255^2 * 3) decibels.
    #[test]
    fn psnr_of_a_known_error() {
        let black = Image::filled(4, 4, [0; 3]);
        let off = Image::filled(4, 4, [1, 0, 0]);
        let expected = 10.0 * (255.0_f64 * 255.0 * 3.0).log10();
        assert!((black.psnr_db(&off).unwrap() - expected).abs() < 1e-9);
        assert_eq!(black.psnr_db(&Image::filled(4, 5, [0; 3])), None);
    }

    /// Eight pixels may differ, nine may not; a difference of 12 is ignored, one of 13 is not.
    #[test]
    fn the_limits_are_exact() {
        let a = Image::filled(8, 8, [100; 3]);
        let with = |pixels: usize, difference: u8| {
            let mut b = a.clone();
            for i in 0..pixels {
                b.rgb[i * 3 + i % 3] += difference;
            }
            b
        };
        assert!(looks_same(&a, &with(8, 13)));
        assert!(!looks_same(&a, &with(9, 13)));
        assert!(looks_same(&a, &with(64, 12)));
        assert!(!looks_same(&a, &Image::filled(8, 9, [100; 3])));
    }
}
