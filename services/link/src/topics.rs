//! Which topics cross, and under which key.

use carff_messages::Stage;
use carff_transport::TopicId;
use carff_transport::Run;

/// Version of what crosses: ends of different versions do not hear each other.
const VERSION: u32 = 1;

/// Topics as they are named on the command line: a name, `health` for all heartbeats, `all` for all there are.
pub fn parse(text: &str) -> Result<Vec<TopicId>, String> {
    match text {
        "all" => Ok(TopicId::all().collect()),
        "health" => Ok(Stage::ALL.iter().map(|&stage| TopicId::health(stage)).collect()),
        name => name.parse().map(|topic| vec![topic]).map_err(|error: carff_observe::UnknownTopic| error.to_string()),
    }
}

/// A run's name: nothing that a key would be read otherwise for.
pub fn run_name(text: &str) -> Result<String, String> {
    Run::new(text, 0).map(|run| run.name().to_owned()).map_err(|error| error.to_string())
}

/// The key of a topic of the run that has this name where it is sent from.
pub fn key(run: &str, topic: TopicId) -> String {
    format!("{}{topic}", prefix(run))
}

/// The keys of all its topics.
pub fn keys(run: &str) -> String {
    format!("{}**", prefix(run))
}

/// The topic of a key.
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

    /// Each topic's key leads back to it, in this run alone; groups stand for what they say, a slip is told the nearest.
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
