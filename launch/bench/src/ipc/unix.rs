//! Sends payloads through a Unix stream socket.

use super::{Receiver, Sender, Size, Waiting};
use anyhow::Context;
use std::io::{ErrorKind, Read, Write};
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::{Path, PathBuf};

fn socket(folder: &Path) -> PathBuf {
    folder.join("payload.socket")
}

pub(crate) struct UnixSender {
    stream: UnixStream,
}

impl UnixSender {
    pub(crate) fn open(folder: &Path) -> anyhow::Result<Self> {
        let path = socket(folder);
        Ok(Self {
            stream: UnixStream::connect(&path).with_context(|| format!("cannot connect to {}", path.display()))?,
        })
    }
}

impl Sender for UnixSender {
    fn send(&mut self, payload: &[u8], _waiting: Waiting) -> anyhow::Result<()> {
        Ok(self.stream.write_all(payload)?)
    }
}

pub(crate) struct UnixReceiver {
    listener: UnixListener,
    stream: Option<UnixStream>,
    buffer: Vec<u8>,
}

impl UnixReceiver {
    pub(crate) fn open(folder: &Path, size: Size) -> anyhow::Result<Self> {
        let path = socket(folder);
        // The socket of another size may exist.
        let _ = std::fs::remove_file(&path);
        let listener = UnixListener::bind(&path).with_context(|| format!("cannot listen on {}", path.display()))?;
        Ok(Self { listener, stream: None, buffer: vec![0; size.bytes()] })
    }
}

impl Receiver for UnixReceiver {
    fn receive(&mut self, waiting: Waiting, read: &mut dyn FnMut(&[u8])) -> anyhow::Result<()> {
        let stream = match &mut self.stream {
            Some(stream) => stream,
            none => none.insert(self.listener.accept()?.0),
        };
        stream.set_nonblocking(waiting == Waiting::Busy)?;
        let mut filled = 0;
        while filled < self.buffer.len() {
            match stream.read(&mut self.buffer[filled..]) {
                Ok(0) => anyhow::bail!("the sender has ended"),
                Ok(n) => filled += n,
                Err(e) if e.kind() == ErrorKind::WouldBlock => std::hint::spin_loop(),
                Err(e) if e.kind() == ErrorKind::Interrupted => {}
                Err(e) => return Err(e.into()),
            }
        }
        read(&self.buffer);
        Ok(())
    }
}
