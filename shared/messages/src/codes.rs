//! Codes: numbers that represent names, with checked conversion.

use crate::Invalid;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

macro_rules! codes {
    ($(#[$doc:meta])* $name:ident: $repr:ty, $field:literal { $($(#[$vdoc:meta])* $variant:ident = $code:literal $text:literal),+ $(,)? }) => {
        $(#[$doc])*
        #[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
        pub enum $name { $($(#[$vdoc])* $variant),+ }

        impl $name {
            /// All values in the order of their declaration.
            pub const ALL: [Self; [$($code),+].len()] = [$(Self::$variant),+];

            /// Returns the number in messages.
            pub const fn code(self) -> $repr {
                match self { $(Self::$variant => $code),+ }
            }

            /// Returns the value of a name, if there is one.
            pub fn from_name(name: &str) -> Option<Self> {
                Self::ALL.into_iter().find(|known| known.name() == name)
            }

            /// Returns all names, separated by commas.
            pub(crate) fn names() -> String {
                Self::ALL.map(Self::name).join(", ")
            }

            /// Returns the name in reports and logs.
            pub const fn name(self) -> &'static str {
                match self { $(Self::$variant => $text),+ }
            }
        }

        impl TryFrom<$repr> for $name {
            type Error = Invalid;
            fn try_from(code: $repr) -> Result<Self, Invalid> {
                match code {
                    $($code => Ok(Self::$variant),)+
                    _ => Err(Invalid::UnknownCode { field: $field, code: i64::from(code) }),
                }
            }
        }

        impl std::fmt::Display for $name {
            fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                f.pad(self.name())
            }
        }
    };
}

codes! {
    /// The stages of the graph, in the order of the data flow.
    #[derive(Serialize, Deserialize)]
    #[serde(rename_all = "lowercase")]
    Stage: u32, "stage" {
        /// Replays or takes images.
        Camera = 1 "camera",
        /// Image to posterior.
        Encoder = 2 "encoder",
        /// Posterior to mixture and samples.
        Forecaster = 3 "forecaster",
        /// Samples to belief over states.
        Prober = 4 "prober",
        /// Samples to images.
        Renderer = 5 "renderer",
        /// Belief to action.
        Controller = 6 "controller",
    }
}

impl Stage {
    /// Order in which the stages start: receivers before their senders, the camera last.
    pub const START_ORDER: [Self; 6] =
        [Self::Controller, Self::Renderer, Self::Prober, Self::Forecaster, Self::Encoder, Self::Camera];
}

codes! {
    /// Action of the vehicle.
    ActionCode: u32, "action" {
        /// Stop, or stay stopped: the safe action.
        Halt = 0 "halt",
        /// Drive on the planned path.
        Advance = 1 "advance",
        /// Drive on slowly enough to stop before the place where others drive.
        Creep = 2 "creep",
    }
}

impl ActionCode {
    /// Returns true for the safe action, `halt`: the vehicle stops, or stays where it is.
    pub fn is_safe(self) -> bool {
        self == Self::Halt
    }
}

codes! {
    /// Reason of an action.
    Reason: u32, "reason" {
        /// A fresh, valid, complete belief.
        Belief = 0 "belief",
        /// No belief has arrived yet.
        NoBeliefYet = 1 "no belief yet",
        /// The last belief is older than the deadline.
        StaleBelief = 2 "stale belief",
        /// The last belief was not valid.
        InvalidBelief = 3 "invalid belief",
        /// Steps of the frame's belief are missing.
        IncompleteBelief = 4 "incomplete belief",
        /// Beliefs contradict each other or the clock.
        ContradictoryBelief = 5 "contradictory belief",
        /// The controller is ending.
        Stopping = 6 "stopping",
        /// The image is black.
        BlackImage = 7 "black image",
        /// The image is white.
        WhiteImage = 8 "white image",
        /// The camera repeats an image while time passes.
        FrozenImage = 9 "frozen image",
        /// Part of the lens is covered.
        CoveredLens = 10 "covered lens",
        /// The image is out of focus.
        Unfocused = 11 "out of focus",
        /// The image is underexposed.
        Underexposed = 12 "underexposed",
        /// The image is overexposed.
        Overexposed = 13 "overexposed",
        /// The camera's pose is missing or not a pose, so its image cannot be compared with the known states.
        NoPose = 14 "no pose",
        /// The lens has another field of view than the trained one.
        AnotherLens = 15 "another lens",
        /// The camera's capture times stand still or run backwards.
        CameraClock = 16 "camera clock",
    }
}

codes! {
    /// Condition of a camera image. A decision rests only on a usable image.
    ImageCondition: u32, "condition" {
        /// Nothing speaks against the image.
        Usable = 0 "usable",
        /// Black.
        Black = 1 "black",
        /// White.
        White = 2 "white",
        /// The same image as before, beyond the sensor's noise, while time passes.
        Frozen = 3 "frozen",
        /// A part of the lens is covered.
        Covered = 4 "covered",
        /// Out of focus.
        Unfocused = 5 "out of focus",
        /// Too dark.
        Underexposed = 6 "underexposed",
        /// Too bright.
        Overexposed = 7 "overexposed",
        /// The camera's pose is missing or not a pose.
        NoPose = 8 "no pose",
        /// Another field of view than the trained one.
        AnotherLens = 9 "another lens",
        /// Capture times stand still or run backwards.
        Clock = 10 "camera clock",
    }
}

impl ImageCondition {
    /// Returns the reason of the safe action; `None` for a usable image.
    pub const fn reason(self) -> Option<Reason> {
        Some(match self {
            Self::Usable => return None,
            Self::Black => Reason::BlackImage,
            Self::White => Reason::WhiteImage,
            Self::Frozen => Reason::FrozenImage,
            Self::Covered => Reason::CoveredLens,
            Self::Unfocused => Reason::Unfocused,
            Self::Underexposed => Reason::Underexposed,
            Self::Overexposed => Reason::Overexposed,
            Self::NoPose => Reason::NoPose,
            Self::AnotherLens => Reason::AnotherLens,
            Self::Clock => Reason::CameraClock,
        })
    }
}

codes! {
    /// A decision rule (paper section 4.3).
    #[derive(Default, Serialize, Deserialize, JsonSchema)]
    #[serde(rename_all = "kebab-case")]
    Rule: u32, "rule" {
        /// Always halt: a planner that only trusts visible free space.
        Underconfident = 0 "underconfident",
        /// Always advance: a planner that only believes visible actors.
        Overconfident = 1 "overconfident",
        /// Halt if the samples disagree or any of them shows the hazard.
        Paper = 2 "paper",
        /// Halt if the hazard probability reaches the threshold.
        #[default]
        Calibrated = 3 "calibrated",
    }
}

codes! {
    /// Source of a forecast.
    ForecastSource: u32, "source" {
        /// The posterior of a camera image.
        Observed = 0 "observed",
        /// The posterior of the state that probing resolved.
        Probed = 1 "probed",
    }
}

codes! {
    /// The share of the dynamic actor, or of the place where it would be, that an image shows.
    #[derive(Serialize, Deserialize, JsonSchema)]
    #[serde(rename_all = "lowercase")]
    Observability: i32, "observability" {
        /// Fully visible: at least 75 % of its pixels, and at least 12.
        Full = 2 "full",
        /// Visible in part.
        Partial = 1 "partial",
        /// Hidden: at most 2 % of its pixels show.
        None = 0 "none",
    }
}

impl Observability {
    /// The code that stands for an observability that is not known.
    pub const UNKNOWN: i32 = -1;

    /// Returns the code of a known or unknown observability.
    pub fn code_of(observability: Option<Self>) -> i32 {
        observability.map_or(Self::UNKNOWN, Self::code)
    }

    /// Returns the observability of a code, `None` where it is not known; an error for a code without a meaning.
    pub fn of_code(code: i32) -> Result<Option<Self>, Invalid> {
        if code == Self::UNKNOWN { Ok(None) } else { Self::try_from(code).map(Some) }
    }
}

codes! {
    /// Camera of a rendered view.
    ViewKind: u32, "kind" {
        /// From above.
        BirdsEye = 0 "birds-eye",
        /// Any other camera.
        Free = 1 "free",
    }
}

codes! {
    /// State of a stage's health.
    HealthState: u32, "state" {
        /// Loading.
        Starting = 0 "starting",
        /// Ready or working.
        Ok = 1 "ok",
        /// Working, but slower than its deadline.
        Slow = 2 "slow",
        /// Its input has been quiet for longer than the topic's deadline.
        Stale = 3 "stale",
        /// The stage reports its own error.
        Faulty = 4 "faulty",
        /// The process died, and the launcher restarts it.
        Restarting = 5 "restarting",
        /// The process died and is not restarted.
        Lost = 6 "lost",
        /// The work is complete, and the stage ends.
        Done = 7 "done",
    }
}
