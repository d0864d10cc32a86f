//! Numbers that stand for names, with checked conversion.

use crate::Invalid;

macro_rules! codes {
    ($(#[$doc:meta])* $name:ident: $repr:ty, $field:literal { $($(#[$vdoc:meta])* $variant:ident = $code:literal $text:literal),+ $(,)? }) => {
        $(#[$doc])*
        #[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
        pub enum $name { $($(#[$vdoc])* $variant),+ }

        impl $name {
            /// All of them, in the order of their codes.
            pub const ALL: &[Self] = &[$(Self::$variant),+];

            /// The number that travels.
            pub const fn code(self) -> $repr {
                match self { $(Self::$variant => $code),+ }
            }

            /// The name in reports and logs.
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
    /// The stages of the graph, in the order in which they start: consumers before what feeds them.
    Stage: u32, "stage" {
        /// Replays or takes pictures.
        Camera = 1 "camera",
        /// Picture to posterior.
        Encoder = 2 "encoder",
        /// Posterior to mixture and samples.
        Forecaster = 3 "forecaster",
        /// Samples to belief over states.
        Prober = 4 "prober",
        /// Samples to pictures.
        Renderer = 5 "renderer",
        /// Belief to action.
        Controller = 6 "controller",
    }
}

codes! {
    /// What the car does.
    ActionCode: u32, "action" {
        /// Stop, or stay where it is: the safe action.
        Halt = 0 "halt",
        /// Go on.
        Advance = 1 "advance",
    }
}

codes! {
    /// Why an action was taken.
    Reason: u32, "reason" {
        /// A fresh, valid, complete belief said so.
        Belief = 0 "belief",
        /// No belief has arrived yet.
        NoBeliefYet = 1 "no belief yet",
        /// The last belief is older than the deadline.
        StaleBelief = 2 "stale belief",
        /// The belief that arrived was not valid.
        InvalidBelief = 3 "invalid belief",
        /// Steps of the frame's belief are missing.
        IncompleteBelief = 4 "incomplete belief",
        /// Beliefs contradict each other or the clock.
        ContradictoryBelief = 5 "contradictory belief",
        /// The controller ends.
        Stopping = 6 "stopping",
    }
}

codes! {
    /// The decision rule in force.
    RuleCode: u32, "rule" {
        /// Always halt.
        Underconfident = 0 "underconfident",
        /// Always advance.
        Overconfident = 1 "overconfident",
        /// Halt when samples disagree or show the actor.
        Paper = 2 "paper",
        /// Halt when the hazard probability reaches a calibrated threshold.
        Calibrated = 3 "calibrated",
    }
}

codes! {
    /// What a forecast was made from.
    ForecastSource: u32, "source" {
        /// The posterior of a camera picture.
        Observed = 0 "observed",
        /// The posterior of the state that probing resolved.
        Probed = 1 "probed",
    }
}

codes! {
    /// How much of the dynamic actor, or of the place where it would be, a picture shows.
    Observability: i32, "observability" {
        /// Not in the data set.
        Unknown = -1 "unknown",
        /// Hidden.
        None = 0 "none",
        /// In part.
        Partial = 1 "partial",
        /// Fully.
        Full = 2 "full",
    }
}

codes! {
    /// What camera a rendered view is seen from.
    ViewKind: u32, "kind" {
        /// From above.
        BirdsEye = 0 "birds-eye",
        /// Any other camera.
        Free = 1 "free",
    }
}

codes! {
    /// How a stage is doing.
    HealthState: u32, "state" {
        /// Loading.
        Starting = 0 "starting",
        /// Ready or working.
        Ok = 1 "ok",
        /// Works, but takes longer than its deadline.
        Slow = 2 "slow",
        /// Its input has been quiet for longer than the topic's deadline.
        Stale = 3 "stale",
        /// It reports an error of its own.
        Faulty = 4 "faulty",
        /// Died, and the launcher starts it again.
        Restarting = 5 "restarting",
        /// Died for good.
        Lost = 6 "lost",
        /// Has done its work and ends.
        Done = 7 "done",
    }
}
