//! The pane in the middle: the shown scene from the user's camera, with the results of probing.

use super::{Viewer, WindowCommand, theme};
use crate::camera::FOV_DEG;
use carff_base::geometry::{OrientedBox, PinholeCamera};
use carff_messages::UnknownBox;
use eframe::egui::{
    Align2, Button, Color32, DragValue, FontId, Painter, PointerButton, Rect, Response, Sense, Slider, Stroke,
    TextStyle, Ui, UiBuilder, pos2, vec2,
};
use std::time::Instant;

/// Occupancy from which a place counts as taken.
pub const TAKEN: f32 = 0.5;
/// Points of scrolling that double or halve the distance.
const SCROLL_PER_DOUBLING: f32 = 240.0;
/// A density is drawn if this length of it absorbs a visible share of the light, metres.
const LEAST_STOPPED: f32 = 0.04;
const POINT_LENGTH_M: f32 = 0.25;
/// Width of the scene below which the settings of the view are hidden, and captions are below each other.
const NARROW: f32 = 540.0;
/// Range of the longest side of the finest image, pixels.
const FINEST_PX: [u32; 2] = [96, 1536];

impl Viewer {
    pub(super) fn scene_pane(&mut self, ui: &mut Ui, commands: &mut Vec<WindowCommand>) {
        let rect = ui.available_rect_before_wrap();
        let response = ui.allocate_rect(rect, Sense::click_and_drag());
        self.move_camera(ui, &response);
        let scale = ui.ctx().pixels_per_point();
        let longest = (rect.width().max(rect.height()) * scale).max(1.0);
        let shrink = scale * (self.finest_px as f32 / longest).min(1.0);
        self.view_px = [rect.width(), rect.height()].map(|side| ((side * shrink) as u32).max(8));

        let palette = theme::palette(ui.ctx());
        let painter = ui.painter_at(rect);
        painter.rect_filled(rect, 0.0, palette.ground);
        if let Some(view) = self.textures.view().filter(|_| self.session.moment().is_some()) {
            let whole = Rect::from_min_max(pos2(0.0, 0.0), pos2(1.0, 1.0));
            painter.image(view, rect, whole, Color32::WHITE);
            let camera = self.camera.pinhole(rect.width() as u32, rect.height() as u32);
            self.overlay(&painter, rect, &camera);
        } else {
            let text = "Toggle an image to see a scene that explains it";
            painter.text(rect.center(), Align2::CENTER_CENTER, text, FontId::proportional(14.0), palette.weak);
        }
        self.captions(ui, rect);
        let bar = Rect::from_min_size(rect.min + vec2(10.0, rect.height() - 44.0), vec2(rect.width() - 20.0, 34.0));
        let mut inner = ui.new_child(UiBuilder::new().max_rect(bar));
        self.view_bar(&mut inner, commands);
    }

    fn move_camera(&mut self, ui: &Ui, response: &Response) {
        let size = [f64::from(response.rect.width()), f64::from(response.rect.height())];
        let drag = response.drag_delta();
        let drag_px = [f64::from(drag.x), f64::from(drag.y)];
        let before = self.camera;
        let shift = ui.input(|i| i.modifiers.shift);
        if response.dragged_by(PointerButton::Primary) && !shift {
            self.camera.orbit(drag_px, size);
        } else if response.dragged_by(PointerButton::Secondary)
            || response.dragged_by(PointerButton::Middle)
            || response.dragged_by(PointerButton::Primary)
        {
            self.camera.pan(drag_px, size);
        }
        if response.hovered() {
            let (scroll, pinch) = ui.input(|i| (i.smooth_scroll_delta.y, i.zoom_delta()));
            self.camera.zoom(f64::from((scroll / SCROLL_PER_DOUBLING).exp2() * pinch));
        }
        if self.camera != before {
            self.moved = Some(Instant::now());
        }
    }

    /// Draws boxes and densities.
    fn overlay(&self, painter: &Painter, rect: Rect, camera: &PinholeCamera) {
        let palette = theme::on_images();
        let at = |p: [f64; 2]| rect.min + vec2(p[0] as f32, p[1] as f32);
        let found = self.recent(&self.drawn.view).and_then(|recent| recent.found.as_ref());
        let prober = self.session.models().probe.layout();
        if let (Some(found), true) = (found, self.overlays.densities) {
            for (point, density) in prober.points().iter().zip(&found.densities) {
                let stopped = 1.0 - (-density.max(0.0) * POINT_LENGTH_M).exp();
                if stopped < LEAST_STOPPED {
                    continue;
                }
                if let Some((pixel, depth_m)) = camera.project(point.map(f64::from)) {
                    let radius = (60.0 / depth_m as f32).clamp(0.8, 2.6);
                    let color = Color32::from_rgb(255, 250, 215).gamma_multiply(0.25 + 0.7 * stopped);
                    painter.circle_filled(at(pixel), radius, color);
                }
            }
        }
        if !self.overlays.boxes {
            return;
        }
        for (i, place) in prober.places().iter().enumerate() {
            let occupancy = found.and_then(|f| f.probed.occupancies.get(i).copied());
            let color = palette.of_place(&place.name);
            let stroke = match occupancy {
                Some(o) if o >= TAKEN => Stroke::new(2.0, color),
                Some(_) => Stroke::new(1.0, Color32::from_white_alpha(70)),
                None => Stroke::new(1.0, Color32::from_white_alpha(110)),
            };
            wireframe(painter, rect, camera, &place.oriented_box, stroke);
            if let Some(o) = occupancy.filter(|o| *o >= TAKEN) {
                let top = place.oriented_box.point([0.0, 0.0, 1.6]);
                if let Some((pixel, _)) = camera.project(top) {
                    label(painter, at(pixel), &format!("{} {:.0} %", place.name, 100.0 * o), color);
                }
            }
        }
        for unknown in self.unknowns() {
            let oriented = oriented_box(unknown);
            wireframe(painter, rect, camera, &oriented, Stroke::new(2.0, palette.error));
            if let Some((pixel, _)) = camera.project(oriented.point([0.0, 0.0, 1.3])) {
                label(painter, at(pixel), &format!("unknown {:.0} %", 100.0 * unknown.probability), palette.error);
            }
        }
    }

