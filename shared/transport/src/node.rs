//! A process's membership in a run.

use crate::run::CLEANUP_PATIENCE;
use crate::space::{MANAGEMENT_BYTES, SHARED_MEMORY_DIR, check_space};
use crate::topics::Limits;
use crate::{
    Counters, OpenError, PicturePublisher, PictureReceiver, PictureTopic, Publisher, Receiver, Run, Service, Topic,
};
use carff_messages::{Message, PictureMeta};
use iceoryx2::port::listener::Listener;
use iceoryx2::port::notifier::Notifier;
use iceoryx2::prelude::{
    AllocationStrategy, BackpressureStrategy, LogLevel, NodeBuilder, NodeName, ServiceName, SignalHandlingMode,
    ZeroCopySend, set_log_level_from_env_or,
};
use iceoryx2::service::port_factory::event::PortFactory as EventFactory;
use std::fmt::Debug;
use std::fs::Permissions;
use std::os::unix::fs::{DirBuilderExt, MetadataExt, PermissionsExt};
use std::path::Path;
use std::sync::{Arc, Once};
use std::time::{Duration, Instant};

/// Applies the table's limits to a service builder and opens it.
macro_rules! limited {
    ($builder:expr, $limits:expr) => {
        $builder
            .max_subscribers($limits.max_subscribers)
            .max_publishers($limits.max_publishers)
            .max_nodes($limits.max_nodes)
            .history_size($limits.history)
            .subscriber_max_buffer_size($limits.buffer)
            .subscriber_max_borrowed_samples($limits.borrowed)
            .enable_safe_overflow(true)
            .open_or_create()
            .map_err(|e| e.to_string())
    };
}

/// How long to try again while several processes create the same topic at once.
const OPEN_PATIENCE: Duration = Duration::from_secs(3);

/// A process's membership in a run. Open one for each process; all its ports count into its [`Counters`].
#[derive(Debug)]
pub struct Node {
    inner: iceoryx2::node::Node<Service>,
    run: Run,
    counters: Arc<Counters>,
}

/// iceoryx2 reports what goes wrong in its results; its own log would say it twice.
pub(crate) fn quiet() {
    static ONCE: Once = Once::new();
    ONCE.call_once(|| set_log_level_from_env_or(LogLevel::Fatal));
}

impl Node {
    /// Joins a run under a name that others see, and cleans up what dead processes of this run left.
    pub fn open(run: &Run, name: &str) -> Result<Self, OpenError> {
        quiet();
        make_private_dir(&crate::runtime_dir())?;
        make_private_dir(&run.folder())?;
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
        Ok(Self { inner, run: run.clone(), counters: Arc::default() })
    }

    pub(crate) fn inner(&self) -> &iceoryx2::node::Node<Service> {
        &self.inner
    }

    /// The run.
    pub fn run(&self) -> &Run {
        &self.run
    }

    /// What all ports of this node have counted.
    pub fn counters(&self) -> &Arc<Counters> {
        &self.counters
    }

    /// Removes what dead processes of this run left behind. Returns how many were cleaned up.
    pub fn cleanup_dead(&self) -> u64 {
        self.inner.blocking_cleanup_dead_nodes(CLEANUP_PATIENCE).cleanups
    }

    /// Opens a topic to receive from.
    pub fn receiver<M>(&self, topic: &Topic<M>) -> Result<Receiver<M>, OpenError>
    where
        M: Message + ZeroCopySend + Debug + 'static,
    {
        let (name, limits) = (topic.name, topic.limits);
        let service = retry(name, || {
            limited!(self.inner.service_builder(&service_name(name)?).publish_subscribe::<M>(), limits)
        })?;
        let subscriber = service
            .subscriber_builder()
            .buffer_size(limits.buffer)
            .create()
            .map_err(|e| port_error(name, "subscribers", limits.max_subscribers, &e))?;
        Ok(Receiver::new(
            (name, topic.deadline),
            &self.run,
            subscriber,
            self.listener(name, limits)?,
            self.counters.clone(),
        ))
    }

    /// Opens a topic to send on.
    pub fn publisher<M>(&self, topic: &Topic<M>) -> Result<Publisher<M>, OpenError>
    where
        M: Message + ZeroCopySend + Debug + 'static,
    {
        let (name, limits) = (topic.name, topic.limits);
        check_segment(name, limits, size_of::<M>())?;
        let service = retry(name, || {
            limited!(self.inner.service_builder(&service_name(name)?).publish_subscribe::<M>(), limits)
        })?;
        let publisher = service
            .publisher_builder()
            .max_loaned_samples(limits.loaned)
            .backpressure_strategy(BackpressureStrategy::DiscardData)
            .create()
            .map_err(|e| port_error(name, "publishers", limits.max_publishers, &e))?;
        Ok(Publisher::new(name, &self.run, publisher, self.notifier(name, limits)?, self.counters.clone()))
    }

    /// Opens a topic of pictures to receive from.
    pub fn picture_receiver<M>(&self, topic: &PictureTopic<M>) -> Result<PictureReceiver<M>, OpenError>
    where
        M: PictureMeta + ZeroCopySend + Debug + 'static,
    {
        let (name, limits) = (topic.name, topic.limits);
        let service = retry(name, || {
            limited!(
                self.inner.service_builder(&service_name(name)?).publish_subscribe::<[u8]>().user_header::<M>(),
                limits
            )
        })?;
        let subscriber = service
            .subscriber_builder()
            .buffer_size(limits.buffer)
            .create()
            .map_err(|e| port_error(name, "subscribers", limits.max_subscribers, &e))?;
        let listener = self.listener(name, limits)?;
        let named = (name, topic.deadline);
        Ok(PictureReceiver::new(named, &self.run, subscriber, listener, self.counters.clone()))
    }

