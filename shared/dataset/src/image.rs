//! Images in memory and as PNG files.

use std::fs::File;
use std::io::{BufReader, BufWriter, Cursor};
use std::path::Path;

use image::codecs::png::PngEncoder;
use image::metadata::Orientation;
use image::{ColorType, DynamicImage, ExtendedColorType, ImageDecoder, ImageEncoder, ImageFormat, ImageReader, Limits};

use ndarray::{ArrayView3, ArrayViewMut3, s};

use crate::error::DatasetError;
use crate::jpeg;

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

    /// Returns the indices of the pixels in which a channel differs from `other` by more than `tolerance`, of 255, row by
    /// row. Both images have the same size; pixels that only one of them has are left out.
    pub fn differing_pixels(&self, other: &Image, tolerance: u8) -> impl Iterator<Item = usize> {
        let pixels = self.rgb.chunks_exact(3).zip(other.rgb.chunks_exact(3)).enumerate();
        let differs = move |(a, b): (&[u8], &[u8])| a.iter().zip(b).any(|(a, b)| a.abs_diff(*b) > tolerance);
        pixels.filter_map(move |(i, pair)| differs(pair).then_some(i))
    }

    /// Reads a PNG or JPEG image with eight bits per channel; the content decides, not the name. Grey becomes RGB with
    /// equal channels. An opaque alpha channel is dropped.
    ///
    /// # Errors
    ///
    /// Names the file. A transparent pixel is an error, because its background is unknown; so is a cut-off file.
    pub fn load(path: &Path) -> Result<Self, DatasetError> {
        let problem = |problem: String| DatasetError::Image { path: path.to_owned(), problem };
        let decoded = decode(path)?;
        let opaque = match decoded.color() {
            ColorType::Rgb8 | ColorType::L8 => None,
            ColorType::Rgba8 | ColorType::La8 => Some(decoded.to_rgba8()),
            other => return Err(problem(format!("pixel type {other:?}; RGB with 8 bits per channel is needed"))),
        };
        if let Some((x, y, _)) = opaque.iter().flat_map(|rgba| rgba.enumerate_pixels()).find(|(_, _, p)| p.0[3] != 255)
        {
            return Err(problem(format!(
                "pixel ({x}, {y}) is transparent; only opaque images are accepted, so compose it over its background \
                 first"
            )));
        }
        let (width_px, height_px) = (decoded.width(), decoded.height());
        Ok(Self { width_px, height_px, rgb: decoded.into_rgb8().into_raw() })
    }

    /// Decodes a PNG or JPEG image of any pixel type from memory; errors name `source`. Transparency is ignored.
    pub fn decode(bytes: &[u8], source: &Path) -> Result<Self, DatasetError> {
        let decoded = decode_bytes(source, bytes)?;
        let (width_px, height_px) = (decoded.width(), decoded.height());
        Ok(Self { width_px, height_px, rgb: decoded.into_rgb8().into_raw() })
    }

    /// Writes the image as an 8-bit RGB PNG file.
    pub fn save_png(&self, path: &Path) -> Result<(), DatasetError> {
        write_png(path, &self.rgb, self.width_px, self.height_px, ExtendedColorType::Rgb8)
    }
}

/// Returns true if two images look the same: equal size, and at most [`MAX_DIFFERENT_PIXELS`] pixels differ by more
/// than [`PIXEL_TOLERANCE`] in any channel.
pub fn looks_same(a: &Image, b: &Image) -> bool {
    looks_same_where(a, b, |_| true)
}

/// Returns [`looks_same`] for the pixels whose index `counts`.
pub fn looks_same_where(a: &Image, b: &Image, counts: impl Fn(usize) -> bool) -> bool {
    let differing = a.differing_pixels(b, PIXEL_TOLERANCE).filter(|&i| counts(i));
    (a.width_px, a.height_px) == (b.width_px, b.height_px)
        && differing.take(MAX_DIFFERENT_PIXELS + 1).count() <= MAX_DIFFERENT_PIXELS
}

/// Reads width and height from the header of a PNG or JPEG file, pixels.
pub(crate) fn dimensions(path: &Path) -> Result<(u32, u32), DatasetError> {
    let io = |source| DatasetError::Io { path: path.to_owned(), source };
    let reader = ImageReader::new(BufReader::new(File::open(path).map_err(io)?)).with_guessed_format().map_err(io)?;
    reader.into_dimensions().map_err(|error| unreadable(path, &error.to_string()))
}

/// Returns true if the file asks viewers to turn or mirror the image (EXIF orientation). The pixels are used as stored.
pub(crate) fn is_turned(path: &Path) -> bool {
    let reader = ImageReader::open(path).and_then(ImageReader::with_guessed_format);
    let decoder = reader.ok().and_then(|reader| reader.into_decoder().ok());
    decoder.is_some_and(|mut decoder| decoder.orientation().is_ok_and(|found| found != Orientation::NoTransforms))
}

/// Reads a PNG or JPEG file of any pixel type as RGB, over `background` where it is transparent.
pub(crate) fn load_any(path: &Path, background: [u8; 3]) -> Result<Image, DatasetError> {
    let rgba = decode(path)?.into_rgba8();
    let over = |value: u8, below: u8, alpha: u8| {
        ((u32::from(value) * u32::from(alpha) + u32::from(below) * u32::from(255 - alpha) + 127) / 255) as u8
    };
    let rgb = rgba.pixels().flat_map(|p| [0, 1, 2].map(|c| over(p.0[c], background[c], p.0[3]))).collect();
    Ok(Image { width_px: rgba.width(), height_px: rgba.height(), rgb })
}

