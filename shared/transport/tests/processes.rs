//! Tests of sending and receiving between processes, and of leftovers of killed processes.

#![allow(clippy::unwrap_used, reason = "a helper of a test fails it by panicking")]

use crate::common;

use crate::common::{Role, TestRun, frame, in_seconds, posterior};
use carff_transport::{
    INTERRUPTED, Node, Stop, Waiter, Woken, cleanup_dead, exit_on_signals, is_interrupted, monotonic_now_ns, topics,
};
use rustix::process::Signal;
use std::io::{BufRead, BufReader, Write};
use std::time::Duration;

const SIDE: u32 = 32;
const BYTES: usize = (SIDE * SIDE * 3) as usize;

/// Acts as the other process of a test. Without a role it does nothing: that is the test program's own run.
#[test]
fn role() {
    let Some((role, run)) = common::role() else { return };
    if role == "hasty" {
        take_and_give_back_signals();
    }
    let stop = Stop::on_signals().unwrap();
    let waiter = Waiter::new(stop.clone());
    let node = Node::open(&run, &role).unwrap();
    match role.as_str() {
        // Sends an image for each line of standard input.
        "camera" => {
            let mut output = node.image_publisher(&topics::FRAME, BYTES).unwrap();
            println!("ready");
            for (i, _) in std::io::stdin().lines().enumerate() {
                let mut loan = output.loan(BYTES).unwrap();
                loan.bytes_mut().fill(i as u8 + 1);
                output.send_image(loan, frame(i as u64, SIDE, SIDE)).unwrap();
            }
        }
        // Holds loaned memory until it is killed.
        "loaner" => {
            let output = node.image_publisher(&topics::FRAME, BYTES).unwrap();
            let _loan = output.loan(BYTES).unwrap();
            println!("ready");
            waiter.wait_until(&[], in_seconds(60)).unwrap();
        }
        // Receives until a signal stops it; then ends cleanly.
        "reader" => {
            let mut input = node.receiver(&topics::POSTERIOR).unwrap();
            println!("ready");
            while waiter.wait_until(&[&input], in_seconds(60)).unwrap() == Woken::Input {
                if let Some(sample) = input.newest().unwrap() {
                    println!("frame {}", sample.header.frame_id);
                }
            }
            println!("stopped {}", stop.is_stopped());
        }
        other => panic!("unknown role {other}"),
    }
}

/// Takes the signals and gives them back over and over, until one has come.
fn take_and_give_back_signals() -> ! {
    exit_on_signals().unwrap();
    println!("ready");
    while !is_interrupted() {
        drop(Stop::on_signals().unwrap());
    }
    std::process::exit(i32::from(INTERRUPTED));
}

/// No signal is lost while a stop takes the signals or gives them back.
#[test]
fn signals_are_never_lost() {
    let run = TestRun::new();
    for _ in 0..10 {
        let mut hasty = Role::start("hasty", &run.0);
        wait_for(&mut lines(&mut hasty), "ready");
        hasty.signal(Signal::TERM);
        let watchdog_ns = in_seconds(30);
        let status = loop {
            if let Some(status) = hasty.0.try_wait().unwrap() {
                break status;
            }
            assert!(monotonic_now_ns() < watchdog_ns, "the signal is lost");
            std::thread::sleep(Duration::from_millis(1));
        };
        assert_eq!(status.code(), Some(i32::from(INTERRUPTED)));
    }
}

/// Returns the lines that a role prints, without the test harness's own.
fn lines(child: &mut Role) -> impl Iterator<Item = String> + use<> {
    let stdout = child.0.stdout.take().unwrap();
    BufReader::new(stdout).lines().map_while(Result::ok)
}

fn wait_for(lines: &mut impl Iterator<Item = String>, wanted: &str) {
    assert!(lines.any(|line| line.ends_with(wanted)), "the other process ended without `{wanted}`");
}

