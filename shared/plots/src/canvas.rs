//! Canvas of twice the size of the finished image: halving it makes lines and letters smooth.

use crate::{MAX_SIDE_PX, PlotError};
use carff_dataset::Image;
use plotters::coord::Shift;
use plotters::prelude::{BitMapBackend, DrawingArea, IntoDrawingArea, RGBColor};
use plotters::style::{FontDesc, FontFamily, FontStyle, IntoFont, TextStyle, register_font};
use std::sync::OnceLock;

/// Drawn pixels for one pixel of the finished image, along each side.
pub const OVERSAMPLING: u32 = 2;
/// Background of every image.
pub const PAPER: RGBColor = RGBColor(252, 252, 250);
/// Colour of headings and captions.
pub const INK: RGBColor = RGBColor(34, 38, 46);
/// Colour of secondary text.
pub const FAINT_INK: RGBColor = RGBColor(104, 110, 122);
/// Height of a line of text, in font sizes.
const LINE_HEIGHT: f64 = 1.3;
/// Offset of a line's text for the drawing library, in font sizes below the line's top.
const TEXT_OFFSET: f64 = 0.38;
/// Name of the font.
const FAMILY: &str = "carff";

/// An error of the drawing library, of any type.
pub fn drawing(error: impl std::fmt::Display) -> PlotError {
    PlotError::Drawing(error.to_string())
}

/// Weight of letters.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Weight {
    /// For captions.
    Regular,
    /// For headings.
    Bold,
}

/// Font with its size in pixels of the finished image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Font {
    /// Size, pixels.
    pub size_px: f64,
    /// Weight.
    pub weight: Weight,
}

impl Font {
    /// Regular letters.
    pub const fn regular(size_px: f64) -> Self {
        Self { size_px, weight: Weight::Regular }
    }

    /// Bold letters.
    pub const fn bold(size_px: f64) -> Self {
        Self { size_px, weight: Weight::Bold }
    }

    /// Height of one line, pixels.
    pub fn line_px(self) -> u32 {
        (self.size_px * LINE_HEIGHT).ceil() as u32
    }

    /// Width of a text on one line, pixels.
    pub fn width_px(self, text: &str) -> Result<u32, PlotError> {
        let (width, _) = self.description()?.box_size(text).map_err(drawing)?;
        Ok(width.div_ceil(OVERSAMPLING))
    }

    /// Wraps a text into lines of at most `width_px`, between words, or within a word that is too long.
    pub fn wrapped(self, text: &str, width_px: u32) -> Result<Vec<String>, PlotError> {
        let mut lines = Vec::new();
        let mut line = String::new();
        for word in text.split_whitespace() {
            let longer = if line.is_empty() { word.to_owned() } else { format!("{line} {word}") };
            if self.width_px(&longer)? <= width_px {
                line = longer;
                continue;
            }
            if !line.is_empty() {
                lines.push(std::mem::take(&mut line));
            }
            for letter in word.chars() {
                line.push(letter);
                if line.chars().count() > 1 && self.width_px(&line)? > width_px {
                    line.pop();
                    lines.push(std::mem::replace(&mut line, letter.to_string()));
                }
            }
        }
        if !line.is_empty() {
            lines.push(line);
        }
        Ok(lines)
    }

    /// Font for the drawing library, in drawn pixels.
    pub fn style(self, colour: RGBColor) -> Result<TextStyle<'static>, PlotError> {
        Ok(self.description()?.color(&colour))
    }

    fn description(self) -> Result<FontDesc<'static>, PlotError> {
        static REGISTERED: OnceLock<bool> = OnceLock::new();
        let registered = REGISTERED.get_or_init(|| {
            register_font(FAMILY, FontStyle::Normal, dejavu::sans::regular()).is_ok()
                && register_font(FAMILY, FontStyle::Bold, dejavu::sans::bold()).is_ok()
        });
        if !registered {
            return Err(drawing("the built-in font is not readable"));
        }
        let style = match self.weight {
            Weight::Regular => FontStyle::Normal,
            Weight::Bold => FontStyle::Bold,
        };
        Ok((FontFamily::Name(FAMILY), self.size_px * f64::from(OVERSAMPLING), style).into_font())
    }
}

/// Rectangle in pixels of the finished image: left, top, width, height.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PixelArea {
    /// Left edge.
    pub x: u32,
    /// Top edge.
    pub y: u32,
    /// Width.
    pub width: u32,
    /// Height.
    pub height: u32,
}

/// An image that is being drawn.
pub struct Canvas {
    width_px: u32,
    height_px: u32,
    rgb: Vec<u8>,
}

impl Canvas {
    /// An empty page of the finished size.
    pub fn new(width_px: u32, height_px: u32) -> Result<Self, PlotError> {
        if width_px.max(height_px) > MAX_SIDE_PX {
            return Err(PlotError::TooLarge { width_px, height_px });
        }
        let (width_px, height_px) = (width_px.max(1), height_px.max(1));
        let pixels = (width_px * OVERSAMPLING) as usize * (height_px * OVERSAMPLING) as usize;
        Ok(Self { width_px, height_px, rgb: [PAPER.0, PAPER.1, PAPER.2].repeat(pixels) })
    }

