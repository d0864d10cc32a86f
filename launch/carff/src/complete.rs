//! Values that shells complete: runs and topics.

use carff_observe::attach;
use carff_transport::TopicId;
use clap_complete::engine::CompletionCandidate;

/// Returns the living runs.
pub(crate) fn runs() -> Vec<CompletionCandidate> {
    carff_observe::runs().unwrap_or_default().into_iter().map(|run| CompletionCandidate::new(run.name)).collect()
}

/// Returns the topics of the graph.
pub(crate) fn graph_topics() -> Vec<CompletionCandidate> {
    TopicId::all().map(|topic| CompletionCandidate::new(topic.name())).collect()
}

/// Returns the topics of the graph, and those that other stages of the only living run have open.
pub(crate) fn topics() -> Vec<CompletionCandidate> {
    let attached = attach(None, "completion").ok();
    let open = attached.and_then(|attached| attached.node.open_topics().ok()).unwrap_or_default();
    let others = open.into_iter().filter(|topic| topic.name.parse::<TopicId>().is_err());
    graph_topics().into_iter().chain(others.map(|topic| CompletionCandidate::new(topic.name))).collect()
}
