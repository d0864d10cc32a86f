//! Line charts in a grid.

use crate::PlotError;
use crate::canvas::{Canvas, FAINT_INK, Font, INK, OVERSAMPLING, PAPER, PixelArea, drawing};
use carff_dataset::Image;
use plotters::coord::Shift;
use plotters::coord::ranged1d::{KeyPointHint, NoDefaultFormatting, Ranged, ValueFormatter};
use plotters::prelude::{BitMapBackend, ChartBuilder, Circle, DrawingArea, PathElement, Polygon, RGBColor, Rectangle};
use plotters::style::{Color, ShapeStyle};
use std::ops::Range;
use std::path::Path;

/// One chart.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Panel {
    /// Heading.
    pub title: String,
    /// Name of the x axis, with its unit.
    pub x_label: String,
    /// Name of the y axis, with its unit.
    pub y_label: String,
    /// Logarithmic x axis; points at or below zero are left out.
    pub log_x: bool,
    /// Logarithmic y axis; points at or below zero are left out.
    pub log_y: bool,
    /// Includes zero on the y axis, so that heights can be compared. Has no effect on a logarithmic axis.
    pub from_zero: bool,
    /// The lines.
    pub series: Vec<Series>,
}

/// One line of a chart.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Series {
    /// Name in the legend.
    pub name: String,
    /// Points `(x, y)` in the order of the line. The line is interrupted at points that are not finite.
    pub points: Vec<(f64, f64)>,
    /// A band behind the line, `(x, low, high)` in the order of x.
    pub band: Vec<(f64, f64, f64)>,
    /// Marks of the points.
    pub marks: Marks,
}

/// Marks of the points of a series.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Marks {
    /// A line through the points.
    #[default]
    Line,
    /// One dot for each point.
    Dots,
}

const MARGIN: u32 = 20;
const PANEL_WIDTH: u32 = 560;
const PANEL_HEIGHT: u32 = 380;
const TITLE: Font = Font::bold(24.0);
const PANEL_TITLE: Font = Font::bold(15.0);
const LEGEND: Font = Font::regular(12.5);
const LABEL: Font = Font::regular(12.0);
/// Space for numbers and name of the y axis, and of the x axis.
const Y_LABELS: u32 = 74;
const X_LABELS: u32 = 42;
/// A legend's line, and the space around it.
const SWATCH: u32 = 18;
const LEGEND_GAP: u32 = 14;
/// Largest number of points of a line that shows each point.
const FEW_POINTS: usize = 30;
/// Largest absolute value that is drawn.
const LARGEST: f64 = 1e100;
/// Colours for colour-blind readers (Okabe and Ito), without yellow, which is hard to see on white.
const COLOURS: [RGBColor; 7] = [
    RGBColor(0, 114, 178),
    RGBColor(213, 94, 0),
    RGBColor(0, 158, 115),
    RGBColor(204, 121, 167),
    RGBColor(86, 180, 233),
    RGBColor(150, 110, 20),
    RGBColor(70, 70, 70),
];

type Page<'a> = DrawingArea<BitMapBackend<'a>, Shift>;

/// Draws charts into a PNG file as a grid. A panel without points has a note.
pub fn curves(path: &Path, title: &str, panels: &[Panel]) -> Result<(), PlotError> {
    Ok(draw(title, panels)?.save_png(path)?)
}

/// Number of columns for a number of panels.
fn columns(panels: usize) -> u32 {
    match panels {
        0 | 1 => 1,
        2..=4 => 2,
        _ => 3,
    }
}

