//! The address at which the two ends meet.

use anyhow::Context;
use clap::Args;
use zenoh::{Config, Session, Wait};

/// Only this machine can reach this address.
const LOOPBACK: &str = "127.0.0.1:7447";
/// Time without a sign of life after which the connection is closed and opened again, milliseconds.
const LEASE_MS: u32 = 2_000;
/// Buffer of the system for each direction, and half of zenoh's for each priority, bytes. A larger buffer would be a
/// queue, in which messages grow old on a slow link.
const SOCKET_BYTES: u32 = 32 * 1024;
const BATCH_BYTES: u16 = 16 * 1024;
/// Longest message that is received, bytes: the largest image and its form.
const MAX_MESSAGE_BYTES: usize = carff_messages::MAX_IMAGE_BYTES + (1 << 20);

/// One end listens and the other connects, in either direction.
#[derive(Clone, Debug, Args)]
#[group(required = true, multiple = false)]
pub struct AddressArgs {
    /// Connect to the other end, which listens there; retried until it does.
    #[arg(long, value_name = "HOST:PORT", value_parser = address)]
    connect: Option<String>,
    /// Listen for the other end; without an address on loopback, which only this machine and its tunnels reach.
    #[arg(long, value_name = "HOST:PORT", value_parser = address, num_args = 0..=1, default_missing_value = LOOPBACK)]
    listen: Option<String>,
}

/// Accepts `HOST:PORT` and nothing else, since zenoh would interpret more.
fn address(text: &str) -> Result<String, String> {
    let wrong = || format!("`{text}` is not HOST:PORT, such as {LOOPBACK}");
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
            // The session opens at once, and connects when it can.
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

    /// An address is host and port; a protocol or settings of zenoh are refused.
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
