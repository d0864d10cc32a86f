//! Tests of sending and receiving within one process.

#![allow(clippy::unwrap_used, reason = "a helper of a test fails it by panicking")]

use crate::common::{TestRun, frame, in_seconds, posterior};
use carff_messages::Message;
use carff_transport::{
    Node, OpenError, Run, SendError, Stop, Waiter, Woken, living_processes, monotonic_now_ns, topics,
};

/// The newest message wins: of three messages the last is received, and two are counted as skipped.
#[test]
fn newest_wins_and_skips_are_counted() {
    let run = TestRun::new();
    let node = Node::open(&run.0, "test").unwrap();
    let mut input = node.receiver(&topics::POSTERIOR).unwrap();
    let mut output = node.publisher(&topics::POSTERIOR).unwrap();
    for frame_id in 0..3 {
        output.send(posterior(frame_id)).unwrap();
    }
    let newest = input.newest().unwrap().unwrap();
    assert_eq!((newest.header.frame_id, newest.header.sequence, newest.header.run_id), (2, 2, 77));
    assert!(newest.header.publish_time_ns > 0);
    assert!(input.newest().unwrap().is_none());
    let counters = node.counters();
    assert_eq!((counters.published(), counters.received(), counters.skipped()), (3, 3, 2));
}

/// A slow reader loses the oldest messages, the sender never fails, and the remaining messages arrive in order.
#[test]
fn overflow_loses_the_oldest_and_never_stops_the_sender() {
    let run = TestRun::new();
    let node = Node::open(&run.0, "test").unwrap();
    let mut input = node.receiver(&topics::POSTERIOR).unwrap();
    let mut output = node.publisher(&topics::POSTERIOR).unwrap();
    let sent = 100;
    for frame_id in 0..sent {
        output.send(posterior(frame_id)).unwrap();
    }
    let mut got = Vec::new();
    while let Some(sample) = input.next().unwrap() {
        got.push(sample.header.frame_id);
    }
    let buffer = topics::POSTERIOR.limits.buffer as u64;
    assert_eq!(got, (sent - buffer..sent).collect::<Vec<_>>());
}

/// Messages with a NaN, of another schema or of another run are dropped and counted; a valid message after them
/// arrives.
#[test]
fn invalid_messages_are_dropped_and_counted() {
    let run = TestRun::new();
    let node = Node::open(&run.0, "test").unwrap();
    let mut input = node.receiver(&topics::POSTERIOR).unwrap();
    let mut output = node.publisher(&topics::POSTERIOR).unwrap();

    let mut bad = posterior(1);
    bad.gaussian.mean[4] = f32::NAN;
    assert!(matches!(output.send(bad), Err(SendError::Invalid { .. })), "the sender refuses it too");
    bad.header_mut().run_id = 77;
    output.send_unchecked(bad).unwrap();
    let mut other_schema = posterior(2);
    (other_schema.header.run_id, other_schema.header.schema_version) = (77, 999);
    output.send_unchecked(other_schema).unwrap();
    let mut other_run = posterior(3);
    other_run.header.run_id = 78;
    output.send_unchecked(other_run).unwrap();
    output.send(posterior(4)).unwrap();

    assert_eq!(input.next().unwrap().unwrap().header.frame_id, 4);
    assert!(input.next().unwrap().is_none());
    assert_eq!((node.counters().invalid(), node.counters().received()), (3, 1));
}

/// An image whose size differs from its description is refused by the sender and dropped by the receiver.
#[test]
fn images_must_have_the_size_they_claim() {
    let run = TestRun::new();
    let node = Node::open(&run.0, "test").unwrap();
    let mut input = node.receiver(&topics::FRAME).unwrap();
    let mut output = node.image_publisher(&topics::FRAME, 8 * 4 * 3).unwrap();
    assert!(matches!(output.loan(8 * 4 * 3 + 1), Err(SendError::Size { .. })));

    let loan = output.loan(8 * 3 * 3).unwrap();
    assert!(matches!(output.send_image(loan, frame(0, 8, 4)), Err(SendError::Size { .. })));
    let mut meta = frame(1, 8, 4);
    meta.header.run_id = 77;
    let loan = output.loan(8 * 3 * 3).unwrap();
    output.send_image_unchecked(loan, meta).unwrap();

    let mut loan = output.loan(8 * 4 * 3).unwrap();
    loan.bytes_mut()[95] = 200;
    output.send_image(loan, frame(2, 8, 4)).unwrap();
    let image = input.newest().unwrap().unwrap();
    assert_eq!((image.header.frame_id, image.bytes().len(), image.bytes()[95]), (2, 96, 200));
    assert_eq!(node.counters().invalid(), 1);
}

