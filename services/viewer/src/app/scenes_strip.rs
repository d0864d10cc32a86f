//! The strip below the scene: thumbnails of all scenes of the step. A click shows a scene.

use super::{Viewer, theme};
use crate::session::{Scene, steps_ahead};
use eframe::egui::{
    Align2, FontId, Rect, ScrollArea, Sense, Stroke, StrokeKind, Ui, WidgetInfo, WidgetType, pos2, vec2,
};

const CARD: [f32; 2] = [116.0, 120.0];
const IMAGE: [f32; 2] = [116.0, 87.0];

impl Viewer {
    pub(super) fn scenes_strip(&mut self, ui: &mut Ui) {
        let palette = theme::palette(ui.ctx());
        let scenes = self.session.scenes();
        ui.horizontal(|ui| {
            ui.label(theme::heading("Scenes"));
            let text = match self.session.moment() {
                None => "scenes that explain the image, after Toggle".to_owned(),
                Some(moment) if moment.forecast.is_none() => "press Predict to forecast the next step".to_owned(),
                Some(moment) => {
                    let drawn = moment.forecast.as_ref().map_or(0, |f| f.draws.len());
                    let path = format!("path followed: {:.0} %", 100.0 * moment.path_probability);
                    format!("{}: the mixture's components and {drawn} drawn latents; {path}", steps_ahead(moment.step))
                }
            };
            ui.weak(text);
        });
        let shown = self.session.moment().map(|m| m.selection);
        let mut chosen = None;
        ScrollArea::horizontal().auto_shrink([false, true]).show(ui, |ui| {
            ui.horizontal(|ui| {
                ui.set_min_height(CARD[1]);
                for (i, scene) in scenes.iter().enumerate() {
                    if self.card(ui, i, scene, Some(scene.selection) == shown) {
                        chosen = Some(scene.selection);
                    }
                }
            });
        });
        ui.painter().hline(ui.max_rect().x_range(), ui.max_rect().top() - 10.0, Stroke::new(1.0, palette.line));
        if let Some(selection) = chosen {
            self.select(selection);
        }
    }

    fn card(&self, ui: &mut Ui, index: usize, scene: &Scene, is_shown: bool) -> bool {
        let palette = theme::palette(ui.ctx());
        let (rect, response) = ui.allocate_exact_size(vec2(CARD[0], CARD[1]), Sense::click());
        response.widget_info(|| WidgetInfo::selected(WidgetType::Button, true, is_shown, &scene.name));
        let painter = ui.painter_at(rect.expand(2.0));
        let fill = if response.hovered() { palette.raised.lerp_to_gamma(palette.accent, 0.15) } else { palette.raised };
        painter.rect_filled(rect, 7.0, fill);
        let area = Rect::from_min_size(rect.min, vec2(IMAGE[0], IMAGE[1]));
        if let Some(id) = self.textures.thumbnail(index) {
            let whole = Rect::from_min_max(pos2(0.0, 0.0), pos2(1.0, 1.0));
            let image = eframe::egui::Image::new(eframe::egui::load::SizedTexture::new(id, area.size()));
            image.uv(whole).corner_radius(7).paint_at(ui, area);
        } else {
            painter.rect_filled(area, 7.0, palette.ground);
        }
        let name = rect.left_bottom() + vec2(7.0, -19.0);
        let text = ui.visuals().text_color();
        painter.text(name, Align2::LEFT_BOTTOM, &scene.name, FontId::proportional(11.0), text);
        let models = self.session.models();
        let (state, color) = match &scene.probed {
            None => ("", palette.weak),
            Some(probed) => {
                let state = probed.reading.state;
                let color = match state {
                    None => palette.error,
                    Some(s) if models.is_hazard(s) => palette.hazard,
                    Some(_) => palette.clear,
                };
                (models.state_name(state), color)
            }
        };
        if !state.is_empty() {
            painter.circle_filled(rect.left_bottom() + vec2(11.0, -10.5), 3.5, color);
            let at = rect.left_bottom() + vec2(19.0, -4.0);
            painter.text(at, Align2::LEFT_BOTTOM, state, FontId::proportional(10.5), color);
        }
        if let Some(share) = scene.share {
            let at = rect.right_bottom() + vec2(-7.0, -4.0);
            let share = format!("{:.0} %", 100.0 * share);
            painter.text(at, Align2::RIGHT_BOTTOM, share, FontId::proportional(10.5), palette.weak);
        }
        let stroke = if is_shown { Stroke::new(2.0, palette.accent) } else { Stroke::new(1.0, palette.line) };
        painter.rect_stroke(rect, 7.0, stroke, StrokeKind::Inside);
        response.clicked()
    }
}
