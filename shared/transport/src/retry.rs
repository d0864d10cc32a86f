//! Opens services while other processes create or remove the same ones.

use crate::OpenError;
use iceoryx2::service::builder::event::{EventCreateError, EventOpenError, EventOpenOrCreateError};
use iceoryx2::service::builder::publish_subscribe::{
    PublishSubscribeCreateError, PublishSubscribeOpenError, PublishSubscribeOpenOrCreateError,
};
use std::time::{Duration, Instant};

/// Time for which an attempt is repeated while several processes create the same topic at once.
const PATIENCE: Duration = Duration::from_secs(3);
/// Pause between two attempts.
const PAUSE: Duration = Duration::from_millis(5);

/// The meaning of a failure to open a service.
pub(crate) enum Failure {
    /// Another process is creating or removing the service: a later attempt can succeed.
    Passing,
    /// The service exists with other types or limits.
    Incompatible,
    /// Any other failure.
    Lasting,
}

/// An error of iceoryx2 with a meaning.
pub(crate) trait Classified: std::error::Error {
    fn failure(&self) -> Failure;
}

/// Opens or creates a service; retries for a while if another process is creating or removing it.
pub(crate) fn retry<T, E: Classified>(topic: &str, mut open: impl FnMut() -> Result<T, E>) -> Result<T, OpenError> {
    let start = Instant::now();
    loop {
        let error = match open() {
            Ok(opened) => return Ok(opened),
            Err(error) => error,
        };
        match error.failure() {
            Failure::Passing if start.elapsed() < PATIENCE => std::thread::sleep(PAUSE),
            Failure::Incompatible => {
                return Err(OpenError::Incompatible { topic: topic.to_owned(), cause: error.to_string() });
            }
            _ => return Err(OpenError::Topic { topic: topic.to_owned(), cause: error.to_string() }),
        }
    }
}

impl Classified for PublishSubscribeOpenOrCreateError {
    fn failure(&self) -> Failure {
        use PublishSubscribeCreateError as Create;
        use PublishSubscribeOpenError as Open;
        match self {
            Self::SystemInFlux
            // The service existed at the check, and was removed before it was opened.
            | Self::PublishSubscribeOpenError(
                Open::DoesNotExist | Open::IsMarkedForDestruction | Open::HangsInCreation,
            )
            | Self::PublishSubscribeCreateError(
                Create::AlreadyExists | Create::IsBeingCreatedByAnotherInstance | Create::HangsInCreation,
            ) => Failure::Passing,
            Self::PublishSubscribeOpenError(
                Open::IncompatibleTypes
                | Open::IncompatibleMessagingPattern
                | Open::IncompatibleAttributes
                | Open::IncompatibleOverflowBehavior
                | Open::VersionMismatch
                | Open::DoesNotSupportRequestedMinBufferSize
                | Open::DoesNotSupportRequestedMinHistorySize
                | Open::DoesNotSupportRequestedMinSubscriberBorrowedSamples
                | Open::DoesNotSupportRequestedAmountOfPublishers
                | Open::DoesNotSupportRequestedAmountOfSubscribers
                | Open::DoesNotSupportRequestedAmountOfNodes,
            ) => Failure::Incompatible,
            _ => Failure::Lasting,
        }
    }
}

impl Classified for EventOpenOrCreateError {
    fn failure(&self) -> Failure {
        use EventCreateError as Create;
        use EventOpenError as Open;
        match self {
            Self::SystemInFlux
            | Self::EventOpenError(Open::DoesNotExist | Open::IsMarkedForDestruction | Open::HangsInCreation)
            | Self::EventCreateError(Create::AlreadyExists | Create::IsBeingCreatedByAnotherInstance) => {
                Failure::Passing
            }
            Self::EventOpenError(
                Open::IncompatibleMessagingPattern
                | Open::IncompatibleAttributes
                | Open::IncompatibleDeadline
                | Open::IncompatibleNotifierCreatedEvent
                | Open::IncompatibleNotifierDroppedEvent
                | Open::IncompatibleNotifierDeadEvent
                | Open::VersionMismatch
                | Open::DoesNotSupportRequestedAmountOfNotifiers
                | Open::DoesNotSupportRequestedAmountOfListeners
                | Open::DoesNotSupportRequestedMaxEventId
                | Open::DoesNotSupportRequestedAmountOfNodes,
            ) => Failure::Incompatible,
            _ => Failure::Lasting,
        }
    }
}