/// A wait ends by input, by time and by stop; input from before the wait counts too.
#[test]
fn waits_end_for_three_reasons() {
    let run = TestRun::new();
    let node = Node::open(&run.0, "test").unwrap();
    let mut posteriors = node.receiver(&topics::POSTERIOR).unwrap();
    let beliefs = node.receiver(&topics::BELIEF).unwrap();
    let mut output = node.publisher(&topics::POSTERIOR).unwrap();
    let waiter = Waiter::new(Stop::new().unwrap());

    assert_eq!(waiter.wait_until(&[&posteriors, &beliefs], monotonic_now_ns() + 1_000_000).unwrap(), Woken::Timeout);
    output.send(posterior(0)).unwrap();
    for _ in 0..2 {
        // The message is still there until it is received.
        assert_eq!(waiter.wait_until(&[&posteriors, &beliefs], in_seconds(30)).unwrap(), Woken::Input);
    }
    assert!(posteriors.newest().unwrap().is_some());

    let stop = waiter.stop().clone();
    let stopper = std::thread::spawn(move || stop.stop());
    assert_eq!(waiter.wait_until(&[&posteriors, &beliefs], in_seconds(30)).unwrap(), Woken::Stopped);
    stopper.join().unwrap();
}

/// Two simultaneous runs with the same topics do not see each other's messages.
#[test]
fn runs_do_not_see_each_other() {
    let (run_a, run_b) = (TestRun::new(), TestRun::new());
    let (node_a, node_b) = (Node::open(&run_a.0, "a").unwrap(), Node::open(&run_b.0, "b").unwrap());
    let mut input_b = node_b.receiver(&topics::POSTERIOR).unwrap();
    let mut input_a = node_a.receiver(&topics::POSTERIOR).unwrap();
    let mut output_a = node_a.publisher(&topics::POSTERIOR).unwrap();
    output_a.send(posterior(5)).unwrap();
    assert!(input_b.newest().unwrap().is_none());
    assert_eq!(input_a.newest().unwrap().unwrap().header.frame_id, 5);
}

/// One subscriber too many gets an error that names the topic and the limit.
#[test]
fn limits_of_the_table_hold() {
    let run = TestRun::new();
    let node = Node::open(&run.0, "test").unwrap();
    let max = topics::FRAME.limits.max_subscribers;
    let held: Vec<_> = (0..max).map(|_| node.receiver(&topics::FRAME).unwrap()).collect();
    let error = node.receiver(&topics::FRAME).unwrap_err();
    assert!(matches!(&error, OpenError::TooMany { .. }), "{error}");
    assert!(error.to_string().contains("camera/frame") && error.to_string().contains(&max.to_string()), "{error}");
    drop(held);
    node.receiver(&topics::FRAME).unwrap();
}

/// A segment that does not fit into shared memory is refused before it is created.
#[test]
fn an_oversized_segment_is_refused_before_it_is_made() {
    let run = TestRun::new();
    let node = Node::open(&run.0, "test").unwrap();
    let error = node.image_publisher(&topics::FRAME, 1 << 50).unwrap_err();
    assert!(matches!(&error, OpenError::SharedMemoryFull { .. }), "{error}");
    assert!(error.to_string().contains("camera/frame"), "{error}");
}

