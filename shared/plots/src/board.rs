//! A board: images side by side, a decision, and a belief as bars, in one image of a film.

use crate::PlotError;
use crate::canvas::{Canvas, FAINT_INK, Font, INK, PixelArea};
use carff_dataset::Image;
use plotters::prelude::RGBColor;

const MARGIN: u32 = 12;
/// Height of each image, pixels: whole multiples of its own height up to this one.
const IMAGE_PX: u32 = 360;
/// Width of the column of text and bars, pixels.
const COLUMN_PX: u32 = 300;
const BAR_PX: u32 = 96;
const HEADING: Font = Font::bold(17.0);
const TEXT: Font = Font::regular(13.0);
const HAZARD: RGBColor = RGBColor(205, 50, 45);
const CLEAR: RGBColor = RGBColor(46, 155, 90);
const UNKNOWN: RGBColor = RGBColor(150, 154, 162);

/// One probability of a board.
#[derive(Clone, Debug, PartialEq)]
pub struct Bar {
    /// Name of the state.
    pub name: String,
    /// Probability, 0..=1.
    pub share: f32,
    /// True for a hazard, false for another state, none for what is not known.
    pub hazard: Option<bool>,
}

/// The content of a board.
///
/// ```
/// use carff_plots::{Bar, Board};
/// let bars = vec![Bar { name: "truck, t1".into(), share: 0.4, hazard: Some(true) }];
/// let image = carff_dataset::Image::filled(64, 48, [80, 90, 100]);
/// let board = Board { images: vec![("camera".into(), image)], decision: "halt".into(), alarm: true, bars, ..Board::default() };
/// assert_eq!(board.draw()?.width_px % 2, 0);
/// # Ok::<(), carff_plots::PlotError>(())
/// ```
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Board {
    /// Images with their captions, from the left.
    pub images: Vec<(String, Image)>,
    /// The decision.
    pub decision: String,
    /// True if the decision is a halt.
    pub alarm: bool,
    /// Lines below the decision.
    pub lines: Vec<String>,
    /// The belief.
    pub bars: Vec<Bar>,
}

impl Board {
    /// Draws the board; its sides are even. Boards with images of the same sizes, and as many bars and lines, have the
    /// same size.
    pub fn draw(&self) -> Result<Image, PlotError> {
        let images: Vec<Image> = self.images.iter().map(|(_, image)| enlarged(image)).collect();
        let caption_px = TEXT.line_px();
        let high = images.iter().map(|image| image.height_px).max().unwrap_or(0) + caption_px;
        let rows = (self.lines.len() + self.bars.len()) as u32;
        let column = HEADING.line_px() + (rows + 1) * (TEXT.line_px() + 2);
        let height = (high.max(column) + 2 * MARGIN).next_multiple_of(2);
        let width = images.iter().map(|image| image.width_px + MARGIN).sum::<u32>() + COLUMN_PX + 2 * MARGIN;
        let mut canvas = Canvas::new(width.next_multiple_of(2), height)?;
        let mut x = MARGIN;
        for ((caption, _), image) in self.images.iter().zip(&images) {
            canvas.text(caption, x, MARGIN, TEXT, FAINT_INK)?;
            x += image.width_px + MARGIN;
        }
        self.column(&mut canvas, x)?;
        let mut page = canvas.finish();
        let mut x = MARGIN;
        for image in &images {
            page.paste(image, x, MARGIN + caption_px);
            x += image.width_px + MARGIN;
        }
        Ok(page)
    }

    fn column(&self, canvas: &mut Canvas, x: u32) -> Result<(), PlotError> {
        let mut y = MARGIN;
        canvas.text(&self.decision, x, y, HEADING, if self.alarm { HAZARD } else { CLEAR })?;
        y += HEADING.line_px();
        for line in &self.lines {
            canvas.text(line, x, y, TEXT, INK)?;
            y += TEXT.line_px() + 2;
        }
        y += TEXT.line_px() / 2;
        let name_px = COLUMN_PX - BAR_PX - 56;
        for bar in &self.bars {
            let name = TEXT.wrapped(&bar.name, name_px)?.into_iter().next().unwrap_or_default();
            canvas.text(&name, x, y, TEXT, INK)?;
            canvas.text(&format!("{:>3.0} %", 100.0 * bar.share), x + name_px + 4, y, TEXT, INK)?;
            let width = (bar.share.clamp(0.0, 1.0) * BAR_PX as f32).round() as u32;
            let colour = bar.hazard.map_or(UNKNOWN, |hazard| if hazard { HAZARD } else { CLEAR });
            let area = PixelArea { x: x + name_px + 52, y: y + 2, width, height: TEXT.line_px() - 4 };
            canvas.fill(area, colour);
            y += TEXT.line_px() + 2;
        }
        Ok(())
    }
}

/// Enlarges an image by the largest whole factor that keeps it within the height.
fn enlarged(image: &Image) -> Image {
    let factor = (IMAGE_PX / image.height_px.max(1)).max(1);
    let (width_px, height_px) = (image.width_px * factor, image.height_px * factor);
    let row = |y: u32| {
        (0..width_px).flat_map(move |x| {
            let at = ((y / factor * image.width_px + x / factor) * 3) as usize;
            image.rgb[at..at + 3].iter().copied()
        })
    };
    Image { width_px, height_px, rgb: (0..height_px).flat_map(row).collect() }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn board(share: f32, images: usize) -> Board {
        let image = Image::filled(40, 30, [10, 20, 30]);
        let hazards = [Some(true), Some(false), None];
        let bars = hazards.map(|hazard| Bar { name: "a state with a very long name, t1".into(), share, hazard });
        Board {
            images: vec![("camera".into(), image); images],
            decision: "HALT".into(),
            alarm: true,
            lines: vec!["hazard 0.50".into()],
            bars: bars.to_vec(),
        }
    }

    /// Images are enlarged side by side; the size does not depend on the values; bars have their lengths and colours.
    #[test]
    fn a_board_shows_all() {
        let (empty, full) = (board(0.0, 2).draw().unwrap(), board(1.0, 2).draw().unwrap());
        assert_eq!((empty.width_px, empty.height_px), (full.width_px, full.height_px));
        assert!(empty.width_px % 2 == 0 && empty.height_px % 2 == 0);
        let count = |image: &Image, RGBColor(r, g, b): RGBColor| {
            image.rgb.chunks_exact(3).filter(|pixel| *pixel == [r, g, b]).count()
        };
        assert_eq!(count(&full, RGBColor(10, 20, 30)), 2 * 480 * 360);
        let area = (BAR_PX * (TEXT.line_px() - 4)) as usize;
        for colour in [CLEAR, UNKNOWN] {
            assert_eq!(count(&full, colour) - count(&empty, colour), area);
        }
        assert!(count(&full, HAZARD) >= area);
        assert!(board(0.5, 0).draw().unwrap().width_px < full.width_px);
    }
}
