//! The graph's topics by name.

use carff_messages::Stage;
use carff_transport::{Node, OpenError, Ports, topics};
use std::fmt;
use std::str::FromStr;

/// A topic of the graph.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum TopicId {
    /// `camera/frame`.
    Frame,
    /// `encoder/posterior`.
    Posterior,
    /// `forecaster/forecast`.
    Forecast,
    /// `prober/belief`.
    Belief,
    /// `renderer/view`.
    View,
    /// `controller/action`.
    Action,
    /// `health/<stage>`.
    Health(Stage),
}

/// A name that no topic has.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("there is no topic `{name}`{}. All: {}", carff_nearest::hint(name, TopicId::all().map(TopicId::name)), all_names())]
pub struct UnknownTopic {
    /// What was asked for.
    pub name: String,
}

fn all_names() -> String {
    TopicId::all().map(TopicId::name).collect::<Vec<_>>().join(", ")
}

impl TopicId {
    /// The topics of the data's way, in its order.
    pub const FLOW: [Self; 6] = [Self::Frame, Self::Posterior, Self::Forecast, Self::Belief, Self::View, Self::Action];

    /// All topics.
    pub fn all() -> impl Iterator<Item = Self> {
        Self::FLOW.into_iter().chain(Stage::ALL.iter().map(|&stage| Self::Health(stage)))
    }

    /// The topic that a stage's results go out on.
    pub fn of_stage(stage: Stage) -> Self {
        match stage {
            Stage::Camera => Self::Frame,
            Stage::Encoder => Self::Posterior,
            Stage::Forecaster => Self::Forecast,
            Stage::Prober => Self::Belief,
            Stage::Renderer => Self::View,
            Stage::Controller => Self::Action,
        }
    }

    /// The name within the run.
    pub fn name(self) -> &'static str {
        match self {
            Self::Frame => topics::FRAME.name,
            Self::Posterior => topics::POSTERIOR.name,
            Self::Forecast => topics::FORECAST.name,
            Self::Belief => topics::BELIEF.name,
            Self::View => topics::VIEW.name,
            Self::Action => topics::ACTION.name,
            Self::Health(stage) => topics::health(stage).name,
        }
    }

    /// Who sends on it and who receives from it, now.
    pub fn ports(self, node: &Node) -> Result<Ports, OpenError> {
        match self {
            Self::Frame => node.picture_ports(&topics::FRAME),
            Self::Posterior => node.ports(&topics::POSTERIOR),
            Self::Forecast => node.ports(&topics::FORECAST),
            Self::Belief => node.ports(&topics::BELIEF),
            Self::View => node.picture_ports(&topics::VIEW),
            Self::Action => node.ports(&topics::ACTION),
            Self::Health(stage) => node.ports(&topics::health(stage)),
        }
    }
}

impl fmt::Display for TopicId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.name())
    }
}

impl FromStr for TopicId {
    type Err = UnknownTopic;

    /// A topic's name in full, or its last part alone (`belief`) where that tells.
    fn from_str(name: &str) -> Result<Self, UnknownTopic> {
        let last = |topic: &Self| topic.name().rsplit('/').next().unwrap_or_default();
        let by_name = Self::all().find(|t| t.name() == name);
        if let Some(topic) = by_name.or_else(|| Self::FLOW.into_iter().find(|t| last(t) == name)) {
            return Ok(topic);
        }
        Err(UnknownTopic { name: name.to_owned() })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Every name leads back to its topic, the last part of the data's topics too; a slip is told the nearest.
    #[test]
    fn names_lead_to_topics() {
        for topic in TopicId::all() {
            assert_eq!(topic.name().parse(), Ok(topic));
        }
        assert_eq!("belief".parse(), Ok(TopicId::Belief));
        let told = |name: &str| name.parse::<TopicId>().unwrap_err().to_string();
        assert!(told("beleif").contains("did you mean `prober/belief`?"), "{}", told("beleif"));
        assert!(told("health/rendrer").contains("did you mean `health/renderer`?"), "{}", told("health/rendrer"));
    }
}