    /// Opens a topic of pictures of at most `max_bytes` each to send on.
    pub fn picture_publisher<M>(
        &self,
        topic: &PictureTopic<M>,
        max_bytes: usize,
    ) -> Result<PicturePublisher<M>, OpenError>
    where
        M: PictureMeta + ZeroCopySend + Debug + 'static,
    {
        let (name, limits) = (topic.name, topic.limits);
        check_segment(name, limits, size_of::<M>() + max_bytes)?;
        let service = retry(name, || {
            limited!(
                self.inner.service_builder(&service_name(name)?).publish_subscribe::<[u8]>().user_header::<M>(),
                limits
            )
        })?;
        let publisher = service
            .publisher_builder()
            .initial_max_slice_len(max_bytes)
            .allocation_strategy(AllocationStrategy::Static)
            .max_loaned_samples(limits.loaned)
            .backpressure_strategy(BackpressureStrategy::DiscardData)
            .create()
            .map_err(|e| port_error(name, "publishers", limits.max_publishers, &e))?;
        let notifier = self.notifier(name, limits)?;
        Ok(PicturePublisher::new(name, &self.run, publisher, notifier, self.counters.clone(), max_bytes))
    }

    fn event(&self, topic: &str, limits: Limits) -> Result<EventFactory<Service>, OpenError> {
        retry(topic, || {
            self.inner
                .service_builder(&service_name(topic)?)
                .event()
                .max_listeners(limits.max_subscribers)
                .max_notifiers(limits.max_publishers)
                .max_nodes(limits.max_nodes)
                .event_id_max_value(0)
                .open_or_create()
                .map_err(|e| e.to_string())
        })
    }

    fn listener(&self, topic: &str, limits: Limits) -> Result<Listener<Service>, OpenError> {
        let factory = self.event(topic, limits)?;
        factory.listener_builder().create().map_err(|e| port_error(topic, "listeners", limits.max_subscribers, &e))
    }

    fn notifier(&self, topic: &str, limits: Limits) -> Result<Notifier<Service>, OpenError> {
        let factory = self.event(topic, limits)?;
        factory.notifier_builder().create().map_err(|e| port_error(topic, "notifiers", limits.max_publishers, &e))
    }
}

fn check_segment(topic: &str, limits: Limits, message_bytes: usize) -> Result<(), OpenError> {
    let needed = (limits.preallocated() * (message_bytes + 64)) as u64 + MANAGEMENT_BYTES;
    check_space(Path::new(SHARED_MEMORY_DIR), &format!("topic `{topic}`"), needed)
}

pub(crate) fn service_name(topic: &str) -> Result<ServiceName, String> {
    ServiceName::new(topic).map_err(|e| format!("name: {e:?}"))
}

/// Opens or creates, again and again for a while where another process is just creating or removing the same thing.
fn retry<T>(topic: &str, mut open: impl FnMut() -> Result<T, String>) -> Result<T, OpenError> {
    // "DoesNotExist": it was there when it was looked for, and gone when it was opened.
    const PASSING: [&str; 6] = [
        "SystemInFlux",
        "IsBeingCreated",
        "IsMarkedForDestruction",
        "HangsInCreation",
        "AlreadyExists",
        "DoesNotExist",
    ];
    let start = Instant::now();
    loop {
        let cause = match open() {
            Ok(opened) => return Ok(opened),
            Err(cause) => cause,
        };
        let topic = topic.to_owned();
        if PASSING.iter().any(|word| cause.contains(word)) && start.elapsed() < OPEN_PATIENCE {
            std::thread::sleep(Duration::from_millis(5));
        } else if cause.contains("Incompatible") || cause.contains("DoesNotSupport") {
            return Err(OpenError::Incompatible { topic, cause });
        } else {
            return Err(OpenError::Topic { topic, cause });
        }
    }
}

fn port_error(topic: &str, what: &'static str, max: usize, error: &dyn std::error::Error) -> OpenError {
    let (topic, cause) = (topic.to_owned(), error.to_string());
    if cause.contains("ExceedsMaxSupported") {
        OpenError::TooMany { topic, what, max }
    } else {
        OpenError::Topic { topic, cause }
    }
}

/// Takes away what iceoryx2 (0.10) leaves open to all users in shared memory: the counter of a run's nodes. All else it
/// makes for this user alone.
fn close_to_others(run: &Run) -> std::io::Result<()> {
    for path in run.shared_memory_files()? {
        // What has gone meanwhile is open to nobody.
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

/// Makes a folder that only this user can enter, or checks that it is one: a folder (no link to one) of this user, which
/// nobody else may enter from then on. In a folder that all may write to, somebody else may have made one of that name.
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

    /// A private folder is made, or taken over from this user and closed to others; a link to one is refused, and so is
    /// another user's, where this test may make one.
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
        if rustix::process::getuid().is_root() {
            std::fs::create_dir(&foreign).unwrap();
            std::os::unix::fs::chown(&foreign, Some(65534), Some(65534)).unwrap();
            assert!(make_private_dir(&foreign).unwrap_err().to_string().contains("not a folder of this user"));
        }
        std::fs::remove_dir_all(&base).unwrap();
    }
}