fn draw(title: &str, panels: &[Panel]) -> Result<Image, PlotError> {
    let columns = columns(panels.len());
    let rows = (panels.len() as u32).div_ceil(columns);
    let head = MARGIN + TITLE.line_px();
    let mut canvas =
        Canvas::new(columns * PANEL_WIDTH + 2 * MARGIN, head + rows.saturating_mul(PANEL_HEIGHT) + 2 * MARGIN)?;
    for (i, panel) in panels.iter().enumerate() {
        let (column, row) = (i as u32 % columns, i as u32 / columns);
        let left = MARGIN + column * PANEL_WIDTH;
        let top = head + MARGIN + row * PANEL_HEIGHT;
        let pad = MARGIN / 2;
        let inner = PANEL_WIDTH - 2 * pad;
        canvas.text(&panel.title, left + pad, top, PANEL_TITLE, INK)?;
        let under = top + PANEL_TITLE.line_px() + 2;
        let legend = legend(&mut canvas, &panel.series, left + pad, under, inner)?;
        let chart = [left + pad, under + legend, left + pad + inner, top + PANEL_HEIGHT - pad];
        let area = canvas.drawing_area();
        plot(&shrunk(&area, chart), panel)?;
    }
    canvas.text(title, MARGIN + MARGIN / 2, MARGIN, TITLE, INK)?;
    Ok(canvas.finish())
}

/// Part of the page between left, top, right and bottom, pixels of the finished image.
fn shrunk<'a>(area: &Page<'a>, [left, top, right, bottom]: [u32; 4]) -> Page<'a> {
    let [left, top, right, bottom] = [left, top, right, bottom].map(|v| v * OVERSAMPLING);
    area.clone().shrink((left, top), (right - left, bottom - top))
}

/// Writes the names of the lines in their colours, in one or several rows. Returns the height.
fn legend(canvas: &mut Canvas, series: &[Series], left: u32, top: u32, width: u32) -> Result<u32, PlotError> {
    let (mut x, mut y) = (left, top);
    for (one, colour) in series.iter().zip(COLOURS.iter().cycle()) {
        let text = LEGEND.width_px(&one.name)?;
        if x > left && x + SWATCH + 5 + text > left + width {
            (x, y) = (left, y + LEGEND.line_px());
        }
        let middle = y + LEGEND.line_px() / 2 - 1;
        let swatch = PixelArea { x, y: middle, width: SWATCH, height: 3 };
        canvas.fill(swatch, *colour);
        canvas.text(&one.name, x + SWATCH + 5, y, LEGEND, FAINT_INK)?;
        x += SWATCH + 5 + text + LEGEND_GAP;
    }
    Ok(if series.is_empty() { 0 } else { y - top + LEGEND.line_px() })
}

