//! Joins a running graph and publishes a speed limit: `speed-gate [RUN]`.

use carff_observe::{Attached, attach};
use carff_transport::{Stop, Waiter, Woken, monotonic_now_ns, topics};
use speed_gate::{SPEED_LIMIT, SpeedLimit};

/// Longest sleep before a check that the run is alive.
const PATIENCE_NS: u64 = 1_000_000_000;

fn main() -> anyhow::Result<()> {
    let run = std::env::args().nth(1);
    let Attached { node, live } = attach(run.as_deref(), "speed-gate")?;
    let mut beliefs = node.receiver(&topics::BELIEF)?;
    let mut actions = node.receiver(&topics::ACTION)?;
    let mut limits = node.publisher(&SPEED_LIMIT)?;
    let waiter = Waiter::new(Stop::on_signals()?);
    let mut belief = None;
    println!("joined run `{}`", live.name);
    loop {
        match waiter.wait_until(&[&beliefs, &actions], monotonic_now_ns() + PATIENCE_NS)? {
            Woken::Stopped => break,
            Woken::Timeout if !live.is_alive() => break,
            _ => {}
        }
        if let Some(newest) = beliefs.newest()? {
            belief = Some(*newest);
        }
        while let Some(action) = actions.next()? {
            limits.send(SpeedLimit::of(&action, belief.as_ref()))?;
        }
    }
    println!("left run `{}`", live.name);
    Ok(())
}