    /// The whole canvas for the drawing library, in drawn pixels.
    pub fn drawing_area(&mut self) -> DrawingArea<BitMapBackend<'_>, Shift> {
        let size = (self.width_px * OVERSAMPLING, self.height_px * OVERSAMPLING);
        BitMapBackend::with_buffer(&mut self.rgb, size).into_drawing_area()
    }

    /// Writes one line, with the top left corner of the line at (`x_px`, `y_px`).
    pub fn text(&mut self, text: &str, x_px: u32, y_px: u32, font: Font, colour: RGBColor) -> Result<(), PlotError> {
        let style = font.style(colour)?;
        let y = f64::from(y_px) + TEXT_OFFSET * font.size_px;
        let at = ((x_px * OVERSAMPLING) as i32, (y * f64::from(OVERSAMPLING)) as i32);
        self.drawing_area().draw_text(text, &style, at).map_err(drawing)
    }

    /// Fills a rectangle, clipped to the page.
    pub fn fill(&mut self, area: PixelArea, RGBColor(r, g, b): RGBColor) {
        let row = (self.width_px * OVERSAMPLING) as usize * 3;
        let (left, right) = (area.x.min(self.width_px), (area.x + area.width).min(self.width_px));
        let [left, right] = [left, right].map(|x| (x * OVERSAMPLING) as usize * 3);
        let rows = self.rgb.chunks_exact_mut(row).skip((area.y * OVERSAMPLING) as usize);
        for line in rows.take((area.height * OVERSAMPLING) as usize) {
            line[left..right].chunks_exact_mut(3).for_each(|pixel| pixel.copy_from_slice(&[r, g, b]));
        }
    }

    /// Returns the finished image.
    pub fn finish(self) -> Image {
        let row = (self.width_px * OVERSAMPLING) as usize * 3;
        let step = OVERSAMPLING as usize;
        let mut rgb = Vec::with_capacity(self.width_px as usize * self.height_px as usize * 3);
        for y in 0..self.height_px as usize {
            for x in 0..self.width_px as usize {
                for channel in 0..3 {
                    let first = y * step * row + x * step * 3 + channel;
                    let sum: u32 =
                        (0..step * step).map(|i| u32::from(self.rgb[first + i / step * row + i % step * 3])).sum();
                    rgb.push(((sum + OVERSAMPLING) / (OVERSAMPLING * OVERSAMPLING)) as u8);
                }
            }
        }
        Image { width_px: self.width_px, height_px: self.height_px, rgb }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Bounds of all pixels of an image that are not background: `[left, top, right, bottom]`, inclusive.
    fn inked(image: &Image) -> Option<[u32; 4]> {
        let paper = [PAPER.0, PAPER.1, PAPER.2];
        let inked = (0..image.height_px)
            .flat_map(|y| (0..image.width_px).map(move |x| (x, y)))
            .filter(|&(x, y)| image.pixel(x, y) != Some(paper));
        inked.fold(None, |found, (x, y)| {
            let [l, t, r, b] = found.unwrap_or([x, y, x, y]);
            Some([l.min(x), t.min(y), r.max(x), b.max(y)])
        })
    }

    /// A line of text stays within its line and its measured width, up to one pixel: a layout without overlap is drawn
    /// without overlap.
    #[test]
    fn text_stays_in_its_line() {
        for font in [Font::regular(12.0), Font::bold(15.0), Font::bold(26.0)] {
            for text in ["Ågjpqy|()[]{}", "hazard probability 0.53, t1 · 60 %", "WWWW", "ffff,;_"] {
                let mut canvas = Canvas::new(400, 80).unwrap();
                canvas.text(text, 20, 20, font, INK).unwrap();
                let [left, top, right, bottom] = inked(&canvas.finish()).unwrap();
                assert!(top >= 20 && bottom < 20 + font.line_px(), "{font:?} {text}: rows {top} to {bottom}");
                let end = 20 + font.width_px(text).unwrap();
                assert!(left >= 19 && right <= end, "{font:?} {text}: columns {left} to {right} of {end}");
            }
        }
    }

    /// Wrapped lines fit, and have the whole text in order.
    #[test]
    fn wrapped_text_fits_and_is_whole() {
        let font = Font::regular(12.0);
        let text = "hazard probability 0.53 and a verylongwordthatdoesnotfitanywhereatallinoneline end";
        let lines = font.wrapped(text, 90).unwrap();
        for line in &lines {
            assert!(font.width_px(line).unwrap() <= 90, "{line}");
        }
        let letters = |s: &str| s.chars().filter(|c| !c.is_whitespace()).collect::<String>();
        assert_eq!(letters(&lines.concat()), letters(text));
        assert!(font.wrapped(" \n", 90).unwrap().is_empty());
    }

    /// A filled rectangle has exactly its pixels; a page that is too large is refused.
    #[test]
    fn fills_exactly() {
        let mut canvas = Canvas::new(20, 10).unwrap();
        canvas.fill(PixelArea { x: 3, y: 2, width: 5, height: 4 }, INK);
        let image = canvas.finish();
        assert_eq!(inked(&image), Some([3, 2, 7, 5]));
        assert_eq!(image.pixel(7, 5), Some([INK.0, INK.1, INK.2]));
        assert!(matches!(Canvas::new(10, MAX_SIDE_PX + 1), Err(PlotError::TooLarge { .. })));
    }
}
