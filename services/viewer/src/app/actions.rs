//! What each command does, and when it has an effect.

use super::{Choice, Viewer, WindowCommand, shots};
use crate::camera::OrbitCamera;
use crate::input::ChosenImage;
use crate::session::Selection;
use carff_dataset::Observability;
use eframe::egui::{self, Context, ViewportCommand};
use std::sync::Arc;

impl Viewer {
    /// Returns an error with the reason if a command would have no effect now.
    pub fn can(&self, command: WindowCommand) -> Result<(), String> {
        let is = |there: bool, why: &str| if there { Ok(()) } else { Err(why.to_owned()) };
        let history = self.session.history();
        match command {
            WindowCommand::Toggle => {
                let any = self.album.is_ok() || self.session.moment().is_some();
                is(any, "no image yet: drop a PNG image here, pass --dataset, or attach to a run")
            }
            WindowCommand::Predict => self.session.can_predict().map_err(|e| e.to_string()),
            WindowCommand::Probe => is(self.session.moment().is_some(), "no image yet: press Toggle"),
            WindowCommand::ProbeAndPredict => self.session.can_advance().map_err(|e| e.to_string()),
            WindowCommand::Back => is(history.has_back(), "this is the beginning"),
            WindowCommand::Forward => is(history.has_forward(), "this is the end"),
            WindowCommand::ImageBefore | WindowCommand::ImageAfter => {
                is(self.album.is_ok(), "no dataset to choose from")
            }
            WindowCommand::Follow => is(self.live.is_some(), "no running graph is attached"),
            WindowCommand::CameraImage => {
                let known = self.session.moment().is_some_and(|m| m.input.camera.is_some());
                is(known, "the camera pose of this image is unknown")
            }
            WindowCommand::SaveView => is(self.view.is_some(), "no scene has been rendered yet"),
            _ => Ok(()),
        }
    }

    /// Runs a command.
    pub fn run(&mut self, command: WindowCommand, ctx: &Context) {
        if let Err(why) = self.can(command) {
            self.say(why, true);
            return;
        }
        let done = match command {
            WindowCommand::Toggle => self.toggle(),
            WindowCommand::Predict => self.predict(),
            WindowCommand::Probe => {
                self.is_following = false;
                self.session.probe().map_err(|e| e.to_string())
            }
            WindowCommand::ProbeAndPredict => {
                self.is_following = false;
                self.session.probe_and_predict().map_err(|e| e.to_string())
            }
            WindowCommand::Back => {
                self.session.back();
                Ok(())
            }
            WindowCommand::Forward => {
                self.session.forward();
                Ok(())
            }
            WindowCommand::SceneBefore => self.select_by(-1),
            WindowCommand::SceneAfter => self.select_by(1),
            WindowCommand::ImageBefore => self.leaf(false),
            WindowCommand::ImageAfter => self.leaf(true),
            WindowCommand::Follow => {
                self.is_following = !self.is_following;
                Ok(())
            }
            WindowCommand::CameraCorner => {
                self.camera = OrbitCamera::over_corner(self.session.models().bounds_m());
                Ok(())
            }
            WindowCommand::CameraAbove => {
                self.camera = OrbitCamera::above(self.session.models().bounds_m());
                Ok(())
            }
            WindowCommand::CameraImage => {
                if let Some(camera) = self.session.moment().and_then(|m| m.input.camera) {
                    let ground_m = self.session.models().bounds_m()[0][2];
                    self.camera = OrbitCamera::from_pinhole(&camera, ground_m);
                }
                Ok(())
            }
            WindowCommand::Boxes => {
                self.overlays.boxes = !self.overlays.boxes;
                Ok(())
            }
            WindowCommand::Densities => {
                self.overlays.densities = !self.overlays.densities;
                Ok(())
            }
            WindowCommand::Screenshot => {
                shots::request(ctx);
                Ok(())
            }
            WindowCommand::SaveView => self.save_view(),
            WindowCommand::Theme => {
                let theme = if ctx.theme() == egui::Theme::Dark { egui::Theme::Light } else { egui::Theme::Dark };
                ctx.set_theme(theme);
                Ok(())
            }
            WindowCommand::Help => {
                self.shows_help = !self.shows_help;
                Ok(())
            }
            WindowCommand::Quit => {
                ctx.send_viewport_cmd(ViewportCommand::Close);
                Ok(())
            }
        };
        if let Err(why) = done {
            self.say(why, true);
        }
    }

