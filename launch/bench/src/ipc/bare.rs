//! Sends payloads through iceoryx2 without a wrapper, with the limits of the camera's topic.

use super::{Receiver, Sender, Size, Waiting};
use anyhow::Context;
use carff_transport::{SHARED_MEMORY_DIR, topics};
use iceoryx2::node::Node;
use iceoryx2::port::{listener::Listener, notifier::Notifier, publisher::Publisher, subscriber::Subscriber};
use iceoryx2::prelude::{
    Config, FileName, LogLevel, NodeBuilder, Path as IoxPath, SemanticString, ServiceName, SignalHandlingMode, ipc,
    set_log_level_from_env_or,
};
use iceoryx2::service::port_factory::{event, publish_subscribe};
use std::path::Path;

/// Prefix of this run's files in shared memory.
fn prefix(folder: &Path) -> String {
    let name = folder.file_name().unwrap_or_default().to_string_lossy();
    let letters: String = name.chars().filter(char::is_ascii_alphanumeric).take(16).collect();
    format!("carff-bench-{letters}_")
}

/// Removes the files that iceoryx2 leaves in shared memory after its last node, once both processes have ended.
pub(crate) fn clean_up(folder: &Path) -> std::io::Result<()> {
    for entry in std::fs::read_dir(SHARED_MEMORY_DIR)? {
        let entry = entry?;
        if entry.file_name().to_string_lossy().starts_with(&prefix(folder)) {
            std::fs::remove_file(entry.path())?;
        }
    }
    Ok(())
}

struct Services {
    images: publish_subscribe::PortFactory<ipc::Service, [u8], ()>,
    wake_ups: event::PortFactory<ipc::Service>,
    _node: Node<ipc::Service>,
}

impl Services {
    fn open(folder: &Path) -> anyhow::Result<Self> {
        set_log_level_from_env_or(LogLevel::Fatal);
        let mut config = Config::default();
        config.global.prefix =
            FileName::new(prefix(folder).as_bytes()).map_err(|e| anyhow::anyhow!("prefix: {e:?}"))?;
        let root = IoxPath::new(folder.as_os_str().as_encoded_bytes()).map_err(|e| anyhow::anyhow!("folder: {e:?}"))?;
        config.global.set_root_path(&root);
        let node = NodeBuilder::new()
            .config(&config)
            .signal_handling_mode(SignalHandlingMode::Disabled)
            .create::<ipc::Service>()
            .context("cannot create an iceoryx2 node")?;
        let service = ServiceName::new("payload").map_err(|e| anyhow::anyhow!("service name: {e:?}"))?;
        let limits = topics::FRAME.limits;
        let images = node
            .service_builder(&service)
            .publish_subscribe::<[u8]>()
            .max_subscribers(limits.max_subscribers)
            .max_publishers(limits.max_publishers)
            .max_nodes(limits.max_nodes)
            .history_size(limits.history)
            .subscriber_max_buffer_size(limits.buffer)
            .subscriber_max_borrowed_samples(limits.borrowed)
            .enable_safe_overflow(true)
            .open_or_create()
            .context("cannot open the iceoryx2 service")?;
        let wake_ups =
            node.service_builder(&service).event().open_or_create().context("cannot open the iceoryx2 event")?;
        Ok(Self { images, wake_ups, _node: node })
    }
}

pub(crate) struct BareSender {
    publisher: Publisher<ipc::Service, [u8], ()>,
    notifier: Notifier<ipc::Service>,
    _services: Services,
}

impl BareSender {
    pub(crate) fn open(folder: &Path, size: Size) -> anyhow::Result<Self> {
        let services = Services::open(folder)?;
        Ok(Self {
            publisher: services
                .images
                .publisher_builder()
                .initial_max_slice_len(size.bytes())
                .max_loaned_samples(topics::FRAME.limits.loaned)
                .create()
                .context("no iceoryx2 publisher")?,
            notifier: services.wake_ups.notifier_builder().create().context("no iceoryx2 notifier")?,
            _services: services,
        })
    }
}

impl Sender for BareSender {
    fn send(&mut self, payload: &[u8], waiting: Waiting) -> anyhow::Result<()> {
        self.publisher.loan_slice_uninit(payload.len())?.write_from_slice(payload).send()?;
        // A polling receiver has no listener.
        if waiting == Waiting::Sleeping {
            self.notifier.notify()?;
        }
        Ok(())
    }
}

pub(crate) struct BareReceiver {
    subscriber: Subscriber<ipc::Service, [u8], ()>,
    listener: Listener<ipc::Service>,
    _services: Services,
}

impl BareReceiver {
    pub(crate) fn open(folder: &Path) -> anyhow::Result<Self> {
        let services = Services::open(folder)?;
        Ok(Self {
            subscriber: services.images.subscriber_builder().create().context("no iceoryx2 subscriber")?,
            listener: services.wake_ups.listener_builder().create().context("no iceoryx2 listener")?,
            _services: services,
        })
    }
}

impl Receiver for BareReceiver {
    fn receive(&mut self, waiting: Waiting, read: &mut dyn FnMut(&[u8])) -> anyhow::Result<()> {
        loop {
            if let Some(sample) = self.subscriber.receive()? {
                read(sample.payload());
                return Ok(());
            }
            match waiting {
                Waiting::Busy => std::hint::spin_loop(),
                Waiting::Sleeping => {
                    self.listener.blocking_wait(|_| ())?;
                }
            }
        }
    }
}
