//! Contact sheets with a legend: names of rows and columns, and the meaning of the frames' colours.

use crate::canvas::{Canvas, FAINT_INK, Font, INK, PAPER, PixelArea};
use crate::{MAX_SIDE_PX, PlotError};
use carff_dataset::{ContactSheet, Image};
use plotters::style::RGBColor;

const MARGIN: u32 = 8;
const TITLE: Font = Font::bold(15.0);
const TEXT: Font = Font::regular(11.0);
/// Width of the rows' names.
const NAMES_PX: u32 = 120;
/// Least width of a finished sheet, so that the legend is readable above a narrow one.
const LEAST_PX: u32 = 480;
/// Side of a coloured square of the legend.
const SWATCH_PX: u32 = 9;

/// Returns a contact sheet with its title, legend, and names of rows and columns.
pub fn labelled_sheet(sheet: &ContactSheet, title: &str) -> Result<Image, PlotError> {
    let width = (NAMES_PX + sheet.image.width_px + 2 * MARGIN).max(LEAST_PX);
    let head = heading(sheet, title, width.min(MAX_SIDE_PX))?;
    let names = names(sheet)?;
    let paper = [PAPER.0, PAPER.1, PAPER.2];
    let mut page = Image::filled(width, head.height_px + sheet.image.height_px + MARGIN, paper);
    page.paste(&head, 0, 0);
    page.paste(&names, MARGIN, head.height_px);
    page.paste(&sheet.image, MARGIN + NAMES_PX, head.height_px);
    Ok(page)
}

/// A line with its position, font and colour.
type Placed = (String, u32, u32, Font, RGBColor);

fn heading(sheet: &ContactSheet, title: &str, width: u32) -> Result<Image, PlotError> {
    let mut texts: Vec<Placed> = Vec::new();
    let mut y = MARGIN;
    let columns = if sheet.columns.is_empty() { "" } else { " Each column is a view of the camera." };
    let rows = if sheet.columns.is_empty() { "Images in the order of the dataset." } else { "Each row is a state." };
    let legend = format!("{rows}{columns} Frame:");
    for (text, font, colour) in [(title, TITLE, INK), (&legend, TEXT, FAINT_INK)] {
        for line in font.wrapped(text, width - 2 * MARGIN)? {
            texts.push((line, MARGIN, y, font, colour));
            y += font.line_px();
        }
    }
    let (mut x, mut swatches) = (MARGIN, Vec::new());
    for (colour, meaning) in &sheet.frames {
        let needed = SWATCH_PX + 5 + TEXT.width_px(meaning)?;
        if x > MARGIN && x + needed > width {
            (x, y) = (MARGIN, y + TEXT.line_px());
        }
        swatches.push((PixelArea { x, y: y + 3, width: SWATCH_PX, height: SWATCH_PX }, *colour));
        texts.push(((*meaning).to_owned(), x + SWATCH_PX + 5, y, TEXT, FAINT_INK));
        x += needed + 14;
    }
    y += TEXT.line_px() + 4;
    let mut lowest = y;
    for (column, name) in sheet.columns.iter().enumerate() {
        let x = MARGIN + NAMES_PX + column as u32 * sheet.pitch_px[0];
        for (line, text) in TEXT.wrapped(name, sheet.pitch_px[0].max(12) - 4)?.into_iter().enumerate() {
            let top = y + line as u32 * TEXT.line_px();
            lowest = lowest.max(top + TEXT.line_px());
            texts.push((text, x, top, TEXT, INK));
        }
    }
    let mut canvas = Canvas::new(width, lowest + 2)?;
    for (area, [r, g, b]) in swatches {
        canvas.fill(area, RGBColor(r, g, b));
    }
    write(&mut canvas, &texts)?;
    Ok(canvas.finish())
}

fn names(sheet: &ContactSheet) -> Result<Image, PlotError> {
    let mut canvas = Canvas::new(NAMES_PX, sheet.image.height_px.min(MAX_SIDE_PX))?;
    for (row, name) in sheet.rows.iter().enumerate() {
        let top = row as u32 * sheet.pitch_px[1];
        let lines = TEXT.wrapped(name, NAMES_PX - 6)?.into_iter().enumerate();
        let lines: Vec<Placed> = lines.map(|(i, text)| (text, 0, top + i as u32 * TEXT.line_px(), TEXT, INK)).collect();
        write(&mut canvas, &lines)?;
    }
    Ok(canvas.finish())
}

fn write(canvas: &mut Canvas, texts: &[Placed]) -> Result<(), PlotError> {
    texts.iter().try_for_each(|(text, x, y, font, colour)| canvas.text(text, *x, *y, *font, *colour))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The images are unchanged below and right of the names. Frames in use are explained by squares of their colour. A
    /// sheet of any size can be drawn.
    #[test]
    fn a_sheet_has_its_legend() {
        let green = [40, 160, 60];
        for (width_px, height_px, pitch_px) in [(4, 4, [4, 4]), (300, 40, [100, 20]), (9000, 9000, [3000, 4500])] {
            let sheet = ContactSheet {
                image: Image::filled(width_px, height_px, [1, 2, 3]),
                rows: vec!["actor, t0".into(), "no-actor, t0 with a long name".into()],
                columns: vec!["view 50 birds_eye".into(), "view 1".into(), "view 2".into()],
                pitch_px,
                frames: vec![(green, "visible"), ([205, 50, 45], "hidden")],
            };
            let page = labelled_sheet(&sheet, "a title").unwrap();
            let left = MARGIN + NAMES_PX;
            let top = page.height_px - MARGIN - height_px;
            assert_eq!(page.pixel(left, top), Some([1, 2, 3]));
            assert_eq!(page.pixel(left + width_px - 1, top + height_px - 1), Some([1, 2, 3]));
            assert!((0..top).any(|y| page.pixel(MARGIN + 2, y) == Some(green)), "{width_px}");
        }
    }
}
