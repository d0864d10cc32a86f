//! The bar at the top: the three main commands, the history, and the source of images.

use super::{Viewer, WindowCommand, theme};
use crate::live::LiveFeed;
use crate::session::steps_ahead;
use eframe::egui::{Align, Button, ComboBox, Layout, RichText, Theme, Ui, vec2};

/// Largest number of shown entries of the history, the width of one, and the width of everything right of them.
const CRUMBS: usize = 7;
const CRUMB_WIDTH: f32 = 40.0;
const RIGHT_WIDTH: f32 = 290.0;
const LIVE_WIDTH: f32 = 72.0;

impl Viewer {
    pub(super) fn top_bar(&mut self, ui: &mut Ui, commands: &mut Vec<WindowCommand>) {
        ui.horizontal(|ui| {
            let palette = theme::palette(ui.ctx());
            ui.label(theme::heading("CARFF").color(palette.accent));
            ui.add_space(10.0);
            for (command, name) in [
                (WindowCommand::Toggle, "Toggle"),
                (WindowCommand::Predict, "Predict"),
                (WindowCommand::Probe, "Probe"),
                (WindowCommand::ProbeAndPredict, "Probe and predict"),
            ] {
                let is_main = command == WindowCommand::ProbeAndPredict;
                let text = if is_main { theme::strong(name).color(palette.on_accent) } else { RichText::new(name) };
                let mut button = Button::new(text).min_size(vec2(72.0, 28.0));
                if is_main {
                    button = button.fill(palette.accent);
                }
                self.command_button(ui, command, button, commands);
            }
            ui.add_space(10.0);
            self.command_button(ui, WindowCommand::Back, Button::new("◀").min_size(vec2(28.0, 28.0)), commands);
            self.crumbs(ui);
            self.command_button(ui, WindowCommand::Forward, Button::new("▶").min_size(vec2(28.0, 28.0)), commands);
            ui.with_layout(Layout::right_to_left(Align::Center), |ui| {
                let theme_sign = if ui.ctx().theme() == Theme::Dark { "☀" } else { "☾" };
                for (command, sign) in
                    [(WindowCommand::Help, "?"), (WindowCommand::Theme, theme_sign), (WindowCommand::Screenshot, "PNG")]
                {
                    self.command_button(ui, command, Button::new(sign).min_size(vec2(28.0, 28.0)), commands);
                }
                self.source(ui, commands);
            });
        });
    }

    /// A button that is disabled while its command has no effect, with the reason as tooltip.
    pub(super) fn command_button(
        &self,
        ui: &mut Ui,
        command: WindowCommand,
        button: Button<'_>,
        commands: &mut Vec<WindowCommand>,
    ) {
        let can = self.can(command);
        let mut all = WindowCommand::ALL.iter().flat_map(|(_, commands)| *commands);
        let (key, what) =
            all.find(|(c, ..)| *c == command).map_or_else(Default::default, |(_, modifiers, key, what)| {
                (WindowCommand::key_name(*modifiers, *key), *what)
            });
        let response = ui.add_enabled(can.is_ok(), button).on_hover_text(format!("{what}  [{key}]"));
        let response = match can {
            Ok(()) => response,
            Err(why) => response.on_disabled_hover_text(why),
        };
        if response.clicked() {
            commands.push(command);
        }
    }

    /// Shows the newest part of the history, up to a few entries after the current one.
    fn crumbs(&mut self, ui: &mut Ui) {
        let history = self.session.history();
        let (place, len) = (history.place(), history.entries().len());
        let right = RIGHT_WIDTH + if self.live.is_some() { LIVE_WIDTH } else { 0.0 };
        let shown = (((ui.available_width() - right) / CRUMB_WIDTH) as usize).clamp(1, CRUMBS);
        let last = (place + 1 + (shown - 1) / 3).min(len).max(len.min(shown));
        let mut chosen = None;
        for i in last.saturating_sub(shown)..last {
            let moment = &history.entries()[i];
            let name = if moment.step == 0 { "now".to_owned() } else { format!("+{}", moment.step) };
            let hover = format!("{}, {}", moment.input.title, steps_ahead(moment.step));
            if ui.selectable_label(i == place, name).on_hover_text(hover).clicked() {
                chosen = Some(i);
            }
        }
        if let Some(place) = chosen {
            self.is_following = false;
            self.session.go_to(place);
        }
    }

    /// Shows the source of images: files, or a running graph.
    fn source(&mut self, ui: &mut Ui, commands: &mut Vec<WindowCommand>) {
        let palette = theme::palette(ui.ctx());
        let live = self.live.as_ref().map(|live| {
            let watched = live.watched();
            (watched.run.name.clone(), watched.joined.is_ok())
        });
        let shown = live.as_ref().map_or_else(|| "files".to_owned(), |(name, _)| name.clone());
        let mut wanted = None;
        ComboBox::from_id_salt("source").selected_text(shown).width(110.0).show_ui(ui, |ui| {
            if ui.selectable_label(live.is_none(), "files").clicked() {
                wanted = Some(None);
            }
            match carff_observe::runs() {
                Ok(runs) if runs.is_empty() => drop(ui.weak("no running graph found")),
                Ok(runs) => {
                    for run in runs {
                        let is_this = live.as_ref().is_some_and(|(name, _)| *name == run.name);
                        let hover = format!("process {}, {}", run.pid, run.graph.display());
                        if ui.selectable_label(is_this, &run.name).on_hover_text(hover).clicked() {
                            wanted = Some(Some(run.name));
                        }
                    }
                }
                Err(error) => drop(ui.colored_label(palette.error, error.to_string())),
            }
        });
        if ui.available_width() > CRUMB_WIDTH + LIVE_WIDTH {
            ui.weak("source");
        }
        if let Some((_, is_joined)) = live {
            let (sign, color) = match (is_joined, self.is_following) {
                (false, _) => ("● ended", palette.error),
                (true, true) => ("● live", palette.clear),
                (true, false) => ("● held", palette.hazard),
            };
            let button = Button::new(theme::strong(sign).color(color)).min_size(vec2(64.0, 28.0));
            self.command_button(ui, WindowCommand::Follow, button, commands);
        }
        match wanted {
            Some(Some(run)) => self.attach(run),
            Some(None) => {
                self.live = None;
                self.is_following = false;
            }
            None => {}
        }
    }

    /// Watches another run.
    fn attach(&mut self, run: String) {
        let waker = self.waker.clone();
        match LiveFeed::attach(Some(run), move || waker.wake_soon()) {
            Ok(feed) => {
                self.other_checkpoint = super::other_checkpoint(&feed, &self.session);
                self.live = Some(feed);
                self.is_following = true;
            }
            Err(error) => self.say(error.to_string(), true),
        }
    }
}
