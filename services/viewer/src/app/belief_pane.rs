//! The pane on the right: the belief over the states, the occupancy of each place, and the maps.

use super::scene_pane::TAKEN;
use super::{Viewer, theme};
use crate::session::Selection;
use carff_decision::Step;
use eframe::egui::{
    Align2, Color32, FontId, Rect, ScrollArea, Sense, Stroke, TextStyle, Ui, WidgetInfo, WidgetType, vec2,
};

const BAR_HEIGHT: f32 = 17.0;
/// Width of the names of states and places.
const NAMES: f32 = 96.0;
/// Width of the numbers after the bars, and of the second of them.
const NUMBERS: f32 = 98.0;
const COUNTS: f32 = 53.0;
/// Smallest probability of something unknown that is shown.
const LEAST_SHOWN: f32 = 0.005;

/// A labelled bar.
struct Bar<'a> {
    name: &'a str,
    share: f32,
    color: Color32,
    percent: String,
    count: String,
    is_marked: bool,
}

impl Viewer {
    pub(super) fn belief_pane(&mut self, ui: &mut Ui) {
        ScrollArea::vertical().auto_shrink(false).show(ui, |ui| {
            ui.spacing_mut().item_spacing.y = 2.0;
            ui.spacing_mut().interact_size.y = 16.0;
            self.belief(ui);
            ui.add_space(4.0);
            self.places(ui);
            ui.add_space(4.0);
            self.maps(ui);
        });
    }

    fn belief(&mut self, ui: &mut Ui) {
        let palette = theme::palette(ui.ctx());
        let models = self.session.models();
        let belief = self.session.moment().and_then(|m| m.belief.as_ref());
        ui.horizontal(|ui| {
            ui.label(theme::heading("Belief"));
            if let Some(belief) = belief {
                let hazard = belief.resolved.hazard_probability;
                let color = if hazard >= TAKEN { palette.hazard } else { palette.weak };
                ui.label(theme::strong(format!("hazard {:.0} %", 100.0 * hazard)).color(color));
                let unknown = belief.resolved.unknown_probability;
                if unknown >= LEAST_SHOWN {
                    ui.label(theme::strong(format!("unknown {:.0} %", 100.0 * unknown)).color(palette.error));
                }
            } else {
                ui.weak("press Probe to read the scenes");
            }
        });
        theme::legend(
            ui,
            &[(palette.hazard, "hazard state"), (palette.clear, "clear state"), (palette.accent, "shown")],
        );
        let selection = self.session.moment().map(|m| m.selection);
        let mut chosen = None;
        for (state, name) in models.state_names.iter().enumerate() {
            let share = belief.and_then(|b| b.resolved.state_probabilities.get(state).copied());
            let percent = share.map_or_else(String::new, |s| format!("{:.0} %", 100.0 * s));
            let count = belief.map_or_else(String::new, |belief| {
                format!("{} of {}", showing(belief, Some(state)), belief.samples.len())
            });
            let color = if models.is_hazard(state) { palette.hazard } else { palette.clear };
            let is_marked = selection == Some(Selection::State(state));
            let bar = Bar { name, share: share.unwrap_or(0.0), color, percent, count, is_marked };
            if draw_bar(ui, &bar, Sense::click()) {
                chosen = Some(Selection::State(state));
            }
        }
        if let Some(unknown) = belief.map(|b| showing(b, None)).filter(|n| *n > 0) {
            ui.colored_label(palette.error, format!("{unknown} samples match no known state"));
        }
        if let Some(selection) = chosen.filter(|_| self.session.moment().is_some()) {
            self.is_following = false;
            self.select(selection);
        }
    }

    fn places(&self, ui: &mut Ui) {
        let palette = theme::palette(ui.ctx());
        ui.horizontal(|ui| {
            ui.label(theme::heading("Places"));
            ui.weak("share of light that each box absorbs");
        });
        theme::legend(ui, &[(palette.hazard, "actor"), (palette.ego, "ego")]);
        let found = self.session.moment().and_then(|m| m.found.as_ref());
        for (i, place) in self.session.models().probe.layout().places().iter().enumerate() {
            let share = found.and_then(|f| f.probed.occupancies.get(i).copied());
            let taken_in: Vec<&str> = place
                .occupied_in
                .iter()
                .enumerate()
                .filter(|(_, taken)| **taken)
                .map(|(state, _)| self.session.models().state_name(Some(state)))
                .collect();
            let percent = share.map_or_else(String::new, |s| format!("{:.0} %", 100.0 * s));
            let name = place_name(&place.name, &taken_in);
            let color = palette.of_place(&place.name);
            let (share, count) = (share.unwrap_or(0.0), String::new());
            let bar = Bar { name: &name, share, color, percent, count, is_marked: false };
            draw_bar(ui, &bar, Sense::hover());
        }
    }
}

/// Returns the number of samples that show a state.
fn showing(belief: &Step, state: Option<usize>) -> usize {
    belief.samples.iter().filter(|s| s.reading.state == state).count()
}

/// Returns the actor and steps at a place: the common endings of the states' names.
fn place_name(name: &str, taken_in: &[&str]) -> String {
    let mut steps: Vec<&str> = taken_in.iter().filter_map(|state| state.rsplit(' ').next()).collect();
    steps.sort_unstable();
    steps.dedup();
    format!("{name} {}", steps.join(" "))
}

/// Draws a bar and returns whether it was pressed.
fn draw_bar(ui: &mut Ui, bar: &Bar<'_>, sense: Sense) -> bool {
    let palette = theme::palette(ui.ctx());
    let (rect, response) = ui.allocate_exact_size(vec2(ui.available_width(), BAR_HEIGHT), sense);
    response.widget_info(|| WidgetInfo::labeled(WidgetType::Button, sense.senses_click(), bar.name));
    let painter = ui.painter();
    let is_lit = (response.hovered() && sense.senses_click()) || bar.is_marked;
    if is_lit {
        painter.rect_filled(rect, 5.0, palette.raised);
    }
    let font = TextStyle::Body.resolve(ui.style());
    let text = if bar.is_marked { palette.accent } else { ui.visuals().text_color() };
    painter.text(rect.left_center() + vec2(4.0, 0.0), Align2::LEFT_CENTER, bar.name, font, text);
    let track = Rect::from_min_max(rect.min + vec2(NAMES, 6.0), rect.max - vec2(NUMBERS, 6.0));
    painter.rect_filled(track, 4.5, palette.ground);
    let width = track.width() * bar.share.clamp(0.0, 1.0);
    if width > 0.5 {
        let filled = Rect::from_min_size(track.min, vec2(width.max(track.height()), track.height()));
        painter.rect_filled(filled, 4.5, bar.color);
    }
    painter.rect_stroke(track, 4.5, Stroke::new(1.0, palette.line), eframe::egui::StrokeKind::Inside);
    for (right, numbers) in [(COUNTS, &bar.percent), (0.0, &bar.count)] {
        let at = rect.right_center() - vec2(right + 4.0, 0.0);
        painter.text(at, Align2::RIGHT_CENTER, numbers, FontId::proportional(11.0), palette.weak);
    }
    response.clicked()
}
