//! `carff bridge`: serves the run's topics over the Foxglove WebSocket protocol, read-only, for headless vehicles.

use crate::complete;
use crate::record::{RunLog, wall_offset_ns};
use crate::session::{Session, Sessions, WaitArgs};
use anyhow::Context;
use carff_checkpoint::Manifest;
use carff_observe::find;
use carff_recording::{Encoded, Format, MessageEncoder};
use carff_transport::TopicId;
use clap::Args;
use clap_complete::engine::ArgValueCandidates;
use foxglove::{ChannelBuilder, PartialMetadata, RawChannel, WebSocketServer, WebSocketServerHandle};
use std::cell::RefCell;
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
    /// Topics to serve; all by default, with the run's log.
    #[arg(add = ArgValueCandidates::new(complete::graph_topics))]
    pub topics: Vec<TopicId>,
    /// The run, the time limit, and the runs after it.
    #[command(flatten)]
    pub runs: WaitArgs,
}

/// Serves until a stop is requested, the time is over, or the run ends; with `--wait`, each run.
pub fn run(args: &BridgeArgs) -> anyhow::Result<ExitCode> {
    crate::metrics::refuse_remote(args.listen, args.remote)?;
    let mut sessions = Sessions::new(&args.runs, "bridge")?;
    let topics: Vec<TopicId> = if args.topics.is_empty() { TopicId::all().collect() } else { args.topics.clone() };
    let run = find(args.runs.session.run.as_deref()).map(|live| live.name).ok().or(args.runs.session.run.clone());
    // Without capabilities, clients can only read.
    let server = WebSocketServer::new()
        .name(run.map_or("carff".to_owned(), |run| format!("carff run {run}")))
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
    while let Some(session) = sessions.next(|| {})? {
        let log = RunLog::of(&session.attached.live, args.topics.is_empty());
        serve(session, log, &topics, &server, &mut open)?;
    }
    // The server waits for its clients, and a client that does not read would block it indefinitely.
    let stopping = server.stop();
    let (stopped, wait) = std::sync::mpsc::sync_channel(1);
    std::thread::spawn(move || {
        stopping.wait_blocking();
        // The receiver is gone after the time limit.
        let _ = stopped.send(());
    });
    let _ = wait.recv_timeout(FAREWELL);
    Ok(ExitCode::SUCCESS)
}

/// Serves one run to the clients of the server.
fn serve(
    mut session: Session,
    mut log: RunLog,
    topics: &[TopicId],
    server: &WebSocketServerHandle,
    open: &mut BTreeMap<String, Arc<RawChannel>>,
) -> anyhow::Result<()> {
    session.listen(topics.iter().copied())?;
    let places = Manifest::load(&session.attached.live.checkpoint).map(|m| m.places).unwrap_or_default();
    let mut encoder = MessageEncoder::new(places, wall_offset_ns());
    let open = RefCell::new(open);
    let going = session.follow(
        |topic, message| {
            // Nothing is encoded without a client.
            if server.client_count() == 0 {
                return Ok(true);
            }
            let message = message.message();
            let wall_ns = encoder.wall_ns(message.header().publish_time_ns);
            let encoded = encoder.encode(topic, message)?;
            encoded.into_iter().try_for_each(|message| send(&mut open.borrow_mut(), message, wall_ns))?;
            Ok(true)
        },
        || log.lines().iter().try_for_each(|line| send(&mut open.borrow_mut(), line.encode(), line.wall_ns)),
    )?;
    session.say_end(going);
    Ok(())
}

/// Sends a message on its channel, which is opened for its first message.
fn send(open: &mut BTreeMap<String, Arc<RawChannel>>, message: Encoded, wall_ns: u64) -> anyhow::Result<()> {
    let channel = match open.entry(message.channel) {
        Entry::Occupied(known) => known.into_mut(),
        Entry::Vacant(new) => {
            let opened = channel(new.key(), message.format)?;
            new.insert(opened)
        }
    };
    channel.log_with_meta(&message.data, PartialMetadata { log_time: Some(wall_ns) });
    Ok(())
}

fn channel(name: &str, format: Format) -> anyhow::Result<Arc<RawChannel>> {
    let built = ChannelBuilder::new(name).schema(format.schema()).message_encoding(format.encoding()).build_raw();
    built.with_context(|| format!("cannot open the channel `{name}`"))
}
