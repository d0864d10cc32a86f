//! Commands for mouse and keys: one list for shortcuts and help.

use eframe::egui::{InputState, Key, Modifiers};

/// A command of the window.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum WindowCommand {
    /// Shows the scene of the chosen image's posterior.
    Toggle,
    /// Forecasts one step.
    Predict,
    /// Probes the shown scene.
    Probe,
    /// Probes the shown scene and forecasts from the state that it shows.
    ProbeAndPredict,
    /// Goes back in the history.
    Back,
    /// Goes forward in the history.
    Forward,
    /// Shows the previous scene.
    SceneBefore,
    /// Shows the next scene.
    SceneAfter,
    /// Takes the previous image.
    ImageBefore,
    /// Takes the next image.
    ImageAfter,
    /// Follows the running graph, or holds its frame.
    Follow,
    /// Looks from above a corner.
    CameraCorner,
    /// Looks straight down.
    CameraAbove,
    /// Looks from the pose of the image.
    CameraImage,
    /// Shows or hides the probed boxes.
    Boxes,
    /// Shows or hides the densities in the boxes.
    Densities,
    /// Saves the window as an image.
    Screenshot,
    /// Saves the scene as an image.
    SaveView,
    /// Switches between dark and light.
    Theme,
    /// Shows or hides the help.
    Help,
    /// Closes the window.
    Quit,
}

/// A command with its key and its help text.
pub type Shortcut = (WindowCommand, Modifiers, Key, &'static str);

impl WindowCommand {
    /// All commands with keys and help texts, by topic, in the order of the help.
    pub const ALL: [(&'static str, &'static [Shortcut]); 4] = [
        (
            "Look ahead",
            &[
                (Self::Toggle, Modifiers::NONE, Key::T, "Toggle: show the scene of the image"),
                (Self::Predict, Modifiers::NONE, Key::P, "Predict: forecast one step, or redraw it"),
                (Self::Probe, Modifiers::NONE, Key::O, "Probe: occupancy of each place, and the belief"),
                (Self::ProbeAndPredict, Modifiers::NONE, Key::N, "Probe and predict: continue from the shown scene"),
                (Self::Back, Modifiers::NONE, Key::OpenBracket, "Back in the history"),
                (Self::Forward, Modifiers::NONE, Key::CloseBracket, "Forward in the history"),
            ],
        ),
        (
            "Choose",
            &[
                (Self::SceneBefore, Modifiers::NONE, Key::ArrowLeft, "Previous scene"),
                (Self::SceneAfter, Modifiers::NONE, Key::ArrowRight, "Next scene"),
                (Self::ImageBefore, Modifiers::NONE, Key::PageUp, "Previous image"),
                (Self::ImageAfter, Modifiers::NONE, Key::PageDown, "Next image"),
                (Self::Follow, Modifiers::NONE, Key::Space, "Follow the running graph, or hold its frame"),
            ],
        ),
        (
            "View",
            &[
                (Self::CameraCorner, Modifiers::NONE, Key::Num1, "Look from above a corner"),
                (Self::CameraAbove, Modifiers::NONE, Key::Num2, "Look straight down"),
                (Self::CameraImage, Modifiers::NONE, Key::Num3, "Look from the image's pose"),
                (Self::Boxes, Modifiers::NONE, Key::B, "Probed boxes"),
                (Self::Densities, Modifiers::NONE, Key::D, "Densities in the boxes"),
            ],
        ),
        (
            "Window",
            &[
                (Self::Screenshot, Modifiers::NONE, Key::S, "Save the window as PNG"),
                (Self::SaveView, Modifiers::SHIFT, Key::S, "Save the scene as PNG"),
                (Self::Theme, Modifiers::NONE, Key::L, "Dark or light"),
                (Self::Help, Modifiers::NONE, Key::F1, "This help"),
                (Self::Quit, Modifiers::CTRL, Key::Q, "End"),
            ],
        ),
    ];

    /// Returns the name of a key for the help.
    pub fn key_name(modifiers: Modifiers, key: Key) -> String {
        let name = match key {
            Key::OpenBracket => "[",
            Key::CloseBracket => "]",
            Key::ArrowLeft => "←",
            Key::ArrowRight => "→",
            other => other.name(),
        };
        let held = [(modifiers.ctrl, "Ctrl+"), (modifiers.shift, "Shift+")];
        held.iter().filter(|(is_held, _)| *is_held).map(|(_, held)| *held).chain([name]).collect()
    }

    /// Returns the commands whose keys were pressed.
    pub fn pressed(input: &mut InputState) -> Vec<Self> {
        let all = Self::ALL.iter().flat_map(|(_, commands)| *commands);
        // Keys with modifiers come first: plain keys also match while Shift is held.
        let (held, plain): (Vec<_>, Vec<_>) = all.partition(|(_, modifiers, ..)| modifiers.any());
        let mut pressed: Vec<Self> = held
            .into_iter()
            .chain(plain)
            .filter(|(_, modifiers, key, _)| input.consume_key(*modifiers, *key))
            .map(|(command, ..)| command)
            .collect();
        if input.consume_key(Modifiers::NONE, Key::Enter) {
            pressed.push(Self::ProbeAndPredict);
        }
        pressed
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeSet;

    /// Every command has its own key, and every key has a name.
    #[test]
    fn keys_are_unique() {
        let all: Vec<_> = WindowCommand::ALL.iter().flat_map(|(_, commands)| *commands).collect();
        let keys: BTreeSet<String> = all.iter().map(|(_, m, k, _)| WindowCommand::key_name(*m, *k)).collect();
        assert_eq!(keys.len(), all.len());
        assert!(keys.contains("Ctrl+Q") && keys.contains("Shift+S") && keys.contains("["));
    }
}
