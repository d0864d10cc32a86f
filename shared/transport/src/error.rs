//! One flat error for each operation.

use carff_messages::Invalid;
use std::path::PathBuf;

/// Why a name cannot be a run's.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("`{name}` is not a run name: give 1 to 24 characters out of a-z, A-Z, 0-9, `-` and `_`")]
pub struct RunNameError {
    /// What was given.
    pub name: String,
}

/// Why a node or a port could not be opened.
#[derive(Debug, thiserror::Error)]
pub enum OpenError {
    /// A folder that shared memory needs is missing or not writable.
    #[error("{path} is not writable ({source}): shared memory between the stages needs it; check its owner and mode")]
    NotWritable {
        /// Which folder.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// Not enough room. Going on would end in SIGBUS.
    #[error(
        "{path} has {free_bytes} bytes free and {needed_bytes} are needed for {what}: free some, or make it larger \
         (a container has 64 MB by default: start it with --shm-size=256m)"
    )]
    SharedMemoryFull {
        /// Which folder.
        path: PathBuf,
        /// For what.
        what: String,
        /// Bytes needed.
        needed_bytes: u64,
        /// Bytes free.
        free_bytes: u64,
    },
    /// The node could not be created.
    #[error("cannot join run `{run}`: {cause}; if its folder {path} belongs to another user, take another run name")]
    Node {
        /// The run.
        run: String,
        /// The run's folder.
        path: PathBuf,
        /// What iceoryx2 said.
        cause: String,
    },
    /// Another process already has the topic open with other types or limits.
    #[error("topic `{topic}` exists with another layout or other limits ({cause}): stop the older build that runs")]
    Incompatible {
        /// The topic.
        topic: String,
        /// What iceoryx2 said.
        cause: String,
    },
    /// All slots of the topic are taken.
    #[error("all {max} {what} of topic `{topic}` are taken: stop a probe or a viewer, or another publisher of it")]
    TooMany {
        /// The topic.
        topic: String,
        /// What there are too many of.
        what: &'static str,
        /// How many there can be.
        max: usize,
    },
    /// Anything else.
    #[error("cannot open topic `{topic}`: {cause}")]
    Topic {
        /// The topic.
        topic: String,
        /// What iceoryx2 said.
        cause: String,
    },
}

/// Why a message was not sent.
#[derive(Debug, thiserror::Error)]
pub enum SendError {
    /// The sender built a message that its receivers would drop.
    #[error("refused to send an invalid message on `{topic}`: {source}")]
    Invalid {
        /// The topic.
        topic: String,
        /// Which field.
        source: Invalid,
    },
    /// The slice is longer than what the publisher was opened for, or has another size than its description says.
    #[error("an image of {found} bytes on `{topic}`, which was opened for at most {max}")]
    Size {
        /// The topic.
        topic: String,
        /// Bytes asked for.
        found: usize,
        /// Bytes possible.
        max: usize,
    },
    /// No memory to write into, or the connection is broken.
    #[error("cannot send on `{topic}`: {cause}")]
    Failed {
        /// The topic.
        topic: String,
        /// What iceoryx2 said.
        cause: String,
    },
}

/// Why receiving failed. A message that is not valid is no error: it is dropped and counted.
#[derive(Debug, thiserror::Error)]
#[error("cannot receive on `{topic}`: {cause}")]
pub struct ReceiveError {
    /// The topic.
    pub topic: String,
    /// What iceoryx2 said.
    pub cause: String,
}

/// Why waiting failed.
#[derive(Debug, thiserror::Error)]
pub enum WaitError {
    /// The system refused to wait.
    #[error("cannot wait for input: {0}")]
    Poll(#[from] std::io::Error),
    /// An input failed.
    #[error(transparent)]
    Receive(#[from] ReceiveError),
}

/// Why cleaning up failed.
#[derive(Debug, thiserror::Error)]
pub enum CleanupError {
    /// A file could not be listed or removed.
    #[error("cannot remove {path} ({source}): remove it by hand")]
    Remove {
        /// Which file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The run's nodes could not be listed.
    #[error("cannot list the processes of run `{run}`: {cause}")]
    List {
        /// The run.
        run: String,
        /// What iceoryx2 said.
        cause: String,
    },
}
