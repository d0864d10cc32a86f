//! The topics that are sent, and their keys.

use carff_messages::Stage;
use carff_transport::{Run, TopicId, UnknownTopic};

/// Version of the data on the link: ends of different versions do not receive from each other.
const VERSION: u32 = 1;

/// Reads topics from the command line: a name, `health` for all heartbeats, or `all`.
pub fn parse(text: &str) -> Result<Vec<TopicId>, String> {
    match text {
        "all" => Ok(TopicId::all().collect()),
        "health" => Ok(Stage::ALL.map(TopicId::health).to_vec()),
        name => name.parse().map(|topic| vec![topic]).map_err(|error: UnknownTopic| error.to_string()),
    }
}

/// Checks a run's name: it has no character with a meaning in keys.
pub fn run_name(text: &str) -> Result<String, String> {
    Run::new(text, 0).map(|run| run.name().to_owned()).map_err(|error| error.to_string())
}

/// Returns the key of a topic, with the run's name on the sending machine.
pub fn key(run: &str, topic: TopicId) -> String {
    format!("{}{topic}", prefix(run))
}

/// Returns the pattern of the keys of all the run's topics.
pub fn keys(run: &str) -> String {
    format!("{}**", prefix(run))
}

/// Returns the topic of a key.
pub fn of_key(run: &str, key: &str) -> Option<TopicId> {
    let name = key.strip_prefix(&prefix(run))?;
    TopicId::all().find(|topic| topic.name() == name)
}

fn prefix(run: &str) -> String {
    format!("carff/link/{VERSION}/{run}/")
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Each topic's key leads back to it, only in this run; groups hold their topics; an unknown name gets a
    /// suggestion.
    #[test]
    fn keys_and_names_lead_to_topics() {
        for topic in TopicId::all() {
            assert_eq!(of_key("a", &key("a", topic)), Some(topic));
            assert_eq!(of_key("b", &key("a", topic)), None);
        }
        assert_eq!(of_key("a", "carff/link/1/a/prober/beliefs"), None);
        assert_eq!(parse("all").map(|t| t.len()), Ok(TopicId::all().count()));
        assert_eq!(parse("health").map(|t| t.len()), Ok(Stage::ALL.len()));
        assert_eq!(parse("belief"), Ok(vec![TopicId::BELIEF]));
        assert!(run_name("a").is_ok() && run_name("*").is_err() && run_name("a/b").is_err());
        assert!(parse("beleif").is_err_and(|e| e.contains("prober/belief")));
    }
}