/// Draws axes and lines.
fn plot(area: &Page, panel: &Panel) -> Result<(), PlotError> {
    let lines: Vec<Vec<Vec<(f64, f64)>>> = panel.series.iter().map(|s| pieces(&s.points, panel)).collect();
    let all = || lines.iter().flatten().flatten();
    let bands: Vec<Vec<(f64, f64)>> = panel.series.iter().map(|s| outline(&s.band, panel)).collect();
    let any = || all().chain(bands.iter().flatten());
    // Lines begin at the axis; dots keep a distance from it.
    let aside = if panel.series.iter().any(|s| s.marks == Marks::Dots) { 0.04 } else { 0.0 };
    let (Some(x), Some(mut y)) = (range(any().map(|p| p.0), aside), range(any().map(|p| p.1), 0.06)) else {
        return empty(area);
    };
    if panel.from_zero && !panel.log_y {
        y = if any().all(|p| p.1 >= 0.0) { 0.0..y.end } else { y.start..y.end.max(0.0) };
    }
    let ticks = |range: &Range<f64>, log: bool| if log { logarithmic_ticks(range) } else { linear_ticks(range, 6) };
    let (x_ticks, y_ticks) = (ticks(&x, panel.log_x), ticks(&y, panel.log_y));
    let scale = |px: u32| px * OVERSAMPLING;
    let mut chart = ChartBuilder::on(area)
        .margin_right(scale(14))
        .margin_top(scale(8))
        .x_label_area_size(scale(X_LABELS))
        .y_label_area_size(scale(Y_LABELS))
        .build_cartesian_2d(Axis { range: x, ticks: x_ticks }, Axis { range: y, ticks: y_ticks })
        .map_err(drawing)?;
    chart
        .configure_mesh()
        .x_desc(&panel.x_label)
        .y_desc(&panel.y_label)
        .axis_style(FAINT_INK.stroke_width(OVERSAMPLING))
        .bold_line_style(RGBColor(226, 228, 232).stroke_width(OVERSAMPLING))
        .light_line_style(PAPER)
        .label_style(LABEL.style(FAINT_INK)?)
        .axis_desc_style(LABEL.style(INK)?)
        .draw()
        .map_err(drawing)?;
    for (band, colour) in bands.into_iter().zip(COLOURS.iter().cycle()) {
        if !band.is_empty() {
            chart.draw_series(std::iter::once(Polygon::new(band, colour.mix(0.18)))).map_err(drawing)?;
        }
    }
    for (i, (pieces, colour)) in lines.iter().zip(COLOURS.iter().cycle()).enumerate() {
        if panel.series[i].marks == Marks::Dots {
            // Repeated colours are drawn as rings.
            let style = ShapeStyle { filled: i < COLOURS.len(), ..colour.stroke_width(OVERSAMPLING) };
            let dot = |p: &(f64, f64)| Circle::new(*p, 3 * OVERSAMPLING, style);
            chart.draw_series(pieces.iter().flatten().map(dot)).map_err(drawing)?;
            continue;
        }
        let dots = pieces.iter().map(Vec::len).sum::<usize>() <= FEW_POINTS;
        for piece in pieces {
            let line = PathElement::new(piece.clone(), colour.stroke_width(2 * OVERSAMPLING));
            chart.draw_series(std::iter::once(line)).map_err(drawing)?;
            if dots || piece.len() == 1 {
                let dot = |p: &(f64, f64)| Circle::new(*p, 3 * OVERSAMPLING, colour.filled());
                chart.draw_series(piece.iter().map(dot)).map_err(drawing)?;
            }
        }
    }
    Ok(())
}

fn empty(area: &Page) -> Result<(), PlotError> {
    let (width, height) = area.dim_in_pixel();
    let frame = Rectangle::new([(0, 0), (width as i32 - 1, height as i32 - 1)], RGBColor(226, 228, 232));
    area.draw(&frame).map_err(drawing)?;
    let text = "nothing recorded yet";
    let left = (width as i32 - (LABEL.width_px(text)? * OVERSAMPLING) as i32) / 2;
    area.draw_text(text, &LABEL.style(FAINT_INK)?, (left, height as i32 / 2)).map_err(drawing)
}

/// Axis with its numbers: position and text of each.
struct Axis {
    range: Range<f64>,
    ticks: Vec<(f64, String)>,
}

impl Ranged for Axis {
    type FormatOption = NoDefaultFormatting;
    type ValueType = f64;

    fn map(&self, value: &f64, (first, last): (i32, i32)) -> i32 {
        let share = (value - self.range.start) / (self.range.end - self.range.start);
        first + (share * f64::from(last - first)).round() as i32
    }

    fn key_points<Hint: KeyPointHint>(&self, _: Hint) -> Vec<f64> {
        self.ticks.iter().map(|t| t.0).collect()
    }

    fn range(&self) -> Range<f64> {
        self.range.clone()
    }
}

impl ValueFormatter<f64> for Axis {
    fn format(value: &f64) -> String {
        value.to_string()
    }

    fn format_ext(&self, value: &f64) -> String {
        self.ticks.iter().find(|(v, _)| v == value).map(|(_, text)| text.clone()).unwrap_or_default()
    }
}

/// Pieces of a line between points that cannot be drawn, in drawing coordinates (logarithms for a logarithmic axis).
fn pieces(points: &[(f64, f64)], panel: &Panel) -> Vec<Vec<(f64, f64)>> {
    let shown = |v: f64| v.is_finite() && v.abs() < LARGEST;
    let drawn = |v: f64, log: bool| if log { v.log10() } else { v };
    let points: Vec<_> = points.iter().map(|&(x, y)| (drawn(x, panel.log_x), drawn(y, panel.log_y))).collect();
    points.split(|&(x, y)| !(shown(x) && shown(y))).filter(|piece| !piece.is_empty()).map(<[_]>::to_vec).collect()
}

