//! What can be pressed, by mouse or key: one list, for shortcuts and help alike.

use eframe::egui::{InputState, Key, KeyboardShortcut, Modifiers};

/// What the window can be told to do.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Command {
    /// The scene of the chosen image's posterior.
    Toggle,
    /// Forecast one step.
    Predict,
    /// Probe the shown scene.
    Probe,
    /// Probe the shown scene, and forecast from the state that it shows.
    ProbeAndPredict,
    /// Back in the history.
    Back,
    /// Forward in the history.
    Forward,
    /// Show the scene before this one.
    SceneBefore,
    /// Show the scene after this one.
    SceneAfter,
    /// Take the image before this one.
    PictureBefore,
    /// Take the image after this one.
    PictureAfter,
    /// Follow the running graph, or hold its frame.
    Follow,
    /// Look from over a corner.
    CameraCorner,
    /// Look straight down.
    CameraAbove,
    /// Look from where the image was taken.
    CameraPicture,
    /// Show or hide the boxes that are probed.
    Boxes,
    /// Show or hide the densities found in them.
    Densities,
    /// Save the window as an image.
    Screenshot,
    /// Save the scene as an image.
    SaveView,
    /// Dark or light.
    Theme,
    /// Show or hide the help.
    Help,
    /// End.
    Quit,
}

/// A command with its key, and what the help says of it.
pub type Entry = (Command, Modifiers, Key, &'static str);

impl Command {
    /// All of them with their keys and what they do, by topic, in the order of the help.
    pub const ALL: [(&'static str, &'static [Entry]); 4] = [
        (
            "Look ahead",
            &[
                (Self::Toggle, Modifiers::NONE, Key::T, "Toggle: the scene that the image stands for"),
                (Self::Predict, Modifiers::NONE, Key::P, "Predict: forecast one step, or draw it again"),
                (Self::Probe, Modifiers::NONE, Key::O, "Probe: what stands where, and the belief"),
                (Self::ProbeAndPredict, Modifiers::NONE, Key::N, "Probe and predict: go on from the shown scene"),
                (Self::Back, Modifiers::NONE, Key::OpenBracket, "Back in the history"),
                (Self::Forward, Modifiers::NONE, Key::CloseBracket, "Forward in the history"),
            ],
        ),
        (
            "Choose",
            &[
                (Self::SceneBefore, Modifiers::NONE, Key::ArrowLeft, "Scene before"),
                (Self::SceneAfter, Modifiers::NONE, Key::ArrowRight, "Scene after"),
                (Self::PictureBefore, Modifiers::NONE, Key::PageUp, "Picture before"),
                (Self::PictureAfter, Modifiers::NONE, Key::PageDown, "Picture after"),
                (Self::Follow, Modifiers::NONE, Key::Space, "Follow the running graph, or hold its frame"),
            ],
        ),
        (
            "View",
            &[
                (Self::CameraCorner, Modifiers::NONE, Key::Num1, "Look from over a corner"),
                (Self::CameraAbove, Modifiers::NONE, Key::Num2, "Look straight down"),
                (Self::CameraPicture, Modifiers::NONE, Key::Num3, "Look from where the image was taken"),
                (Self::Boxes, Modifiers::NONE, Key::B, "Boxes that are probed"),
                (Self::Densities, Modifiers::NONE, Key::D, "Densities found in them"),
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

    /// The key that does it.
    pub fn shortcut(self) -> Option<KeyboardShortcut> {
        let mut all = Self::ALL.iter().flat_map(|(_, commands)| *commands);
        all.find(|(command, ..)| *command == self).map(|(_, modifiers, key, _)| KeyboardShortcut::new(*modifiers, *key))
    }

    /// What a key is called in the help.
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

    /// The commands whose keys were pressed.
    pub fn pressed(input: &mut InputState) -> Vec<Self> {
        let all = Self::ALL.iter().flat_map(|(_, commands)| *commands);
        // With modifiers first: plain keys also match with Shift held.
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

    /// Every command has one key of its own, and every key has a name.
    #[test]
    fn keys_are_unique() {
        let all: Vec<_> = Command::ALL.iter().flat_map(|(_, commands)| *commands).collect();
        let keys: BTreeSet<String> = all.iter().map(|(_, m, k, _)| Command::key_name(*m, *k)).collect();
        assert_eq!(keys.len(), all.len());
        assert!(keys.contains("Ctrl+Q") && keys.contains("Shift+S") && keys.contains("["));
        for (command, modifiers, key, _) in all {
            assert_eq!(command.shortcut(), Some(KeyboardShortcut::new(*modifiers, *key)));
        }
    }
}
