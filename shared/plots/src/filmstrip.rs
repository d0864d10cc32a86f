//! Filmstrips: rows of captioned images.

use crate::canvas::{Canvas, FAINT_INK, Font, INK, PixelArea};
use crate::{MAX_SIDE_PX, PlotError};
use carff_dataset::Image;
use plotters::style::RGBColor;
use std::path::Path;

/// One row: its caption, and its images from left to right.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct StripRow {
    /// Caption left of the images; its first line is emphasised.
    pub caption: Vec<String>,
    /// Images of the row.
    pub cells: Vec<StripCell>,
}

/// One image with its caption.
#[derive(Clone, Debug, PartialEq)]
pub struct StripCell {
    /// The image; a small image is enlarged by two.
    pub image: Image,
    /// Caption below the image; its first line is emphasised.
    pub caption: Vec<String>,
    /// Colour of the frame, RGB.
    pub emphasis: Option<[u8; 3]>,
}

impl StripCell {
    /// Creates a cell without a frame.
    pub fn new(image: Image, caption: &[String]) -> Self {
        Self { image, caption: caption.to_vec(), emphasis: None }
    }
}

const MARGIN: u32 = 28;
const TITLE: Font = Font::bold(26.0);
const SUBTITLE: Font = Font::regular(14.0);
const CAPTION_HEAD: Font = Font::bold(14.0);
const CAPTION: Font = Font::regular(13.0);
/// Width of the text left of the images.
const CAPTION_WIDTH: u32 = 230;
/// Images with all sides shorter than this are enlarged by two.
const SMALL_SIDE: u32 = 160;
/// Space between images, and width of a frame.
const GAP: u32 = 18;
const FRAME: u32 = 4;
/// Space between an image and its caption.
const CAPTION_GAP: u32 = 9;
/// Space above and below the line between rows.
const ROW_GAP: u32 = 18;
const RULE: RGBColor = RGBColor(224, 226, 230);

/// Draws a filmstrip into a PNG file.
pub fn filmstrip(path: &Path, title: &str, subtitle: &str, rows: &[StripRow]) -> Result<(), PlotError> {
    Ok(draw(title, subtitle, rows)?.save_png(path)?)
}

fn draw(title: &str, subtitle: &str, rows: &[StripRow]) -> Result<Image, PlotError> {
    check(rows)?;
    let layout = Layout::new(title, subtitle, rows)?;
    let mut canvas = Canvas::new(layout.width, layout.height)?;
    for (area, colour) in &layout.fills {
        canvas.fill(*area, *colour);
    }
    for line in &layout.lines {
        canvas.text(&line.text, line.area.x, line.area.y, line.font, line.colour)?;
    }
    let mut sheet = canvas.finish();
    for tile in &layout.tiles {
        let image = &rows[tile.row].cells[tile.cell].image;
        sheet.paste(&enlarged(image, scale(image)), tile.area.x, tile.area.y);
    }
    Ok(sheet)
}

fn check(rows: &[StripRow]) -> Result<(), PlotError> {
    for (row, strip_row) in rows.iter().enumerate() {
        for (cell, Image { width_px, height_px, rgb }) in strip_row.cells.iter().map(|c| &c.image).enumerate() {
            let (width_px, height_px) = (*width_px, *height_px);
            if width_px.max(height_px) > MAX_SIDE_PX {
                return Err(PlotError::TooLarge { width_px, height_px });
            }
            if u64::from(width_px) * u64::from(height_px) * 3 != rgb.len() as u64 || rgb.is_empty() {
                return Err(PlotError::Image { row, cell, bytes: rgb.len(), width_px, height_px });
            }
        }
    }
    Ok(())
}

fn scale(image: &Image) -> u32 {
    if image.width_px.max(image.height_px) < SMALL_SIDE { 2 } else { 1 }
}

/// Enlarges each pixel to a square of `factor` pixels, without interpolation.
fn enlarged(image: &Image, factor: u32) -> Image {
    let factor = factor as usize;
    let mut rgb = Vec::with_capacity(image.rgb.len() * factor * factor);
    for row in image.rgb.chunks_exact(image.width_px as usize * 3) {
        let wide: Vec<u8> = row.chunks_exact(3).flat_map(|pixel| pixel.repeat(factor)).collect();
        for _ in 0..factor {
            rgb.extend_from_slice(&wide);
        }
    }
    Image { width_px: image.width_px * factor as u32, height_px: image.height_px * factor as u32, rgb }
}