/// Outline of a band as a polygon in drawing coordinates; empty without points that can be drawn.
fn outline(band: &[(f64, f64, f64)], panel: &Panel) -> Vec<(f64, f64)> {
    let edge =
        |of: fn(&(f64, f64, f64)) -> (f64, f64)| pieces(&band.iter().map(of).collect::<Vec<_>>(), panel).concat();
    let (low, mut high) = (edge(|b| (b.0, b.1)), edge(|b| (b.0, b.2)));
    high.reverse();
    [low, high].concat()
}

/// Range of values, extended by a share at both ends; `None` for no values.
fn range(values: impl Iterator<Item = f64>, padding: f64) -> Option<Range<f64>> {
    let (low, high) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| (l.min(v), h.max(v)));
    if low > high {
        return None;
    }
    // A single value still needs an axis around it.
    if high - low <= low.abs().max(high.abs()) * 1e-9 {
        let around = (low.abs() * 0.1).max(0.5);
        return Some(low - around..high + around);
    }
    let pad = (high - low) * padding;
    Some(low - pad..high + pad)
}

/// About `count` round numbers within a range, with their texts.
fn linear_ticks(range: &Range<f64>, count: u32) -> Vec<(f64, String)> {
    let rough = (range.end - range.start) / f64::from(count);
    let power = 10_f64.powf(rough.log10().floor());
    let step = [1.0, 2.0, 5.0, 10.0].map(|f| f * power).into_iter().find(|s| *s >= rough * 0.999).unwrap_or(rough);
    let first = (range.start / step).ceil();
    (0..=2 * count)
        .map(|i| (first + f64::from(i)) * step)
        .take_while(|v| *v <= range.end)
        .map(|v| (v, written(v, step)))
        .collect()
}

/// Round numbers for a range of decimal logarithms: logarithm and text of the number.
fn logarithmic_ticks(range: &Range<f64>) -> Vec<(f64, String)> {
    let decades = range.end - range.start;
    if decades < 1.2 {
        let linear = linear_ticks(&(10_f64.powf(range.start)..10_f64.powf(range.end)), 6);
        return linear.into_iter().filter(|(v, _)| *v > 0.0).map(|(v, text)| (v.log10(), text)).collect();
    }
    let factors: &[f64] = if decades < 3.0 { &[1.0, 2.0, 5.0] } else { &[1.0] };
    let stride = (decades / 8.0).ceil().max(1.0);
    let first = (range.start / stride).floor();
    (0..12)
        .map(|i| (first + f64::from(i)) * stride)
        .flat_map(|exponent| factors.iter().map(move |f| (f, exponent)))
        .map(|(f, exponent)| {
            let unit = 10_f64.powf(exponent);
            (f.log10() + exponent, written(f * unit, unit))
        })
        .filter(|(v, _)| (range.start..=range.end).contains(v))
        .collect()
}

