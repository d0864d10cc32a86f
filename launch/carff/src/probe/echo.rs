//! `carff probe echo`: shows messages as text or JSON lines.

use crate::complete;
use crate::session::{Session, SessionArgs};
use carff_messages::forms::as_text;
use carff_transport::HeaderOnly;
use clap::Args;
use clap_complete::engine::ArgValueCandidates;
use std::io::Write;

/// Show a topic's messages.
#[derive(Clone, Debug, Args)]
pub struct EchoArgs {
    /// Topic: `prober/belief`, or `belief` for short. For images, only their description is shown; of a type that this
    /// program does not know, only the header.
    #[arg(add = ArgValueCandidates::new(complete::topics))]
    pub topic: String,
    /// Print one line of JSON per message.
    #[arg(long)]
    pub json: bool,
    /// Show only every N-th message.
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u64).range(1..))]
    pub every: u64,
    /// Stop after this number of shown messages.
    #[arg(long)]
    pub count: Option<u64>,
    /// The run, and the time limit.
    #[command(flatten)]
    pub session: SessionArgs,
}

pub(super) fn run(args: &EchoArgs) -> anyhow::Result<()> {
    let mut session = Session::open(&args.session, "probe-echo")?;
    let topic = session.topic(&args.topic)?;
    session.listen([topic])?;
    let (mut seen, mut shown) = (0, 0);
    let mut out = std::io::stdout().lock();
    let going = session.follow(
        |_, message| {
            seen += 1;
            if (seen - 1) % args.every != 0 {
                return Ok(true);
            }
            if shown == 0 && message.message().get::<HeaderOnly>().is_some() {
                let (message, _) = topic.schema();
                crate::say(&format!(
                    "topic `{topic}`: this program does not know `{message}`; it shows only the header"
                ));
            }
            let value = message.message().to_json()?;
            // A closed pipe (`| head`) is the end, not an error.
            let written = if args.json { writeln!(out, "{value}") } else { writeln!(out, "{}---", as_text(&value)) };
            shown += 1;
            Ok(written.and_then(|()| out.flush()).is_ok() && args.count.is_none_or(|count| shown < count))
        },
        || Ok(()),
    )?;
    session.say_end(going);
    Ok(())
}
