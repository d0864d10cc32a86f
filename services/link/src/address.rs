//! Where the two ends meet.

use anyhow::Context;
use clap::Args;
use zenoh::{Config, Session, Wait};

/// Nobody else can reach this one.
const LOOPBACK: &str = "127.0.0.1:7447";
/// After so long without a sign of life the connection is given up, and sought anew, milliseconds.
const LEASE_MS: u32 = 2_000;
/// What the system holds for a connection in each direction, and zenoh of each priority twice, bytes: more would be a
/// queue, in which messages grow old while the link is slow.
const SOCKET_BYTES: u32 = 32 * 1024;
const BATCH_BYTES: u16 = 16 * 1024;
/// Longest message that is taken, bytes: the largest picture, and what describes it.
const MAX_MESSAGE_BYTES: usize = carff_messages::MAX_IMAGE_BYTES + (1 << 20);

/// One end listens, the other connects; which does what is no matter.
#[derive(Clone, Debug, Args)]
#[group(required = true, multiple = false)]
pub struct AddressArgs {
    /// Connect to the other end, which listens there; again and again until it does.
    #[arg(long, value_name = "HOST:PORT", value_parser = address)]
    connect: Option<String>,
    /// Listen for the other end. Without an address on loopback, where this machine alone and its tunnels get in.
    #[arg(long, value_name = "HOST:PORT", value_parser = address, num_args = 0..=1, default_missing_value = LOOPBACK)]
    listen: Option<String>,
}

/// `HOST:PORT`; nothing else, since zenoh would read more of what stands there.
fn address(text: &str) -> Result<String, String> {
    let wrong = || format!("`{text}` is no HOST:PORT, such as {LOOPBACK}");
    let (host, port) = text.rsplit_once(':').ok_or_else(wrong)?;
    let plain = |c: char| c.is_ascii_alphanumeric() || "-.:[]".contains(c);
    if host.is_empty() || !host.chars().all(plain) || port.parse::<u16>().is_err() {
        return Err(wrong());
    }
    Ok(text.to_owned())
}

impl AddressArgs {
    /// Opens this end.
    pub fn open(&self) -> anyhow::Result<Session> {
        let endpoints = |address: &Option<String>| match address {
            Some(address) => format!("[{:?}]", format!("tcp/{address}")),
            None => "[]".to_owned(),
        };
        let mut config = Config::default();
        for (key, value) in [
            ("mode", "\"peer\"".to_owned()),
            ("listen/endpoints", endpoints(&self.listen)),
            ("connect/endpoints", endpoints(&self.connect)),
            // It opens at once, and connects when it can.
            ("connect/timeout_ms", "-1".to_owned()),
            ("connect/exit_on_failure", "false".to_owned()),
            ("scouting/multicast/enabled", "false".to_owned()),
            ("scouting/gossip/enabled", "false".to_owned()),
            ("transport/link/tx/lease", LEASE_MS.to_string()),
            ("transport/link/tx/batch_size", BATCH_BYTES.to_string()),
            ("transport/link/rx/max_message_size", MAX_MESSAGE_BYTES.to_string()),
            ("transport/link/tcp", format!("{{so_sndbuf: {SOCKET_BYTES}, so_rcvbuf: {SOCKET_BYTES}}}")),
        ] {
            let set = config.insert_json5(key, &value).map_err(anyhow::Error::from_boxed);
            set.with_context(|| format!("setting {key} of zenoh"))?;
        }
        let (listen, connect) = (self.listen.as_deref(), self.connect.as_deref());
        let session = zenoh::open(config).wait().map_err(anyhow::Error::from_boxed);
        let session = session.with_context(|| match (listen, connect) {
            (Some(address), _) => format!("cannot listen on {address}: is it of this machine, and free?"),
            (None, address) => format!("cannot connect to {}", address.unwrap_or_default()),
        })?;
        match (listen, connect) {
            (Some(address), _) => crate::note(&format!("listening on {address}")),
            (None, address) => crate::note(&format!("connecting to {}", address.unwrap_or_default())),
        }
        Ok(session)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// An address is host and port; what zenoh would read as a protocol or as settings is refused.
    #[test]
    fn an_address_is_host_and_port() {
        for good in [LOOPBACK, "desk:1", "[::1]:7447", "vehicle-2.local:65535"] {
            assert_eq!(address(good).as_deref(), Ok(good));
        }
        for bad in ["", "desk", "desk:", ":7447", "desk:70000", "tcp/desk:1", "desk#iface=eth0:1", "a b:1", "a\"]:1"] {
            assert!(address(bad).unwrap_err().contains("HOST:PORT"), "{bad}");
        }
    }
}