    /// Returns the boxes of the shown image in which something stands that no known state explains.
    pub(super) fn unknowns(&self) -> &[UnknownBox] {
        self.session.moment().map_or(&[], |m| &m.unknowns)
    }

    /// Draws the captions: name of the scene, and resolution.
    fn captions(&self, ui: &Ui, rect: Rect) {
        let Some(scene) = self.recent(&self.drawn.view).map(|recent| &recent.scene) else { return };
        let painter = ui.painter_at(rect);
        let mut text = scene.name.clone();
        let mut color = Color32::WHITE;
        if let Some(probed) = &scene.probed {
            let state = probed.reading.state;
            let name = self.session.models().state_name(state);
            text = format!("{text}  shows {name} ({:.0} %)", 100.0 * probed.reading.confidence);
            let is_hazard = state.is_some_and(|s| self.session.models().is_hazard(s));
            color = if is_hazard { theme::on_images().hazard } else { Color32::WHITE };
        }
        caption(&painter, rect.left_top() + vec2(12.0, 12.0), Align2::LEFT_TOP, &text, color, 13.0);
        if let Some((image, took_ms)) = &self.view {
            let text = format!("{} x {}, {took_ms:.0} ms", image.width_px, image.height_px);
            let down = if rect.width() < NARROW { 42.0 } else { 12.0 };
            caption(&painter, rect.right_top() + vec2(-12.0, down), Align2::RIGHT_TOP, &text, Color32::WHITE, 10.5);
        }
    }

    /// The field of view, and the size of the finest image.
    fn view_settings(&mut self, ui: &mut Ui) {
        let mut fov_deg = self.camera.fov_deg;
        ui.spacing_mut().slider_width = 64.0;
        let slider = Slider::new(&mut fov_deg, FOV_DEG[0]..=FOV_DEG[1]).suffix("°").fixed_decimals(0);
        if ui.add(slider).on_hover_text("Field of view across the shorter side").changed() {
            self.camera.set_fov(fov_deg);
            self.moved = Some(Instant::now());
        }
        ui.add(DragValue::new(&mut self.finest_px).range(FINEST_PX[0]..=FINEST_PX[1]).suffix(" px").speed(4))
            .on_hover_text("Longest side of the finest image (drag): coarser images come first");
    }

    fn view_bar(&mut self, ui: &mut Ui, commands: &mut Vec<WindowCommand>) {
        let is_narrow = ui.available_width() < NARROW;
        let palette = theme::palette(ui.ctx());
        let frame = theme::pane(palette).fill(palette.pane.gamma_multiply(0.86)).corner_radius(8);
        frame.inner_margin(eframe::egui::Margin::symmetric(8, 4)).show(ui, |ui| {
            ui.horizontal(|ui| {
                for (command, name) in [
                    (WindowCommand::CameraCorner, "Corner"),
                    (WindowCommand::CameraAbove, "Above"),
                    (WindowCommand::CameraImage, "Image"),
                ] {
                    self.command_button(ui, command, Button::new(name), commands);
                }
                ui.separator();
                if !is_narrow {
                    self.view_settings(ui);
                    ui.separator();
                }
                ui.checkbox(&mut self.overlays.boxes, "boxes");
                ui.checkbox(&mut self.overlays.densities, "densities");
            });
        });
    }
}

/// Returns the box of something unknown. Its sides are parallel to the axes.
pub(super) fn oriented_box(unknown: &UnknownBox) -> OrientedBox {
    OrientedBox { center: unknown.center, half_size: unknown.half_size, yaw: 0.0 }
}

fn wireframe(painter: &Painter, rect: Rect, camera: &PinholeCamera, oriented: &OrientedBox, stroke: Stroke) {
    let at = |p: [f64; 2]| rect.min + vec2(p[0] as f32, p[1] as f32);
    for [a, b] in oriented.edges() {
        if let Some([a, b]) = camera.project_segment(a, b) {
            painter.line_segment([at(a), at(b)], stroke);
        }
    }
}

/// Draws text on a dark background, readable on any image.
fn caption(painter: &Painter, at: eframe::egui::Pos2, align: Align2, text: &str, color: Color32, size: f32) {
    let galley = painter.layout_no_wrap(text.to_owned(), FontId::proportional(size), color);
    let rect = align.anchor_size(at, galley.size());
    painter.rect_filled(rect.expand2(vec2(7.0, 4.0)), 6.0, Color32::from_black_alpha(150));
    painter.galley(rect.min, galley, color);
}

fn label(painter: &Painter, at: eframe::egui::Pos2, text: &str, color: Color32) {
    let size = TextStyle::Small.resolve(&painter.ctx().style()).size + 0.5;
    caption(painter, at, Align2::CENTER_BOTTOM, text, color, size);
}
