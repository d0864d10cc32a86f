//! The pane on the left: the input image and its choice, its posterior, and the look-ahead.

use super::{Choice, Viewer, WindowCommand, theme};
use carff_dataset::Observability;
use carff_decision::Sampling;
use carff_messages::{Gaussian, HealthState, MAX_HORIZON, MAX_SAMPLES};
use eframe::egui::{
    Button, ComboBox, DragValue, Grid, Image, Rect, ScrollArea, Sense, Slider, Stroke, Ui, load::SizedTexture, pos2,
    vec2,
};

/// Largest absolute latent value in the plot of a posterior.
const LATENT_RANGE: f32 = 3.0;
/// Largest height of the image, as a share of the pane, and the least such height: the settings below need room.
const IMAGE_SHARE: f32 = 0.26;
const LEAST_IMAGE: f32 = 96.0;

impl Viewer {
    pub(super) fn input_pane(&mut self, ui: &mut Ui, commands: &mut Vec<WindowCommand>) {
        let height = (ui.available_height() * IMAGE_SHARE).max(LEAST_IMAGE);
        ScrollArea::vertical().auto_shrink(false).show(ui, |ui| {
            ui.label(theme::heading("Image"));
            ui.spacing_mut().item_spacing.y = 4.0;
            self.chosen_image(ui, height);
            self.chooser(ui, commands);
            self.posterior(ui);
            ui.add_space(4.0);
            ui.label(theme::heading("Look ahead"));
            self.settings(ui);
            if self.live.is_some() {
                ui.add_space(8.0);
                ui.label(theme::heading("Stages"));
                self.stages(ui);
            }
        });
    }

    fn chosen_image(&mut self, ui: &mut Ui, max_height: f32) {
        let palette = theme::palette(ui.ctx());
        let width = ui.available_width();
        let Some(moment) = self.session.moment() else {
            let (rect, _) = ui.allocate_exact_size(vec2(width, (width * 0.75).min(max_height)), Sense::hover());
            ui.painter().rect_filled(rect, 8.0, palette.ground);
            let hint = match &self.album {
                Ok(_) => "Choose an image below, and press Toggle.".to_owned(),
                Err(why) => why.clone(),
            };
            let mut inner = ui.new_child(eframe::egui::UiBuilder::new().max_rect(rect.shrink(12.0)));
            inner.add(eframe::egui::Label::new(eframe::egui::RichText::new(hint).color(palette.weak)).wrap());
            return;
        };
        let image = &moment.input.image;
        let ratio = image.height_px as f32 / image.width_px.max(1) as f32;
        let height = (width * ratio).min(max_height);
        let id = self.textures.input(ui.ctx(), image);
        ui.add(Image::new(SizedTexture::new(id, vec2(height / ratio.max(f32::MIN_POSITIVE), height))).corner_radius(8));
        ui.horizontal_wrapped(|ui| {
            ui.label(theme::strong(&moment.input.title));
            if let Some(truth) = moment.input.truth {
                let models = self.session.models();
                let state = models.state(truth.branch, truth.timestamp);
                let named = moment.input.title.contains(models.state_name(state));
                let seen = match truth.observability {
                    Some(Observability::Full) => "actor seen",
                    Some(Observability::Partial) => "actor partly seen",
                    Some(Observability::None) => "actor hidden",
                    None => "",
                };
                if !named {
                    ui.weak(format!("truth: {}, view {}", models.state_name(state), truth.view));
                }
                ui.label(theme::small(seen).color(palette.weak));
            }
        });
    }

    fn chooser(&mut self, ui: &mut Ui, commands: &mut Vec<WindowCommand>) {
        let Ok(album) = &self.album else { return };
        let (views, steps) = (album.view_count(), album.steps());
        let branches = self.session.models().manifest.scenario.branches.clone();
        let before = self.choice;
        let mut choice = before;
        ui.horizontal_wrapped(|ui| {
            for (branch, name) in branches.iter().enumerate() {
                ui.selectable_value(&mut choice.branch, branch, name);
            }
        });
        ui.horizontal(|ui| {
            if steps > 6 {
                ui.add(Slider::new(&mut choice.timestamp, 0..=steps - 1).prefix("t"));
            } else {
                for timestamp in 0..steps {
                    ui.selectable_value(&mut choice.timestamp, timestamp, format!("t{timestamp}"));
                }
            }
        });
        ui.horizontal(|ui| {
            self.command_button(ui, WindowCommand::ImageBefore, Button::new("‹"), commands);
            ui.add(Slider::new(&mut choice.view, 0..=views.saturating_sub(1)).text("view"));
            self.command_button(ui, WindowCommand::ImageAfter, Button::new("›"), commands);
        });
        ui.horizontal(|ui| {
            ui.weak("browse");
            let name = |shows: Option<Observability>| match shows {
                None => "all views",
                Some(Observability::Full) => "actor seen",
                Some(Observability::Partial) => "actor partly seen",
                Some(Observability::None) => "actor hidden",
            };
            ComboBox::from_id_salt("shows").selected_text(name(choice.shows)).width(120.0).show_ui(ui, |ui| {
                for shows in [None].into_iter().chain(Observability::ALL.map(Some)) {
                    ui.selectable_value(&mut choice.shows, shows, name(shows));
                }
            });
        });
        if choice != before {
            self.choice = choice;
            let image = |c: &Choice| (c.branch, c.timestamp, c.view);
            if image(&choice) != image(&before)
                && let Err(why) = self.toggle_chosen()
            {
                self.say(why, true);
            }
        }
    }