/// A closed node leaves no topic in shared memory, and no file after the final clean-up.
#[test]
fn a_clean_stop_leaves_nothing() {
    let run = TestRun::new();
    {
        let node = Node::open(&run.0, "test").unwrap();
        let _input = node.receiver(&topics::POSTERIOR).unwrap();
        let mut output = node.publisher(&topics::POSTERIOR).unwrap();
        output.send(posterior(0)).unwrap();
        assert!(!run.0.shared_memory_files().unwrap().is_empty());
    }
    let left = run.0.shared_memory_files().unwrap();
    assert!(left.iter().all(|f| f.to_string_lossy().contains("global_mgmt")), "{left:?}");
    carff_transport::remove_run_leftovers(&run.0).unwrap();
    assert!(run.0.shared_memory_files().unwrap().is_empty());
    assert!(!run.0.folder().exists());
    // A clean-up without files is not an error.
    carff_transport::remove_run_leftovers(&Run::new("never-existed", 0).unwrap()).unwrap();
}

/// A receiver without wake-ups receives messages during its wait, times out, and reacts to a stop; others on the same
/// topic are still woken.
#[test]
fn polled_receivers_need_no_wake_up() {
    let run = TestRun::new();
    let node = Node::open(&run.0, "test").unwrap();
    let mut polled = node.receiver(&topics::POSTERIOR).unwrap().polled();
    let mut woken = node.receiver(&topics::POSTERIOR).unwrap();
    let stop = Stop::new().unwrap();
    let waiter = Waiter::new(stop.clone());
    assert_eq!(waiter.wait_until(&[&polled], monotonic_now_ns() + 1_000_000).unwrap(), Woken::Timeout);
    let theirs = run.0.clone();
    let (all_read, wait_for_reads) = std::sync::mpsc::channel::<()>();
    let sender = std::thread::spawn(move || {
        let node = Node::open(&theirs, "sender").unwrap();
        let mut output = node.publisher(&topics::POSTERIOR).unwrap();
        std::thread::sleep(std::time::Duration::from_millis(20));
        output.send(posterior(5)).unwrap();
        let _ = wait_for_reads.recv();
    });
    assert_eq!(waiter.wait_until(&[&polled], in_seconds(30)).unwrap(), Woken::Input);
    assert_eq!(polled.next().unwrap().unwrap().header.frame_id, 5);
    assert_eq!(waiter.wait_until(&[&woken], in_seconds(30)).unwrap(), Woken::Input);
    assert_eq!(woken.next().unwrap().unwrap().header.frame_id, 5);
    drop(all_read);
    sender.join().unwrap();
    stop.stop();
    assert_eq!(waiter.wait(&[&polled]).unwrap(), Woken::Stopped);
}

/// An image from other memory arrives complete; one whose size differs from its description is refused.
#[test]
fn images_are_sent_from_elsewhere() {
    let run = TestRun::new();
    let node = Node::open(&run.0, "test").unwrap();
    let mut input = node.receiver(&topics::FRAME).unwrap();
    let mut output = node.image_publisher(&topics::FRAME, 1000).unwrap();
    let meta = frame(3, 4, 5);
    let bytes: Vec<u8> = (0..meta.width_px * meta.height_px * 3).map(|i| i as u8).collect();
    output.send_bytes(&bytes, meta).unwrap();
    let image = input.next().unwrap().unwrap();
    assert_eq!((image.bytes(), image.header.frame_id), (&bytes[..], 3));
    let error = output.send_bytes(&bytes[1..], meta).unwrap_err();
    assert!(matches!(error, SendError::Size { .. }), "{error}");
    let error = output.send_bytes(&[0; 1001], meta).unwrap_err();
    assert!(matches!(error, SendError::Size { max: 1000, .. }), "{error}");
    assert!(input.next().unwrap().is_none());
}

/// Listing a run's processes never fails while they and the run's folder come and go.
#[test]
fn a_run_that_comes_and_goes_can_be_listed() {
    let run = TestRun::new();
    let theirs = run.0.clone();
    let coming_and_going = std::thread::spawn(move || {
        for _ in 0..200 {
            drop(Node::open(&theirs, "guest").unwrap());
            carff_transport::remove_run_leftovers(&theirs).unwrap();
        }
    });
    while !coming_and_going.is_finished() {
        let living = living_processes(&run.0).unwrap();
        assert!(living.iter().all(|pid| *pid == std::process::id()), "{living:?}");
    }
    coming_and_going.join().unwrap();
    assert_eq!(living_processes(&run.0).unwrap(), Vec::<u32>::new());
}