/// Text of a number, rounded to the digit of `unit`.
fn written(value: f64, unit: f64) -> String {
    let place = |v: f64| (v.abs().log10() + 1e-9).floor();
    if value != 0.0 && !(1e-4..1e6).contains(&value.abs()) {
        let digits = (place(value) - place(unit)).clamp(0.0, 9.0) as usize;
        return format!("{value:.digits$e}");
    }
    let decimals = (-place(unit)).clamp(0.0, 9.0) as usize;
    // No minus before a zero.
    format!("{:.decimals$}", value + 0.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn panel(points: Vec<(f64, f64)>, log_y: bool) -> Panel {
        Panel {
            title: "Loss".into(),
            x_label: "epoch".into(),
            y_label: "loss".into(),
            log_y,
            series: vec![Series { name: "all".into(), points, ..Series::default() }],
            ..Panel::default()
        }
    }

    fn coloured(image: &Image, colour: RGBColor) -> Vec<(u32, u32)> {
        let wanted = Some([colour.0, colour.1, colour.2]);
        (0..image.height_px)
            .flat_map(|y| (0..image.width_px).map(move |x| (x, y)))
            .filter(|&(x, y)| image.pixel(x, y) == wanted)
            .collect()
    }

    /// The file is a readable PNG, one column of panels wide for one panel, two for up to four, three for more.
    #[test]
    fn size_follows_the_number_of_panels() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("curves.png");
        for (count, columns, rows) in [(0, 1, 0), (1, 1, 1), (2, 2, 1), (4, 2, 2), (9, 3, 3)] {
            curves(&path, "Training", &vec![panel(vec![(0.0, 1.0), (1.0, 2.0)], false); count]).unwrap();
            let image = Image::load(&path).unwrap();
            assert_eq!(image.width_px, columns * PANEL_WIDTH + 2 * MARGIN);
            assert_eq!(image.height_px, rows * PANEL_HEIGHT + 3 * MARGIN + TITLE.line_px());
        }
        let too_many = vec![panel(Vec::new(), false); 3 * 30];
        assert!(matches!(curves(&path, "", &too_many), Err(PlotError::TooLarge { .. })));
    }

    /// No points, one point, and points that are not finite, not positive on a logarithmic axis, equal, or huge: all
    /// are drawn without an error.
    #[test]
    fn odd_points_are_drawn_or_left_out() {
        let odd = [
            vec![],
            vec![(1.0, 2.0)],
            vec![(f64::NAN, 1.0), (1.0, f64::NAN), (f64::INFINITY, f64::NEG_INFINITY)],
            vec![(1.0, -1.0), (2.0, 0.0)],
            vec![(3.0, 7.0); 5],
            vec![(0.0, 0.0), (0.0, 0.0)],
            vec![(-1e99, -1e99), (1e99, 1e99), (f64::MAX, f64::MIN)],
            vec![(1e15, 1e-300), (1e15 + 1.0, 1e-299)],
            vec![(0.0, 1.0), (1.0, 1.0 + 1e-15)],
        ];
        for points in odd {
            for (log_x, log_y) in [(false, false), (false, true), (true, false), (true, true)] {
                let panel = Panel { log_x, from_zero: log_x, ..panel(points.clone(), log_y) };
                assert!(draw("Odd", &[panel]).is_ok(), "{points:?} {log_x} {log_y}");
            }
        }
        assert!(draw("", &[Panel::default()]).is_ok());
        let broken = [(0.0, 1.0), (1.0, f64::NAN), (2.0, 3.0), (3.0, 4.0)];
        assert_eq!(pieces(&broken, &Panel::default()).len(), 2);
        assert_eq!(pieces(&broken, &Panel { log_x: true, ..Panel::default() }).len(), 1);
    }

    /// A power of x is a straight line when both axes are logarithmic. With an axis that includes zero, a line far
    /// above zero is drawn near the top.
    #[test]
    fn axes_are_as_asked_for() {
        let power: Vec<(f64, f64)> =
            (0..60).map(|i| f64::from(i) / 20.0).map(|e| (10_f64.powf(e), 100_f64.powf(e))).collect();
        let both = Panel { log_x: true, ..panel(power, true) };
        let line: Vec<_> =
            coloured(&draw("", &[both]).unwrap(), COLOURS[0]).into_iter().filter(|&(_, y)| y > 130).collect();
        let (left, right) = (line.iter().min().unwrap(), line.iter().max().unwrap());
        let slope = (f64::from(left.1) - f64::from(right.1)) / f64::from(right.0 - left.0);
        for &(x, y) in &line {
            let wanted = f64::from(left.1) - f64::from(x - left.0) * slope;
            assert!((wanted - f64::from(y)).abs() < 5.0, "({x}, {y}) is off the line");
        }
        let high = Panel { from_zero: true, ..panel(vec![(0.0, 9.0), (1.0, 10.0)], false) };
        let lowest = |panel| {
            let image = draw("", &[panel]).unwrap();
            coloured(&image, COLOURS[0]).into_iter().map(|(_, y)| y).max().unwrap()
        };
        let without = Panel { from_zero: false, ..high.clone() };
        assert!(lowest(high) + PANEL_HEIGHT / 2 < lowest(without));
    }

    /// A rising line is drawn as a rising line, from left to right and from low to high.
    #[test]
    fn a_rising_line_rises() {
        let image = draw("", &[panel((0..100).map(|i| (f64::from(i), f64::from(i))).collect(), false)]).unwrap();
        // Below the legend, which is in the same colour.
        let line: Vec<_> = coloured(&image, COLOURS[0]).into_iter().filter(|&(_, y)| y > 130).collect();
        let (left, right) = (line.iter().min().unwrap(), line.iter().max().unwrap());
        assert!(right.0 - left.0 > PANEL_WIDTH / 2 && left.1 - right.1 > PANEL_HEIGHT / 2, "{left:?} {right:?}");
        let (a, b) = (f64::from(left.0), f64::from(left.1));
        let slope = (b - f64::from(right.1)) / (f64::from(right.0) - a);
        for &(x, y) in &line {
            assert!((b - (f64::from(x) - a) * slope - f64::from(y)).abs() < 4.0, "({x}, {y}) is off the line");
        }
    }

    /// Ticks are in the range and in order, at least two, with different texts.
    #[test]
    fn ticks_are_round_and_differ() {
        for (low, high) in [(0.0, 100.0), (-3.2, 17.9), (0.991, 0.9987), (1e-5, 3e-5), (12.0, 4e6), (27.3, 27.9)] {
            let linear = linear_ticks(&(low..high), 6);
            let mut all = vec![(linear, low..high)];
            if low > 0.0 {
                let logarithms = f64::log10(low)..f64::log10(high);
                all.push((logarithmic_ticks(&logarithms), logarithms));
            }
            for (ticks, range) in all {
                assert!((2..=14).contains(&ticks.len()), "{range:?}: {ticks:?}");
                assert!(ticks.iter().all(|(v, _)| (range.start..=range.end).contains(v)), "{range:?}: {ticks:?}");
                assert!(ticks.windows(2).all(|w| w[0].0 < w[1].0 && w[0].1 != w[1].1), "{range:?}: {ticks:?}");
            }
        }
        assert_eq!(
            linear_ticks(&(0.0..1.0), 5).iter().map(|t| t.1.as_str()).collect::<Vec<_>>(),
            ["0.0", "0.2", "0.4", "0.6", "0.8", "1.0"]
        );
    }

    /// A band is drawn between its edges, inside the axes; dots are not joined.
    #[test]
    fn bands_and_dots() {
        let of = |series: Series| draw("", &[Panel { series: vec![series], ..Panel::default() }]).unwrap();
        let tinted = |image: &Image| {
            let paper = [PAPER.0, PAPER.1, PAPER.2];
            let coloured = |p: &&[u8]| *p != paper && i16::from(p[2]) - i16::from(p[0]) > 25;
            image.rgb.chunks_exact(3).filter(coloured).count()
        };
        let points = vec![(0.0, 1.0), (10.0, 1.0)];
        let line = of(Series { points: points.clone(), ..Series::default() });
        let band =
            of(Series { points: points.clone(), band: vec![(0.0, 0.0, 2.0), (10.0, 0.0, 2.0)], ..Series::default() });
        assert!(tinted(&band) > 20 * tinted(&line), "{} {}", tinted(&band), tinted(&line));
        let dots = of(Series { points, marks: Marks::Dots, ..Series::default() });
        assert!(tinted(&dots) * 4 < tinted(&line), "{} {}", tinted(&dots), tinted(&line));
    }
}