    /// Draws mean and deviation of each latent dimension.
    fn posterior(&self, ui: &mut Ui) {
        let Some(moment) = self.session.moment() else { return };
        let Gaussian { mean, log_variance } = &moment.source;
        let palette = theme::palette(ui.ctx());
        let name = match moment.source_state {
            None => "Posterior of the image".to_owned(),
            Some(state) => format!("Fed back: {}", self.session.models().state_name(Some(state))),
        };
        ui.add_space(4.0);
        ui.weak(name);
        let (rect, response) = ui.allocate_exact_size(vec2(ui.available_width(), 38.0), Sense::hover());
        let painter = ui.painter();
        painter.rect_filled(rect, 6.0, palette.ground);
        painter.hline(rect.x_range(), rect.center().y, Stroke::new(1.0, palette.line));
        let y = |value: f32| {
            let share = (value / LATENT_RANGE).clamp(-1.0, 1.0);
            rect.center().y - share * (rect.height() / 2.0 - 3.0)
        };
        for (i, (mean, log_variance)) in mean.iter().zip(log_variance).enumerate() {
            let x = rect.left() + (i as f32 + 0.5) * rect.width() / 8.0;
            let deviation = (0.5 * log_variance).exp();
            let bar = Rect::from_min_max(pos2(x - 4.0, y(mean + deviation)), pos2(x + 4.0, y(mean - deviation)));
            painter.rect_filled(bar, 2.0, palette.accent.gamma_multiply(0.35));
            painter.hline(x - 4.0..=x + 4.0, y(*mean), Stroke::new(2.0, palette.accent));
        }
        response.on_hover_text("Mean and one standard deviation of each of the 8 latent dimensions, -3 to 3");
    }

    fn settings(&mut self, ui: &mut Ui) {
        let mut settings = self.session.settings();
        Grid::new("settings").num_columns(2).spacing([8.0, 5.0]).show(ui, |ui| {
            ui.weak("samples");
            ui.add(Slider::new(&mut settings.samples, 1..=MAX_SAMPLES));
            ui.end_row();
            ui.weak("horizon");
            ui.add(Slider::new(&mut settings.horizon, 1..=MAX_HORIZON));
            ui.end_row();
            ui.weak("sampling");
            let name = |sampling| match sampling {
                Sampling::Stratified => "stratified",
                Sampling::Independent => "independent",
            };
            ComboBox::from_id_salt("sampling").selected_text(name(settings.sampling)).width(110.0).show_ui(ui, |ui| {
                for sampling in [Sampling::Stratified, Sampling::Independent] {
                    ui.selectable_value(&mut settings.sampling, sampling, name(sampling));
                }
            });
            ui.end_row();
            ui.weak("seed");
            ui.add(DragValue::new(&mut settings.seed));
            ui.end_row();
        });
        if settings != self.session.settings() {
            self.session.set_settings(settings);
        }
    }

    /// Shows the last health report of each stage of the running graph.
    fn stages(&self, ui: &mut Ui) {
        let Some(live) = &self.live else { return };
        let palette = theme::palette(ui.ctx());
        let watched = live.watched();
        if let Err(why) = &watched.joined {
            ui.colored_label(palette.error, why);
        }
        if let Some(other) = &self.other_checkpoint {
            ui.colored_label(palette.hazard, format!("the graph uses another checkpoint: {}", other.display()));
        }
        Grid::new("stages").num_columns(3).spacing([10.0, 3.0]).show(ui, |ui| {
            for (stage, health) in &watched.health {
                let state = health.state().unwrap_or(HealthState::Faulty);
                let color = match state {
                    HealthState::Ok | HealthState::Done => palette.clear,
                    HealthState::Starting | HealthState::Slow | HealthState::Restarting => palette.hazard,
                    HealthState::Stale | HealthState::Faulty | HealthState::Lost => palette.error,
                };
                ui.colored_label(color, "●").on_hover_text(state.name());
                ui.label(stage.name());
                let (ms, mb) = (health.last_latency_ns as f64 * 1e-6, health.rss_bytes as f64 / 1e6);
                ui.label(theme::small(format!("{ms:.1} ms, {mb:.0} MB")).color(palette.weak));
                ui.end_row();
            }
        });
        ui.weak(format!("{} frames", watched.frames));
    }
}
