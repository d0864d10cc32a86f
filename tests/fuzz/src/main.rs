//! Fuzzes the reader that the variable `CARFF_READER` names. The variable `CARFF_SEEDS` names a folder, to which the
//! reader's examples are written first. `make fuzz` runs this program for every reader.

#![no_main]

use carff_readers::{READERS, Reader};
use libfuzzer_sys::fuzz_target;
use std::env::var;
use std::path::Path;
use std::sync::LazyLock;

static READER: LazyLock<Reader> = LazyLock::new(|| {
    let names = READERS.map(|r| r.name).join(", ");
    let name = var("CARFF_READER").unwrap_or_default();
    *READERS.iter().find(|r| r.name == name).unwrap_or_else(|| panic!("CARFF_READER must be one of {names}"))
});

static FOLDER: LazyLock<tempfile::TempDir> = LazyLock::new(|| tempfile::tempdir().expect("a folder to write to"));

fuzz_target!(
    init: {
        if let Ok(seeds) = var("CARFF_SEEDS") {
            for (i, example) in READER.examples(FOLDER.path()).iter().enumerate() {
                std::fs::write(Path::new(&seeds).join(format!("example-{i}")), example).expect("a folder to write to");
            }
        }
    },
    |bytes: &[u8]| {
        let _ = READER.read(bytes, FOLDER.path());
    }
);