/// Reads a mask of an image of this size: false where all its colour channels are zero, as in nerfstudio's `mask_path`.
pub(crate) fn load_mask(path: &Path, (width_px, height_px): (u32, u32)) -> Result<Vec<bool>, DatasetError> {
    let mask = decode(path)?.into_rgb16();
    if mask.dimensions() != (width_px, height_px) {
        let (w, h) = mask.dimensions();
        let problem = format!("the mask has {w}x{h} pixels, and its image {width_px}x{height_px}; scale it");
        return Err(DatasetError::Image { path: path.to_owned(), problem });
    }
    Ok(mask.pixels().map(|p| p.0 != [0; 3]).collect())
}

/// Decodes a PNG or JPEG file by its content. A JPEG file is decoded twice: the image of a file without some of its data
/// changes with the bytes after the data.
fn decode(path: &Path) -> Result<DynamicImage, DatasetError> {
    let bytes = std::fs::read(path).map_err(|source| DatasetError::Io { path: path.to_owned(), source })?;
    if !image::guess_format(&bytes).is_ok_and(|format| format == ImageFormat::Jpeg) {
        return decode_bytes(path, &bytes);
    }
    let end = jpeg::end_of_whole(&bytes).map_err(|why| unreadable(path, why))?;
    let [image, other] = jpeg::filled(&bytes, end).map(|filled| decode_bytes(path, &filled));
    match (image?, other?) {
        (image, other) if image == other => Ok(image),
        _ => Err(unreadable(path, jpeg::NO_DATA)),
    }
}

/// Decodes PNG or JPEG bytes; errors name `path`.
fn decode_bytes(path: &Path, bytes: &[u8]) -> Result<DynamicImage, DatasetError> {
    let format = match image::guess_format(bytes) {
        Ok(format @ (ImageFormat::Png | ImageFormat::Jpeg)) => format,
        Ok(other) => return Err(unreadable(path, &format!("a {other:?} file"))),
        Err(_) if bytes.is_empty() => return Err(unreadable(path, "the file is empty; copy or export it again")),
        Err(_) => {
            return Err(unreadable(path, carff_base::errors::stand_in(bytes).unwrap_or("it starts like neither")));
        }
    };
    if format == ImageFormat::Jpeg {
        jpeg::end_of_whole(bytes).map_err(|why| unreadable(path, why))?;
    }
    let mut limits = Limits::default();
    limits.max_image_width = Some(MAX_IMAGE_SIDE_PX);
    limits.max_image_height = Some(MAX_IMAGE_SIDE_PX);
    let mut reader = ImageReader::with_format(Cursor::new(bytes), format);
    reader.limits(limits);
    reader.decode().map_err(|error| unreadable(path, &error.to_string()))
}

fn unreadable(path: &Path, why: &str) -> DatasetError {
    DatasetError::Image { path: path.to_owned(), problem: format!("not a readable PNG or JPEG image: {why}") }
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
        assert_eq!(Image::load(&path).unwrap(), gradient());
    }

    /// Opaque alpha is dropped, transparency is refused with its position, grey becomes RGB, and 16 bits are refused.
    #[test]
    fn other_pixel_types() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.png");
        let mut rgba: Vec<u8> = gradient().rgb.chunks(3).flat_map(|p| [p[0], p[1], p[2], 255]).collect();
        write_png(&path, &rgba, 5, 4, ExtendedColorType::Rgba8).unwrap();
        assert_eq!(Image::load(&path).unwrap(), gradient());
        rgba[7 * 4 + 3] = 254;
        write_png(&path, &rgba, 5, 4, ExtendedColorType::Rgba8).unwrap();
        let message = Image::load(&path).unwrap_err().to_string();
        assert!(message.contains("a.png: pixel (2, 1) is transparent"), "{message}");
        write_png(&path, &[9; 20], 5, 4, ExtendedColorType::L8).unwrap();
        assert_eq!(Image::load(&path).unwrap(), Image::filled(5, 4, [9; 3]));
        write_png(&path, &[9; 40], 5, 4, ExtendedColorType::L16).unwrap();
        let message = Image::load(&path).unwrap_err().to_string();
        assert!(message.contains("L16") && message.contains("8 bits per channel"), "{message}");
    }

    /// A file that is not PNG, a cut-off file and a missing file are errors that name the file.
    #[test]
    fn broken_files_are_named() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("broken.png");
        std::fs::write(&path, b"not an image").unwrap();
        assert!(Image::load(&path).unwrap_err().to_string().contains("broken.png: not a readable PNG"));
        gradient().save_png(&path).unwrap();
        let bytes = std::fs::read(&path).unwrap();
        std::fs::write(&path, &bytes[..bytes.len() / 2]).unwrap();
        assert!(Image::load(&path).unwrap_err().to_string().contains("broken.png: not a readable PNG"));
        let missing = dir.path().join("missing.png");
        assert!(Image::load(&missing).unwrap_err().to_string().contains("missing.png"));
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
