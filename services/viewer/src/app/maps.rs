//! The shown scene from above: a rendered image, and a slice of density at a height.

use super::scene_pane::{TAKEN, oriented_box};
use super::theme::Palette;
use super::{Latent, Viewer, theme};
use carff_base::geometry::OrientedBox;
use eframe::egui::{Color32, Painter, Pos2, Rect, Sense, Slider, Stroke, TextureId, Ui, pos2, vec2};

/// Length of the drawn line of sight, metres.
const SIGHT_M: f64 = 4.0;

impl Viewer {
    pub(super) fn maps(&mut self, ui: &mut Ui) {
        let gap = ui.spacing().item_spacing.x;
        let width = ((ui.available_width() - gap) / 2.0).max(60.0);
        let [low, high] = self.session.models().bounds_m();
        let height = width * ((high[1] - low[1]) / (high[0] - low[0])) as f32;
        let (birds_eye, slice) = (self.textures.birds_eye(), self.textures.slice(ui.ctx()));
        ui.horizontal(|ui| {
            let palette = theme::palette(ui.ctx());
            for (name, texture, palette, latent) in [
                ("Bird's eye", birds_eye, theme::on_images(), self.drawn.birds_eye),
                ("Density", slice, palette, self.drawn.slice),
            ] {
                ui.vertical(|ui| {
                    ui.set_width(width);
                    ui.label(theme::heading(name));
                    let (rect, _) = ui.allocate_exact_size(vec2(width, height), Sense::hover());
                    self.map(ui, rect, texture, palette, &latent);
                });
            }
        });
        let palette = theme::palette(ui.ctx());
        let cameras = [(palette.ego, "camera of the image"), (palette.accent, "camera of the view")];
        theme::legend(ui, &cameras);
        ui.horizontal(|ui| {
            ui.weak("density at");
            let slider = Slider::new(&mut self.slice_height_m, low[2] as f32..=high[2] as f32);
            ui.add(slider.suffix(" m").fixed_decimals(2));
        });
    }

    fn map(&self, ui: &Ui, rect: Rect, texture: Option<TextureId>, palette: &Palette, latent: &Latent) {
        let painter = ui.painter_at(rect);
        painter.rect_filled(rect, 6.0, palette.ground);
        if let Some(id) = texture.filter(|_| self.session.moment().is_some()) {
            painter.image(id, rect, Rect::from_min_max(pos2(0.0, 0.0), pos2(1.0, 1.0)), Color32::WHITE);
        }
        let [low, high] = self.session.models().bounds_m();
        let at = |p: [f64; 2]| {
            let share = [(p[0] - low[0]) / (high[0] - low[0]), (high[1] - p[1]) / (high[1] - low[1])];
            rect.min + vec2(share[0] as f32 * rect.width(), share[1] as f32 * rect.height())
        };
        let found = self.recent(latent).and_then(|recent| recent.found.as_ref());
        if self.overlays.boxes {
            for (i, place) in self.session.models().probe.layout().places().iter().enumerate() {
                let taken = found.and_then(|f| f.probed.occupancies.get(i)).is_some_and(|o| *o >= TAKEN);
                let stroke = if taken {
                    Stroke::new(2.0, palette.of_place(&place.name))
                } else {
                    Stroke::new(1.0, palette.weak.gamma_multiply(0.6))
                };
                outline(&painter, &place.oriented_box, stroke, at);
            }
            for unknown in self.unknowns() {
                outline(&painter, &oriented_box(unknown), Stroke::new(2.0, palette.error), at);
            }
        }
        // The pose of the image, and the pose of the view.
        if let Some(camera) = self.session.moment().and_then(|m| m.input.camera) {
            let m = &camera.world_from_camera;
            sight(&painter, camera.position_m(), [-m[0][2], -m[1][2]], palette.ego, at);
        }
        let (eye, target) = (self.camera.eye_m(), self.camera.target_m);
        sight(&painter, eye, [target[0] - eye[0], target[1] - eye[1]], palette.accent, at);
    }
}

/// Draws the outline of a box from above.
fn outline(painter: &Painter, oriented: &OrientedBox, stroke: Stroke, at: impl Fn([f64; 2]) -> Pos2) {
    let corners = [[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]].map(|[x, y]| {
        let p = oriented.point([x, y, 0.0]);
        at([p[0], p[1]])
    });
    for i in 0..4 {
        painter.line_segment([corners[i], corners[(i + 1) % 4]], stroke);
    }
}

/// Draws a camera: a dot and its line of sight. Cameras outside the map are drawn at its edge.
fn sight(painter: &Painter, eye_m: [f64; 3], along: [f64; 2], color: Color32, at: impl Fn([f64; 2]) -> Pos2) {
    let length = along[0].hypot(along[1]).max(1e-9);
    let end = [0, 1].map(|i| eye_m[i] + SIGHT_M * along[i] / length);
    let inside = painter.clip_rect().shrink(4.0);
    // A small window may leave no room for the map.
    if !inside.is_positive() {
        return;
    }
    let (from, to) = (at([eye_m[0], eye_m[1]]), at(end));
    let dot = inside.clamp(from);
    painter.line_segment([dot, dot + (to - from)], Stroke::new(1.5, color));
    painter.circle(dot, 3.5, color, Stroke::new(1.0, Color32::from_black_alpha(160)));
}