    /// Shows the current image's scene, without a forecast. Without a current image, it shows the chosen one's.
    fn toggle(&mut self) -> Result<(), String> {
        if std::mem::take(&mut self.is_following) {
            // The graph supplied the posterior.
            self.session.go_to(0);
            return Ok(());
        }
        match self.session.moment() {
            Some(moment) => self.toggle_input(moment.input.clone()),
            None => self.toggle_chosen(),
        }
    }

    /// Shows the scene of the image that is chosen from the dataset.
    pub(super) fn toggle_chosen(&mut self) -> Result<(), String> {
        let Choice { branch, timestamp, view, .. } = self.choice;
        let none = || format!("the dataset has no image of branch {branch}, t{timestamp}, view {view}");
        let album = self.album.as_ref().map_err(Clone::clone)?;
        let models = self.session.models();
        let state = models.state(branch, timestamp).ok_or_else(none)?;
        let input = album.input(state, view, models).map_err(|e| e.to_string())?.ok_or_else(none)?;
        self.toggle_input(input)
    }

    /// Starts with an image that does not reveal the branch, if the dataset has one.
    pub fn begin(&mut self) {
        if let Ok(album) = &self.album {
            let state = self.session.models().state(0, 0).unwrap_or(0);
            let hidden = album.next_view(state, self.choice.view, true, Some(Observability::None));
            self.choice.view = hidden.unwrap_or(self.choice.view);
            if let Err(why) = self.toggle_chosen() {
                self.say(why, true);
            }
        }
    }

    /// Shows the scene of an image.
    pub fn toggle_input(&mut self, input: Arc<ChosenImage>) -> Result<(), String> {
        self.is_following = false;
        self.session.toggle(input).map_err(|e| e.to_string())
    }

    fn predict(&mut self) -> Result<(), String> {
        if self.is_following {
            self.is_following = false;
            // The graph made these forecasts.
            if self.session.go_to(1) {
                return Ok(());
            }
        }
        self.session.predict().map_err(|e| e.to_string())
    }

    pub(super) fn select(&mut self, selection: Selection) {
        if let Err(error) = self.session.select(selection) {
            self.say(error.to_string(), true);
        }
    }

    fn select_by(&mut self, by: isize) -> Result<(), String> {
        let scenes = self.session.scenes();
        let shown = self.session.moment().map(|m| m.selection);
        let at = scenes.iter().position(|s| Some(s.selection) == shown).unwrap_or(0);
        let Some(scene) = at.checked_add_signed(by).and_then(|at| scenes.get(at)) else { return Ok(()) };
        self.session.select(scene.selection).map_err(|e| e.to_string())
    }

    /// Shows the next image of the dataset with the chosen visibility.
    fn leaf(&mut self, forwards: bool) -> Result<(), String> {
        let Ok(album) = &self.album else { return Ok(()) };
        let Choice { branch, timestamp, view, shows } = self.choice;
        let state = self.session.models().state(branch, timestamp);
        let next = state.and_then(|state| album.next_view(state, view, forwards, shows));
        let none = || {
            let much = shows.map_or("any", Observability::name);
            format!("no view of this state has the chosen visibility of the actor: {much}")
        };
        self.choice.view = next.ok_or_else(none)?;
        self.toggle_chosen()
    }

    fn save_view(&mut self) -> Result<(), String> {
        let Some((image, _)) = &self.view else { return Ok(()) };
        let path = shots::free_name(&self.options.folder, "scene").map_err(|e| e.to_string())?;
        shots::save_image(image, &path).map_err(|e| e.to_string())?;
        self.say(format!("saved {}", path.display()), false);
        Ok(())
    }
}