/// One line of text with its position.
struct Line {
    text: String,
    area: PixelArea,
    font: Font,
    colour: RGBColor,
}

/// One image with its position.
struct Tile {
    row: usize,
    cell: usize,
    area: PixelArea,
}

/// Positions of all texts and images.
struct Layout {
    width: u32,
    height: u32,
    lines: Vec<Line>,
    tiles: Vec<Tile>,
    fills: Vec<(PixelArea, RGBColor)>,
}

impl Layout {
    fn new(title: &str, subtitle: &str, rows: &[StripRow]) -> Result<Self, PlotError> {
        let cells = || rows.iter().flat_map(|r| &r.cells);
        // All columns are as wide as the widest image, so that rows can be compared.
        let tile_width = cells().map(|c| c.image.width_px * scale(&c.image)).max().unwrap_or(0).max(SMALL_SIDE);
        let columns = rows.iter().map(|r| r.cells.len()).max().unwrap_or(0) as u32;
        let text_width = CAPTION_WIDTH + columns * (GAP + tile_width);
        let mut layout = Self {
            width: text_width + 2 * MARGIN,
            height: MARGIN,
            lines: Vec::new(),
            tiles: Vec::new(),
            fills: Vec::new(),
        };
        let heading = |text: &str, font, colour| [(text.to_owned(), font, colour)];
        layout.height += layout.paragraph(&heading(title, TITLE, INK), MARGIN, layout.height, text_width)?;
        layout.height +=
            layout.paragraph(&heading(subtitle, SUBTITLE, FAINT_INK), MARGIN, layout.height, text_width)?;
        for (index, row) in rows.iter().enumerate() {
            let rule = PixelArea { x: MARGIN, y: layout.height + ROW_GAP, width: text_width, height: 1 };
            layout.fills.push((rule, RULE));
            layout.height += 2 * ROW_GAP + 1;
            layout.height += layout.row(index, row, tile_width)?;
        }
        layout.height += MARGIN;
        Ok(layout)
    }

    /// Places a row below the earlier rows. Returns its height.
    fn row(&mut self, index: usize, row: &StripRow, tile_width: u32) -> Result<u32, PlotError> {
        let top = self.height;
        let mut height = self.paragraph(&captioned(&row.caption), MARGIN, top, CAPTION_WIDTH)?;
        for (at, cell) in row.cells.iter().enumerate() {
            let x = MARGIN + CAPTION_WIDTH + GAP + at as u32 * (tile_width + GAP);
            let factor = scale(&cell.image);
            let area =
                PixelArea { x, y: top, width: cell.image.width_px * factor, height: cell.image.height_px * factor };
            if let Some([r, g, b]) = cell.emphasis {
                let frame = PixelArea {
                    x: area.x - FRAME,
                    y: area.y - FRAME,
                    width: area.width + 2 * FRAME,
                    height: area.height + 2 * FRAME,
                };
                self.fills.push((frame, RGBColor(r, g, b)));
            }
            self.tiles.push(Tile { row: index, cell: at, area });
            let below = area.height + CAPTION_GAP;
            let caption = self.paragraph(&captioned(&cell.caption), x, top + below, tile_width)?;
            height = height.max(below + caption);
        }
        Ok(height)
    }

    /// Places lines, wrapped to a width, below each other. Returns their height.
    fn paragraph(&mut self, lines: &[(String, Font, RGBColor)], x: u32, y: u32, width: u32) -> Result<u32, PlotError> {
        let mut height = 0;
        for (text, font, colour) in lines {
            for text in font.wrapped(text, width)? {
                let area = PixelArea { x, y: y + height, width: font.width_px(&text)?, height: font.line_px() };
                self.lines.push(Line { text, area, font: *font, colour: *colour });
                height += area.height;
            }
        }
        Ok(height)
    }
}

