//! Errors: one type per operation.

use carff_messages::Invalid;
use std::path::PathBuf;

/// Reason why a name is not valid for a run.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("`{name}` is not a run name: use 1 to 24 characters from a-z, A-Z, 0-9, `-` and `_`")]
pub struct RunNameError {
    /// The invalid name.
    pub name: String,
}

/// Reason why a node or a port could not be opened.
#[derive(Debug, thiserror::Error)]
pub enum OpenError {
    /// A folder that shared memory needs is missing or not writable.
    #[error("{path} is not writable ({source}): shared memory between the stages needs it; check its owner and mode")]
    NotWritable {
        /// Path of the folder.
        path: PathBuf,
        /// Error of the system.
        source: std::io::Error,
    },
    /// Shared memory has not enough free space. Continuing would end in SIGBUS.
    #[error(
        "{path} has {free_bytes} bytes free and {needed_bytes} are needed for {what}: free some space, or enlarge it \
         (a container has 64 MB by default: start it with --shm-size=256m)"
    )]
    SharedMemoryFull {
        /// Path of the folder.
        path: PathBuf,
        /// Purpose of the memory.
        what: String,
        /// Number of bytes needed.
        needed_bytes: u64,
        /// Number of bytes free.
        free_bytes: u64,
    },
    /// The process may open too few files.
    #[error(
        "this process may open {limit} files, and a graph needs up to {needed}: raise the limit (`ulimit -n {needed}`, \
         or LimitNOFILE= of the systemd unit)"
    )]
    OpenFiles {
        /// Number of files that the process may open.
        limit: u64,
        /// Number of files that a process of a graph needs.
        needed: u64,
    },
    /// The node could not be created.
    #[error("cannot join run `{run}`: {cause}; if its folder {path} belongs to another user, use another run name")]
    Node {
        /// Name of the run.
        run: String,
        /// Path of the run's folder.
        path: PathBuf,
        /// Error of iceoryx2.
        cause: String,
    },
    /// Another process already has the topic open with other types or limits.
    #[error("topic `{topic}` exists with another layout or other limits ({cause}): stop the other build's processes")]
    Incompatible {
        /// Name of the topic.
        topic: String,
        /// Error of iceoryx2.
        cause: String,
    },
    /// All slots of the topic are in use.
    #[error("all {max} {what} of topic `{topic}` are in use: stop a probe or a viewer, or another publisher of it")]
    TooMany {
        /// Name of the topic.
        topic: String,
        /// Kind of slot.
        what: &'static str,
        /// Number of slots.
        max: usize,
    },
    /// Any other error.
    #[error("cannot open topic `{topic}`: {cause}; `carff doctor` checks what shared memory needs")]
    Topic {
        /// Name of the topic.
        topic: String,
        /// Error of iceoryx2.
        cause: String,
    },
}

/// Reason why a message was not sent.
#[derive(Debug, thiserror::Error)]
pub enum SendError {
    /// The sender built an invalid message, which receivers would drop.
    #[error("refused to send an invalid message on `{topic}`: {source}; correct this field where the message is made")]
    Invalid {
        /// Name of the topic.
        topic: String,
        /// The invalid field.
        source: Invalid,
    },
    /// The image exceeds the publisher's limit, or its size does not match its description.
    #[error(
        "an image of {found} bytes on `{topic}`, which was opened for at most {max}: open it for the largest image"
    )]
    Size {
        /// Name of the topic.
        topic: String,
        /// Number of bytes of the image.
        found: usize,
        /// Maximum number of bytes.
        max: usize,
    },
    /// No memory is available, or the connection is broken.
    #[error(
        "cannot send on `{topic}`: {cause}; if shared memory is full, free some (`carff doctor`), else restart this \
         process"
    )]
    Failed {
        /// Name of the topic.
        topic: String,
        /// Error of iceoryx2.
        cause: String,
    },
}

/// Reason why receiving failed. An invalid message is not an error: it is dropped and counted.
#[derive(Debug, thiserror::Error)]
#[error("cannot receive on `{topic}`: {cause}; restart this process, and check shared memory with `carff doctor`")]
pub struct ReceiveError {
    /// Name of the topic.
    pub topic: String,
    /// Error of iceoryx2.
    pub cause: String,
}

/// Reason why waiting failed.
#[derive(Debug, thiserror::Error)]
pub enum WaitError {
    /// The system reported an error.
    #[error("cannot wait for input: {0}; restart this process, and check its limits with `carff doctor`")]
    Poll(#[from] std::io::Error),
    /// Receiving from an input failed.
    #[error(transparent)]
    Receive(#[from] ReceiveError),
}

/// Reason why cleaning up failed.
#[derive(Debug, thiserror::Error)]
pub enum CleanupError {
    /// A file could not be listed or removed.
    #[error("cannot remove {path} ({source}): remove it by hand")]
    Remove {
        /// Path of the file.
        path: PathBuf,
        /// Error of the system.
        source: std::io::Error,
    },
    /// The run's nodes could not be listed.
    #[error(
        "cannot list the processes of run `{run}`: {cause}; check the folders of shared memory with `carff doctor`"
    )]
    List {
        /// Name of the run.
        run: String,
        /// Error of iceoryx2.
        cause: String,
    },
}
