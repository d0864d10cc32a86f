//! `carff bridge`: serves the run's topics over the Foxglove WebSocket protocol, read-only, for headless vehicles.

use crate::record::wall_offset_ns;
use crate::session::{Session, SessionArgs};
use anyhow::Context;
use carff_checkpoint::Manifest;
use carff_recording::{Encoder, Format};
use carff_transport::TopicId;
use clap::Args;
use foxglove::{ChannelBuilder, PartialMetadata, RawChannel, WebSocketServer};
use std::collections::BTreeMap;
use std::collections::btree_map::Entry;
use std::net::SocketAddr;
use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

/// Longest time to notify clients of the end.
const FAREWELL: Duration = Duration::from_secs(1);

/// Serve a run's topics.
#[derive(Clone, Debug, Args)]
pub struct BridgeArgs {
    /// Address and port to listen on; other than loopback only with --remote. Port 0 selects a free port.
    #[arg(long, default_value = "127.0.0.1:8765")]
    pub listen: SocketAddr,
    /// Allow an address that other machines can reach. Every host that reaches it can see the camera's images.
    #[arg(long)]
    pub remote: bool,
    /// Topics to serve; all by default.
    pub topics: Vec<TopicId>,
    /// The run, and the time limit.
    #[command(flatten)]
    pub session: SessionArgs,
}

/// Serves until a stop is requested, the time is over, or the run ends.
pub fn run(args: &BridgeArgs) -> anyhow::Result<ExitCode> {
    crate::metrics::refuse_remote(args.listen, args.remote)?;
    let mut session = Session::open(&args.session, "bridge")?;
    let topics: Vec<TopicId> = if args.topics.is_empty() { TopicId::all().collect() } else { args.topics.clone() };
    session.listen(topics.iter().copied())?;
    let live = session.attached.live.clone();
    let places = Manifest::load(&live.checkpoint).map(|m| m.places).unwrap_or_default();
    // Without capabilities, clients can only read.
    let server = WebSocketServer::new()
        .name(format!("carff run {}", live.name))
        .bind(args.listen.ip().to_string(), args.listen.port())
        .capabilities([])
        .start_blocking()
        .with_context(|| format!("cannot listen on {}", args.listen))?;
    println!("ws://{}:{}", args.listen.ip(), server.port());
    let mut open: BTreeMap<String, Arc<RawChannel>> = BTreeMap::new();
    // Clients see the topics at once. Other channels are opened with their first message.
    for &topic in &topics {
        open.insert(topic.name().to_owned(), channel(topic.name(), Format::Form(topic))?);
    }
    let mut encoder = Encoder::new(places, wall_offset_ns());
    let going = session.follow(
        |topic, message| {
            // Nothing is encoded without a client.
            if server.client_count() == 0 {
                return Ok(true);
            }
            let message = message.message();
            let log_time = Some(encoder.wall_ns(message.header().publish_time_ns));
            for message in encoder.encode(topic, message)? {
                let channel = match open.entry(message.channel) {
                    Entry::Occupied(known) => known.into_mut(),
                    Entry::Vacant(new) => {
                        let opened = channel(new.key(), message.format)?;
                        new.insert(opened)
                    }
                };
                channel.log_with_meta(&message.data, PartialMetadata { log_time });
            }
            Ok(true)
        },
        || Ok(()),
    )?;
    // The server waits for its clients, and a client that does not read would block it indefinitely.
    let stopping = server.stop();
    let (stopped, wait) = std::sync::mpsc::sync_channel(1);
    std::thread::spawn(move || {
        stopping.wait_blocking();
        // The receiver is gone after the time limit.
        let _ = stopped.send(());
    });
    let _ = wait.recv_timeout(FAREWELL);
    session.say_end(going);
    Ok(ExitCode::SUCCESS)
}

fn channel(name: &str, format: Format) -> anyhow::Result<Arc<RawChannel>> {
    let built = ChannelBuilder::new(name).schema(format.schema()).message_encoding(format.encoding()).build_raw();
    built.with_context(|| format!("cannot open the channel `{name}`"))
}