/// Zero copy: the receiver reads an address inside a mapping of the publisher's data segment, which the other process
/// created in shared memory. A second image is read in place too.
#[test]
fn images_are_read_in_the_publishers_segment() {
    let run = TestRun::new();
    let node = Node::open(&run.0, "test").unwrap();
    let mut input = node.receiver(&topics::FRAME).unwrap();
    let waiter = Waiter::new(Stop::new().unwrap());
    let mut camera = Role::start("camera", &run.0);
    let mut output = lines(&mut camera);
    wait_for(&mut output, "ready");
    for i in 0..3_u8 {
        writeln!(camera.0.stdin.as_mut().unwrap(), "next").unwrap();
        assert_eq!(waiter.wait_until(&[&input], in_seconds(30)).unwrap(), Woken::Input);
        let image = input.newest().unwrap().unwrap();
        assert!(image.bytes().iter().all(|&b| b == i + 1));
        let (first, last) = (image.bytes().as_ptr() as usize, &raw const image.bytes()[BYTES - 1] as usize);
        let mapping = mapping_of(first).expect("the address is in a mapping of a file");
        assert!(mapping.range.contains(&last), "the mapping contains the whole image");
        assert!(mapping.file.contains(&run.0.shared_memory_prefix()), "{}", mapping.file);
        assert!(mapping.file.contains(".data"), "it is a data segment: {}", mapping.file);
    }
    drop(camera.0.stdin.take());
    assert!(camera.0.wait().unwrap().success());
}

struct Mapping {
    range: std::ops::Range<usize>,
    file: String,
}

/// Returns the file mapping of this process that contains an address.
fn mapping_of(address: usize) -> Option<Mapping> {
    std::fs::read_to_string("/proc/self/maps").unwrap().lines().find_map(|line| {
        let mut fields = line.split_whitespace();
        let (start, end) = fields.next()?.split_once('-')?;
        let range = usize::from_str_radix(start, 16).ok()?..usize::from_str_radix(end, 16).ok()?;
        let file = fields.nth(4)?.to_owned();
        range.contains(&address).then_some(Mapping { range, file })
    })
}

/// A publisher that is killed during a loan does not block its successor: after the clean-up a new one can send.
#[test]
fn a_publisher_killed_in_mid_loan_is_replaced() {
    let run = TestRun::new();
    let node = Node::open(&run.0, "test").unwrap();
    let mut input = node.receiver(&topics::FRAME).unwrap();
    let waiter = Waiter::new(Stop::new().unwrap());
    for _ in 0..3 {
        let mut loaner = Role::start("loaner", &run.0);
        wait_for(&mut lines(&mut loaner), "ready");
        loaner.kill();
        assert_eq!(cleanup_dead(&run.0).unwrap(), 1);
    }
    let mut camera = Role::start("camera", &run.0);
    wait_for(&mut lines(&mut camera), "ready");
    writeln!(camera.0.stdin.as_mut().unwrap(), "next").unwrap();
    assert_eq!(waiter.wait_until(&[&input], in_seconds(30)).unwrap(), Woken::Input);
    assert_eq!(input.newest().unwrap().unwrap().bytes()[0], 1);
}

/// A stopped (SIGSTOP) or killed subscriber does not block the publisher, and a signal ends a wait cleanly.
#[test]
fn no_subscriber_delays_a_publisher_and_signals_end_waits() {
    let run = TestRun::new();
    let node = Node::open(&run.0, "test").unwrap();
    let mut output = node.publisher(&topics::POSTERIOR).unwrap();
    let mut readers: Vec<_> = (0..3).map(|_| Role::start("reader", &run.0)).collect();
    let mut printed: Vec<_> = readers.iter_mut().map(lines).collect();
    for lines in &mut printed {
        wait_for(lines, "ready");
    }
    readers[0].signal(Signal::STOP);
    readers[1].kill();
    for frame_id in 0..2000 {
        output.send(posterior(frame_id)).unwrap();
    }
    wait_for(&mut printed[2], "frame 1999");
    readers[2].signal(Signal::TERM);
    wait_for(&mut printed[2], "stopped true");
    assert!(readers[2].0.wait().unwrap().success());
    readers[0].signal(Signal::CONT);
    wait_for(&mut printed[0], "frame 1999");
}

/// Killing all processes leaves files; the removal for dead runs removes all of them.
#[test]
fn leftovers_of_killed_processes_can_be_removed() {
    let run = TestRun::new();
    let mut roles = [Role::start("loaner", &run.0), Role::start("reader", &run.0)];
    for child in &mut roles {
        wait_for(&mut lines(child), "ready");
    }
    roles.iter_mut().for_each(Role::kill);
    assert!(!run.0.shared_memory_files().unwrap().is_empty());
    carff_transport::remove_run_leftovers(&run.0).unwrap();
    assert!(run.0.shared_memory_files().unwrap().is_empty());
    assert!(!run.0.folder().exists());
}
