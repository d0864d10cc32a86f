//! Tests of every reader with examples, with kept inputs, and with mutations of both.

#![allow(clippy::unwrap_used, reason = "a helper of a test fails it by panicking")]

use carff_base::random::{Key, stream};
use carff_readers::{READERS, Reader};
use rand::Rng;

/// Number of mutations of each input; fuzzing (`make fuzz`) tries millions.
const MUTATIONS: u64 = 300;
/// Longer inputs than this are mutated less often, so that all readers take a similar time.
const SHORT_BYTES: usize = 4096;

fn kept(reader: &Reader) -> Vec<Vec<u8>> {
    let mut paths: Vec<_> =
        std::fs::read_dir(reader.kept()).into_iter().flatten().flatten().map(|e| e.path()).collect();
    paths.sort();
    paths.iter().map(|path| std::fs::read(path).unwrap()).collect()
}

/// Returns the input with a few changed bytes or pieces, as after disk errors, edits or attacks.
fn mutated(input: &[u8], rng: &mut impl Rng) -> Vec<u8> {
    let mut bytes = input.to_vec();
    for _ in 0..rng.random_range(1..=4) {
        let at = rng.random_range(0..=bytes.len());
        let end = (at + rng.random_range(1..=16)).min(bytes.len());
        match rng.random_range(0..6) {
            0 => bytes.truncate(at),
            1 => bytes[at..end].fill_with(|| rng.random()),
            2 => drop(bytes.drain(at..end)),
            3 => {
                let piece = bytes[at..end].to_vec();
                let to = rng.random_range(0..=bytes.len());
                drop(bytes.splice(to..to, piece));
            }
            4 => {
                let numbers: [&[u8]; 8] =
                    [b"-1", b"0", b"1e999", b"NaN", b"null", b"18446744073709551616", b"[]", b"\xff\xff\xff\x7f"];
                drop(bytes.splice(at..end, numbers[rng.random_range(0..numbers.len())].iter().copied()));
            }
            _ => {
                // One digit becomes another: the result is well formed, with another meaning.
                let digits: Vec<usize> = (0..bytes.len()).filter(|i| bytes[*i].is_ascii_digit()).collect();
                if !digits.is_empty() {
                    bytes[digits[rng.random_range(0..digits.len())]] = b'0' + rng.random_range(0..10);
                }
            }
        }
    }
    bytes
}

/// Examples are accepted; kept inputs and mutations of all are accepted or refused with a message; nothing panics.
fn holds(name: &str) {
    let reader = READERS.iter().find(|r| r.name == name).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let examples = reader.examples(folder.path());
    for (i, example) in examples.iter().enumerate() {
        assert_eq!(reader.read(example, folder.path()), Ok(()), "example {i}");
    }
    let inputs = [examples, kept(reader)].concat();
    assert!(!inputs.is_empty(), "there are no inputs");
    let (mut accepted, mut refused) = (0, 0);
    for (i, input) in inputs.iter().enumerate() {
        let _ = reader.read(input, folder.path());
        let count = if input.len() > SHORT_BYTES { MUTATIONS / 10 } else { MUTATIONS };
        for n in 0..count {
            let mut rng = stream(Key { seed: 1, frame: i as u64, step: 0x7265_6164, sample: n as u32 });
            match reader.read(&mutated(input, &mut rng), folder.path()) {
                Ok(()) => accepted += 1,
                Err(_) => refused += 1,
            }
        }
    }
    assert!(accepted + refused > 0 && refused > 0, "{accepted} accepted, {refused} refused");
}

macro_rules! readers {
    ($($test:ident $name:literal),+) => {
        $(
            #[test]
            fn $test() {
                holds($name);
            }
        )+

        /// Every reader has a test.
        #[test]
        fn all_readers_are_tested() {
            assert_eq!(READERS.map(|r| r.name), [$($name),+]);
        }
    };
}

readers!(
    messages "messages",
    graphs "graph",
    scenarios "scenario",
    soak_files "soak",
    training_files "training",
    data_sets "dataset",
    plain_sets "import",
    images "png",
    thresholds "planning",
    manifests "manifest",
    field_weights "weights",
    recordings "recording",
    bags "bag",
    calibrations "calibration",
    run_records "run-record"
);
