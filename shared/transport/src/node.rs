//! A process's membership in a run.

use crate::folder::Kept;
use crate::payload::{ImagePayload, Opened, Payload, Unopened};
use crate::retry::retry;
use crate::run::CLEANUP_PATIENCE;
use crate::space::{MANAGEMENT_BYTES, SHARED_MEMORY_DIR, check_open_files, check_space};
use crate::{Counters, OpenError, Publisher, Receiver, Run, Service, Topic, TopicLimits, log};
use carff_messages::{ImageMeta, Message};
use iceoryx2::port::listener::{Listener, ListenerCreateError};
use iceoryx2::port::notifier::{Notifier, NotifierCreateError};
use iceoryx2::port::publisher::PublisherCreateError;
use iceoryx2::port::subscriber::SubscriberCreateError;
use iceoryx2::prelude::{BackpressureStrategy, NodeBuilder, NodeName, ServiceName, SignalHandlingMode};
use iceoryx2::service::port_factory::event::PortFactory as EventFactory;
use std::fs::Permissions;
use std::os::unix::fs::{DirBuilderExt, MetadataExt, PermissionsExt};
use std::path::Path;
use std::sync::Arc;

/// A process's membership in a run. It and its ports belong to one thread; all its ports share its [`Counters`].
#[derive(Debug)]
pub struct Node {
    inner: iceoryx2::node::Node<Service>,
    run: Run,
    counters: Arc<Counters>,
    /// Locks that keep the folders from cleaners.
    _kept: [Kept; 2],
}

impl Node {
    /// Joins a run under a visible name, and cleans up after dead processes of this run.
    pub fn open(run: &Run, name: &str) -> Result<Self, OpenError> {
        log::quiet();
        make_private_dir(run.dir())?;
        make_private_dir(&run.folder())?;
        let kept = [Kept::new(run.dir()), Kept::new(&run.folder())];
        check_open_files()?;
        check_space(Path::new(SHARED_MEMORY_DIR), "joining the run", MANAGEMENT_BYTES)?;
        let failed = |cause: String| OpenError::Node { run: run.name().to_owned(), path: run.folder(), cause };
        let config = run.config().map_err(failed)?;
        let inner = NodeBuilder::new()
            .name(&NodeName::new(name).map_err(|e| failed(format!("node name `{name}`: {e:?}")))?)
            .config(&config)
            .signal_handling_mode(SignalHandlingMode::Disabled)
            .create::<Service>()
            .map_err(|e| failed(e.to_string()))?;
        close_to_others(run).map_err(|e| failed(e.to_string()))?;
        Ok(Self { inner, run: run.clone(), counters: Arc::default(), _kept: kept })
    }

    pub(crate) fn inner(&self) -> &iceoryx2::node::Node<Service> {
        &self.inner
    }

    /// Returns the run.
    pub fn run(&self) -> &Run {
        &self.run
    }

    /// Returns the counters of all ports of this node.
    pub fn counters(&self) -> &Arc<Counters> {
        &self.counters
    }

    /// Removes leftovers of dead processes of this run. Returns the number of processes.
    pub fn cleanup_dead(&self) -> u64 {
        self.inner.blocking_cleanup_dead_nodes(CLEANUP_PATIENCE).cleanups
    }

    /// Opens a topic to receive from.
    pub fn receiver<P: Payload>(&self, topic: &Topic<P>) -> Result<Receiver<P>, OpenError> {
        self.receiver_of(topic, &self.service(topic)?)
    }

    pub(crate) fn receiver_of<P: Payload>(
        &self,
        topic: &Topic<P>,
        service: &Opened<P>,
    ) -> Result<Receiver<P>, OpenError> {
        let Topic { name, limits, .. } = *topic;
        let subscriber = service.subscriber_builder().buffer_size(limits.buffer).create().map_err(|e| match e {
            SubscriberCreateError::ExceedsMaxSupportedSubscribers => {
                too_many(name, "subscribers", limits.max_subscribers)
            }
            _ => failed(name, &e),
        })?;
        Ok(Receiver::new(topic, &self.run, subscriber, self.listener(name, limits)?, self.counters.clone()))
    }

