//! The pane at the bottom: decisions and durations.

use super::{Viewer, theme};
use crate::journal::{Journal, ShownDecision};
use eframe::egui::{Align, Color32, Grid, Layout, ScrollArea, Ui, vec2};
use egui_plot::{GridMark, Line, Plot, PlotPoints};

/// Width of the decisions, as a share of the pane.
const DECISIONS: f32 = 0.5;
/// Shorter durations are drawn as this one, because the axis is logarithmic.
const LEAST_MS: f64 = 0.01;
/// Least distance between two labels of the axis, points; labels that are closer are faint or missing.
const LABEL_HEIGHT: f64 = 26.0;

impl Viewer {
    pub(super) fn journal_pane(&mut self, ui: &mut Ui) {
        // Shows the journal of the running graph while one is watched, else the window's own.
        let watched = self.live.as_ref().map(|live| live.watched().journal.clone());
        let journal = watched.as_ref().unwrap_or(&self.session.journal);
        let (width, height) = (ui.available_width(), ui.available_height());
        ui.horizontal_top(|ui| {
            ui.allocate_ui_with_layout(vec2(width * DECISIONS, height), Layout::top_down(Align::Min), |ui| {
                ui.set_min_width(width * DECISIONS);
                ui.horizontal(|ui| {
                    ui.label(theme::heading("Decisions"));
                    let rule = self.session.models().policy.rule.name();
                    ui.weak(if watched.is_some() {
                        "of the running graph".to_owned()
                    } else {
                        format!("rule: {rule}")
                    });
                });
                decisions(ui, journal);
            });
            ui.separator();
            ui.allocate_ui_with_layout(vec2(ui.available_width(), height), Layout::top_down(Align::Min), |ui| {
                ui.horizontal(|ui| {
                    ui.label(theme::heading("Latency"));
                    ui.weak(if watched.is_some() { "of the running graph" } else { "of this window" });
                });
                latency(ui, journal, if watched.is_some() { "frame" } else { "call" });
            });
        });
    }
}

fn decisions(ui: &mut Ui, journal: &Journal) {
    let palette = theme::palette(ui.ctx());
    if journal.decisions().len() == 0 {
        ui.weak("none yet: probing a forecast makes a decision");
        return;
    }
    ScrollArea::vertical().auto_shrink(false).id_salt("decisions").show(ui, |ui| {
        Grid::new("decisions").num_columns(5).striped(true).spacing([14.0, 3.0]).show(ui, |ui| {
            for name in ["", "hazard", "rests on", "by", "latency"] {
                ui.label(theme::small(name).color(palette.weak));
            }
            ui.end_row();
            for ShownDecision { rests_on, action, confidence, hazard_probability, reason, latency_ms } in
                journal.decisions().rev()
            {
                let halts = action.is_safe();
                let (name, color) = (action.name(), if halts { palette.hazard } else { palette.clear });
                let sure = format!("{:.0} % sure", 100.0 * confidence);
                ui.label(theme::strong(name).color(color)).on_hover_text(sure);
                ui.monospace(format!("{:>5.1} %", 100.0 * hazard_probability));
                ui.label(rests_on);
                ui.weak(reason);
                ui.monospace(latency_ms.map_or_else(|| "-".to_owned(), |ms| format!("{ms:.1} ms")));
                ui.end_row();
            }
        });
    });
}

/// Returns the powers of ten on an axis of this height, in steps that leave room for their labels.
fn decades((low, high): (f64, f64), height: f32) -> Vec<GridMark> {
    let decade_height = f64::from(height) / (high - low);
    let step = (1..=4).find(|step| f64::from(*step) * decade_height >= LABEL_HEIGHT).unwrap_or(4);
    let all = (-2..=6).filter(|decade| decade % step == 0);
    let marks = all.map(|decade| GridMark { value: f64::from(decade), step_size: f64::from(step) });
    marks.filter(|mark| (low..=high).contains(&mark.value)).collect()
}

/// Returns the label of a value on the logarithmic axis.
fn milliseconds(log10_ms: f64) -> String {
    let ms = 10_f64.powf(log10_ms);
    if ms < 10.0 {
        format!("{ms:.2}").trim_end_matches('0').trim_end_matches('.').to_owned()
    } else {
        format!("{ms:.0}")
    }
}

fn latency(ui: &mut Ui, journal: &Journal, x_label: &str) {
    let palette = theme::palette(ui.ctx());
    let color = |i: usize| -> Color32 { palette.lines[i % palette.lines.len()] };
    ui.horizontal_top(|ui| {
        let plot_width = (ui.available_width() - 236.0).max(120.0);
        let height = ui.available_height() - LABEL_HEIGHT as f32;
        Plot::new("latency")
            .width(plot_width)
            .height(ui.available_height())
            .y_grid_spacer(move |input| decades(input.bounds, height))
            .y_axis_formatter(|mark, _| milliseconds(mark.value))
            .y_axis_label(theme::small("latency, ms"))
            .x_axis_label(theme::small(x_label))
            .show_background(false)
            .allow_scroll(false)
            .allow_zoom(false)
            .allow_drag(false)
            .allow_boxed_zoom(false)
            .y_axis_min_width(28.0)
            .set_margin_fraction(vec2(0.02, 0.08))
            .label_formatter(|name, point| format!("{name}\n{} ms", milliseconds(point.y)))
            .show(ui, |plot| {
                for (i, times) in journal.times().iter().enumerate() {
                    let points: PlotPoints<'_> =
                        times.values.iter().map(|[at, ms]| [*at, ms.max(LEAST_MS).log10()]).collect();
                    plot.line(Line::new(times.name, points).color(color(i)).width(1.5));
                }
            });
        Grid::new("latency").num_columns(4).spacing([10.0, 3.0]).show(ui, |ui| {
            for name in ["ms", "p50", "p99", "max"] {
                ui.label(theme::small(name).color(palette.weak));
            }
            ui.end_row();
            for (i, times) in journal.times().iter().enumerate() {
                let Some(spread) = times.spread() else { continue };
                ui.label(theme::small(format!("● {}", times.name)).color(color(i)));
                for value in [spread.p50, spread.p99, spread.max] {
                    ui.label(theme::small(format!("{value:.1}")));
                }
                ui.end_row();
            }
        });
    });
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Some powers of ten are on the axis at any height and range, never closer than their labels are high.
    #[test]
    fn the_axis_has_labels() {
        for height in [60.0, 90.0, 130.0, 400.0] {
            for bounds in [(-0.2, 0.9), (-2.3, 5.1), (1.5, 4.2), (-1.0, 6.0)] {
                let marks = decades(bounds, height);
                assert!(!marks.is_empty(), "{height} {bounds:?}");
                let distance = marks[0].step_size * f64::from(height) / (bounds.1 - bounds.0);
                assert!(distance >= LABEL_HEIGHT, "{height} {bounds:?}");
                assert!(marks.windows(2).all(|pair| pair[1].value - pair[0].value == pair[0].step_size));
            }
        }
    }
}