/// Font of a caption's line: the first line is emphasised.
fn captioned(lines: &[String]) -> Vec<(String, Font, RGBColor)> {
    let styles = std::iter::once((CAPTION_HEAD, INK)).chain(std::iter::repeat((CAPTION, FAINT_INK)));
    lines.iter().zip(styles).map(|(text, (font, colour))| (text.clone(), font, colour)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cell(width_px: u32, height_px: u32, caption: &str) -> StripCell {
        let rgb = (0..width_px * height_px * 3).map(|i| (i * 7 % 251) as u8).collect();
        StripCell {
            image: Image { width_px, height_px, rgb },
            caption: vec![caption.into(), "second line".into()],
            emphasis: Some([200, 40, 30]),
        }
    }

    fn odd_rows() -> Vec<StripRow> {
        let long = "a caption that is much longer than the image above it is wide, and so must be broken often";
        vec![
            StripRow { caption: vec![long.repeat(12)], cells: vec![cell(8, 200, long), cell(128, 128, long)] },
            StripRow { caption: Vec::new(), cells: vec![cell(300, 20, "short")] },
            StripRow { caption: vec!["no images".into()], cells: Vec::new() },
            StripRow { caption: vec!["x".into()], cells: vec![cell(128, 128, ""), cell(1, 1, long), cell(9, 9, "W")] },
        ]
    }

    fn apart(a: PixelArea, b: PixelArea) -> bool {
        a.x + a.width <= b.x || b.x + b.width <= a.x || a.y + a.height <= b.y || b.y + b.height <= a.y
    }

    /// For any sizes and captions, texts, images and frames do not overlap, and all are within the page.
    #[test]
    fn nothing_overlaps() {
        let layout = Layout::new("Title", &"a long subtitle ".repeat(30), &odd_rows()).unwrap();
        let texts = layout.lines.iter().map(|l| l.area);
        let tiles = layout.tiles.iter().map(|t| t.area);
        let all: Vec<PixelArea> = texts.chain(tiles).collect();
        assert!(layout.tiles.len() == 6 && layout.lines.len() > 20);
        for (i, a) in all.iter().enumerate() {
            assert!(a.x + a.width <= layout.width && a.y + a.height <= layout.height, "{a:?}");
            for b in &all[i + 1..] {
                assert!(apart(*a, *b), "{a:?} and {b:?}");
            }
        }
        for (fill, _) in &layout.fills {
            assert!(layout.lines.iter().all(|l| apart(*fill, l.area)), "{fill:?}");
        }
    }

    /// The file is a PNG of the laid-out size with every image unchanged in its frame, small images enlarged by two.
    #[test]
    fn images_are_shown_unchanged() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("strip.png");
        let rows = odd_rows();
        filmstrip(&path, "Title", "subtitle", &rows).unwrap();
        let sheet = Image::load(&path).unwrap();
        let layout = Layout::new("Title", "subtitle", &rows).unwrap();
        assert_eq!((sheet.width_px, sheet.height_px), (layout.width, layout.height));
        for tile in &layout.tiles {
            let image = &rows[tile.row].cells[tile.cell].image;
            let factor = if image.width_px.max(image.height_px) < 160 { 2 } else { 1 };
            assert_eq!((tile.area.width, tile.area.height), (image.width_px * factor, image.height_px * factor));
            for y in 0..tile.area.height {
                for x in 0..tile.area.width {
                    let shown = sheet.pixel(tile.area.x + x, tile.area.y + y);
                    assert_eq!(shown, image.pixel(x / factor, y / factor), "{x} {y}");
                }
            }
            assert_eq!(sheet.pixel(tile.area.x - 1, tile.area.y - 1), Some([200, 40, 30]));
        }
    }

    /// A filmstrip without rows has its title; the error of an image of the wrong size names it; too many rows are
    /// refused before anything is drawn.
    #[test]
    fn odd_input() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("strip.png");
        filmstrip(&path, "Nothing", "", &[]).unwrap();
        assert!(Image::load(&path).is_ok());
        let mut rows = odd_rows();
        rows[3].cells[1].image.rgb.pop();
        let message = filmstrip(&path, "", "", &rows).unwrap_err().to_string();
        assert!(message.contains("row 3, image 1: 2 bytes do not match an image of 1x1"), "{message}");
        let many: Vec<StripRow> = (0..200).flat_map(|_| odd_rows()).collect();
        assert!(matches!(filmstrip(&path, "", "", &many), Err(PlotError::TooLarge { .. })));
        let nowhere = dir.path().join("missing").join("strip.png");
        assert!(filmstrip(&nowhere, "", "", &[]).unwrap_err().to_string().contains("missing"));
    }
}