    /// Opens a topic of messages to send on.
    pub fn publisher<M: Message>(&self, topic: &Topic<M>) -> Result<Publisher<M>, OpenError> {
        self.sized_publisher(topic, 0)
    }

    /// Opens a topic of images of at most `max_bytes` each to send on.
    pub fn image_publisher<M: ImageMeta>(
        &self,
        topic: &Topic<ImagePayload<M>>,
        max_bytes: usize,
    ) -> Result<Publisher<ImagePayload<M>>, OpenError> {
        self.sized_publisher(topic, max_bytes)
    }

    /// Opens a topic of any payload to send on; `max_bytes` only matters for images.
    pub(crate) fn sized_publisher<P: Payload>(
        &self,
        topic: &Topic<P>,
        max_bytes: usize,
    ) -> Result<Publisher<P>, OpenError> {
        let Topic { name, limits, .. } = *topic;
        let needed_bytes = topic.segment_bytes(max_bytes) + MANAGEMENT_BYTES;
        check_space(Path::new(SHARED_MEMORY_DIR), &format!("topic `{name}`"), needed_bytes)?;
        let service = self.service(topic)?;
        let publisher = service
            .publisher_builder()
            .max_loaned_samples(limits.loaned)
            .backpressure_strategy(BackpressureStrategy::DiscardData);
        let publisher = P::sized(publisher, max_bytes).create().map_err(|e| match e {
            PublisherCreateError::ExceedsMaxSupportedPublishers => too_many(name, "publishers", limits.max_publishers),
            _ => failed(name, &e),
        })?;
        let notifier = self.notifier(name, limits)?;
        Ok(Publisher::new(topic, &self.run, publisher, notifier, self.counters.clone(), max_bytes))
    }

    /// Describes the service of a topic to iceoryx2, without its limits.
    pub(crate) fn unopened<P: Payload>(&self, topic: &Topic<P>) -> Result<Unopened<P>, OpenError> {
        let builder = self.inner.service_builder(&service_name(topic.name)?);
        Ok(builder.publish_subscribe::<P::Body>().user_header::<P::UserHeader>())
    }

    fn service<P: Payload>(&self, topic: &Topic<P>) -> Result<Opened<P>, OpenError> {
        let limits = topic.limits;
        let service = self
            .unopened(topic)?
            .max_subscribers(limits.max_subscribers)
            .max_publishers(limits.max_publishers)
            .max_nodes(limits.max_nodes)
            .history_size(limits.history)
            .subscriber_max_buffer_size(limits.buffer)
            .subscriber_max_borrowed_samples(limits.borrowed)
            .enable_safe_overflow(true);
        retry(topic.name, || P::open_or_create(service.clone()))
    }

    fn event(&self, topic: &str, limits: TopicLimits) -> Result<EventFactory<Service>, OpenError> {
        let service = self
            .inner
            .service_builder(&service_name(topic)?)
            .event()
            .max_listeners(limits.max_subscribers)
            .max_notifiers(limits.max_publishers)
            .max_nodes(limits.max_nodes)
            .event_id_max_value(0);
        retry(topic, || service.clone().open_or_create())
    }

    fn listener(&self, topic: &str, limits: TopicLimits) -> Result<Listener<Service>, OpenError> {
        self.event(topic, limits)?.listener_builder().create().map_err(|e| match e {
            ListenerCreateError::ExceedsMaxSupportedListeners => too_many(topic, "listeners", limits.max_subscribers),
            _ => failed(topic, &e),
        })
    }

