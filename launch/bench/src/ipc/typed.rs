//! Sends payloads through this program's typed topics, as images of the camera.

use super::{Receiver, Sender, Size, Waiting};
use anyhow::Context;
use carff_messages::{DatasetView, FrameMeta, Header, Intrinsics};
use carff_transport::{
    ImagePayload, Node, Publisher, Run, Stop, Waiter, monotonic_now_ns, remove_run_leftovers, topics,
};
use std::path::Path;

/// Returns the run of both processes, named after their common folder.
fn run_of(folder: &Path) -> anyhow::Result<Run> {
    let name = folder.file_name().unwrap_or_default().to_string_lossy();
    let letters: String = name.chars().filter(char::is_ascii_alphanumeric).take(16).collect();
    Ok(Run::new(&format!("bench-{letters}"), 1)?)
}

/// Removes the leftovers of the run, once all its processes have ended.
pub(crate) fn clean_up(folder: &Path) -> anyhow::Result<()> {
    Ok(remove_run_leftovers(&run_of(folder)?)?)
}

pub(crate) struct TypedSender {
    // Dropped before the node.
    publisher: Publisher<ImagePayload<FrameMeta>>,
    _node: Node,
    meta: FrameMeta,
}

impl TypedSender {
    pub(crate) fn open(folder: &Path, size: Size) -> anyhow::Result<Self> {
        let node = Node::open(&run_of(folder)?, "sender")?;
        let publisher = node.image_publisher(&topics::FRAME, size.bytes())?;
        let meta = FrameMeta {
            width_px: size.width_px,
            height_px: size.height_px,
            intrinsics: Intrinsics { fl_x_px: 1.0, fl_y_px: 1.0, ..Intrinsics::default() },
            dataset_view: DatasetView::UNKNOWN,
            ..FrameMeta::default()
        };
        Ok(Self { publisher, _node: node, meta })
    }
}

impl Sender for TypedSender {
    fn send(&mut self, payload: &[u8], _waiting: Waiting) -> anyhow::Result<()> {
        self.meta.header = Header::of_frame(0, monotonic_now_ns(), 1);
        Ok(self.publisher.send_bytes(payload, self.meta)?)
    }
}

pub(crate) struct TypedReceiver {
    // Dropped before the node.
    receiver: Option<carff_transport::Receiver<ImagePayload<FrameMeta>>>,
    polled: bool,
    node: Node,
    waiter: Waiter,
}

impl TypedReceiver {
    pub(crate) fn open(folder: &Path) -> anyhow::Result<Self> {
        let node = Node::open(&run_of(folder)?, "receiver")?;
        let receiver = Some(node.receiver(&topics::FRAME)?);
        Ok(Self { receiver, polled: false, node, waiter: Waiter::new(Stop::new()?) })
    }
}

impl Receiver for TypedReceiver {
    fn prepare(&mut self, waiting: Waiting) -> anyhow::Result<()> {
        let polled = waiting == Waiting::Busy;
        if self.polled != polled {
            self.receiver = None;
            let receiver = self.node.receiver(&topics::FRAME)?;
            self.receiver = Some(if polled { receiver.polled() } else { receiver });
            self.polled = polled;
        }
        Ok(())
    }

    fn receive(&mut self, _waiting: Waiting, read: &mut dyn FnMut(&[u8])) -> anyhow::Result<()> {
        let receiver = self.receiver.as_mut().context("no receiver is open")?;
        self.waiter.wait(&[receiver])?;
        let image = receiver.newest()?.context("a payload was not valid")?;
        read(image.bytes());
        Ok(())
    }
}