    fn notifier(&self, topic: &str, limits: TopicLimits) -> Result<Notifier<Service>, OpenError> {
        self.event(topic, limits)?.notifier_builder().create().map_err(|e| match e {
            NotifierCreateError::ExceedsMaxSupportedNotifiers => too_many(topic, "notifiers", limits.max_publishers),
            _ => failed(topic, &e),
        })
    }
}

pub(crate) fn service_name(topic: &str) -> Result<ServiceName, OpenError> {
    ServiceName::new(topic)
        .map_err(|e| OpenError::Topic { topic: topic.to_owned(), cause: format!("its name is not allowed: {e:?}") })
}

pub(crate) fn failed(topic: &str, error: &dyn std::error::Error) -> OpenError {
    OpenError::Topic { topic: topic.to_owned(), cause: error.to_string() }
}

fn too_many(topic: &str, what: &'static str, max: usize) -> OpenError {
    OpenError::TooMany { topic: topic.to_owned(), what, max }
}

/// Restricts the permissions of the counter of a run's nodes in shared memory, which iceoryx2 (0.10) leaves open to all
/// users. It creates all other files for this user only.
fn close_to_others(run: &Run) -> std::io::Result<()> {
    for path in run.shared_memory_files()? {
        // A file that has been removed meanwhile is not accessible.
        let Ok(found) = std::fs::symlink_metadata(&path) else { continue };
        if found.is_file() && found.uid() == rustix::process::getuid().as_raw() && !matches!(found.mode() & 0o077, 0) {
            match std::fs::set_permissions(&path, Permissions::from_mode(0o600)) {
                Err(error) if error.kind() != std::io::ErrorKind::NotFound => return Err(error),
                _ => {}
            }
        }
    }
    Ok(())
}

/// Creates a folder that only this user can enter. An existing folder (not a link) of this user is restricted. In a
/// folder that all users may write to, another user may have created one of that name, which is an error.
pub fn make_private_dir(path: &Path) -> Result<(), OpenError> {
    let not_writable = |source| OpenError::NotWritable { path: path.to_owned(), source };
    match std::fs::DirBuilder::new().mode(0o700).create(path) {
        Ok(()) => Ok(()),
        Err(e) if e.kind() == std::io::ErrorKind::AlreadyExists => {
            let found = std::fs::symlink_metadata(path).map_err(not_writable)?;
            if !found.is_dir() || found.uid() != rustix::process::getuid().as_raw() {
                return Err(not_writable(std::io::Error::other("it is not a folder of this user")));
            }
            if matches!(found.mode() & 0o077, 0) {
                return Ok(());
            }
            std::fs::set_permissions(path, Permissions::from_mode(0o700)).map_err(not_writable)
        }
        Err(e) => Err(not_writable(e)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A private folder is created, or an existing folder of this user is restricted. A link is refused, and so is
    /// another user's folder, if this test may create one.
    #[test]
    fn private_folders_are_this_users() {
        let base = std::env::temp_dir().join(format!("carff-private-{}", std::process::id()));
        let mode = |path: &Path| path.metadata().unwrap().mode() & 0o777;
        make_private_dir(&base).unwrap();
        assert_eq!(mode(&base), 0o700);
        let (open, link, foreign) = (base.join("open"), base.join("link"), base.join("foreign"));
        std::fs::create_dir(&open).unwrap();
        std::fs::set_permissions(&open, Permissions::from_mode(0o777)).unwrap();
        make_private_dir(&open).unwrap();
        assert_eq!(mode(&open), 0o700);
        std::os::unix::fs::symlink(&open, &link).unwrap();
        assert!(make_private_dir(&link).unwrap_err().to_string().contains("not a folder of this user"));
        std::fs::create_dir(&foreign).unwrap();
        // Only root may, and in a user namespace only if the other user exists in it.
        if std::os::unix::fs::chown(&foreign, Some(65534), Some(65534)).is_ok() {
            assert!(make_private_dir(&foreign).unwrap_err().to_string().contains("not a folder of this user"));
        }
        std::fs::remove_dir_all(&base).unwrap();
    }
}
