//! Recordings as other tools rewrite them.

use super::*;
use carff_messages::SCHEMA_VERSION;
use mcap::records::{MessageHeader, Metadata};
use mcap::{Compression, WriteOptions};
use std::collections::BTreeMap;
use std::io::Cursor;

const FRAMES: u64 = 30;

/// Position of the metadata.
#[derive(Clone, Copy, PartialEq)]
enum Place {
    First,
    Last,
    Dropped,
}

/// A message of a file: topic, encoding, schema, header, data.
type Copied = (String, String, mcap::Schema<'static>, MessageHeader, Vec<u8>);

type Options = fn() -> WriteOptions;

fn recording(folder: &Path) -> std::path::PathBuf {
    let path = folder.join("run.mcap");
    let mut writer = Writer::create(&path, &about(), &places()).unwrap();
    for (topic, message) in (0..FRAMES).flat_map(messages) {
        writer.write(topic, message.as_message()).unwrap();
    }
    writer.finish().unwrap();
    path
}

fn copied(path: &Path) -> Vec<Copied> {
    let bytes = std::fs::read(path).unwrap();
    let messages = mcap::MessageStream::new(&bytes).unwrap().map(Result::unwrap);
    let of = |m: mcap::Message<'_>| {
        let schema = m.channel.schema.as_deref().unwrap();
        let schema = mcap::Schema {
            id: schema.id,
            name: schema.name.clone(),
            encoding: schema.encoding.clone(),
            data: schema.data.to_vec().into(),
        };
        let header =
            MessageHeader { channel_id: 0, sequence: m.sequence, log_time: m.log_time, publish_time: m.publish_time };
        (m.channel.topic.clone(), m.channel.message_encoding.clone(), schema, header, m.data.to_vec())
    };
    messages.map(of).collect()
}

fn write(path: &Path, messages: &[Copied], options: WriteOptions, metadata: Place) {
    let mut out = Cursor::new(Vec::new());
    let mut writer = options.library("another tool").create(&mut out).unwrap();
    let record = Metadata { name: "carff".to_owned(), metadata: about().to_metadata() };
    if metadata == Place::First {
        writer.write_metadata(&record).unwrap();
    }
    for (topic, encoding, schema, header, data) in messages {
        let schema = writer.add_schema(&schema.name, &schema.encoding, &schema.data).unwrap();
        let channel_id = writer.add_channel(schema, topic, encoding, &BTreeMap::new()).unwrap();
        writer.write_to_known_channel(&MessageHeader { channel_id, ..*header }, data).unwrap();
    }
    if metadata == Place::Last {
        writer.write_metadata(&record).unwrap();
    }
    writer.finish().unwrap();
    drop(writer);
    std::fs::write(path, out.into_inner()).unwrap();
}

/// Every message is read, with its image and in the order of publication, from any order of the file, with or without
/// chunks, index, compression and metadata.
#[test]
fn all_messages_are_read_from_any_layout() {
    let folder = tempfile::tempdir().unwrap();
    let original = copied(&recording(folder.path()));
    let mut by_topic = original.clone();
    by_topic.sort_by(|a, b| a.0.cmp(&b.0));
    let mut backwards = original.clone();
    backwards.reverse();
    backwards.sort_by_key(|m| std::cmp::Reverse(m.3.publish_time));
    let restamped: Vec<Copied> = (0..)
        .zip(&original)
        .map(|(i, m)| (m.0.clone(), m.1.clone(), m.2.clone(), MessageHeader { log_time: i, ..m.3 }, m.4.clone()))
        .collect();
    let layouts: [(&str, Options); 6] = [
        ("zstd", || WriteOptions::new().chunk_size(Some(2_000))),
        ("lz4", || WriteOptions::new().compression(Some(Compression::Lz4)).chunk_size(Some(50_000))),
        ("plain", || WriteOptions::new().compression(None)),
        ("one chunk", || WriteOptions::new().chunk_size(None)),
        ("no chunks", || WriteOptions::new().use_chunks(false)),
        ("no index", || {
            let options = WriteOptions::new().emit_summary_records(false).emit_summary_offsets(false);
            options.emit_message_indexes(false).repeat_channels(false).repeat_schemas(false)
        }),
    ];
    let path = folder.path().join("rewritten.mcap");
    for (layout, options) in layouts {
        for (order, messages) in
            [("as written", &original), ("by topic", &by_topic), ("backwards", &backwards), ("restamped", &restamped)]
        {
            for metadata in [Place::First, Place::Last, Place::Dropped] {
                write(&path, messages, options(), metadata);
                let (entries, cut_off) = read(&path);
                // Messages of the same time have the order of the file.
                let expected: Vec<_> = (0..FRAMES).flat_map(self::messages).collect();
                let is_same = |f: &Entry| {
                    let same = |(topic, m): &(TopicId, OwnedMessage)| {
                        f.topic == *topic && same(f.message.as_message(), m.as_message())
                    };
                    expected.iter().any(same)
                };
                let what = format!("{layout}, {order}");
                assert!(!cut_off && entries.len() == expected.len() && entries.iter().all(is_same), "{what}");
                assert!(entries.is_sorted_by_key(|e| e.wall_time_ns), "{what}");
                let about = Reader::open(&path).unwrap().about().cloned();
                assert_eq!(about, (metadata != Place::Dropped).then(self::about), "{what}");
            }
        }
    }
}

/// Messages are readable without their images. A selection of missing topics, or of topics whose images are missing,
/// is refused by the names of what is missing and of what is present.
#[test]
fn missing_topics_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let original = copied(&recording(folder.path()));
    let path = folder.path().join("filtered.mcap");
    let keep = |kept: &dyn Fn(&str) -> bool| {
        let messages: Vec<_> = original.iter().filter(|m| kept(&m.0)).cloned().collect();
        write(&path, &messages, WriteOptions::new(), Place::Dropped);
        Reader::open(&path).unwrap()
    };
    let count = |mut reader: Reader| {
        let mut entries = 0;
        while reader.next().unwrap().is_some() {
            entries += 1;
        }
        entries
    };

    let is_image = |topic: &str| topic.ends_with("/image");
    assert_eq!(count(keep(&|topic| !is_image(topic)).without_images()), 5 * FRAMES);
    let error = keep(&|topic| !is_image(topic)).select([TopicId::FRAME]).unwrap_err().to_string();
    assert!(error.contains("no messages on `camera/image`") && error.contains("camera/frame, camera/pose"), "{error}");
    // An image whose description exists is an error of that message, and the next message is read.
    let mut reader = keep(&|topic| topic != "camera/image");
    assert!(reader.next().unwrap_err().to_string().contains("its image is missing on `camera/image`"));
    assert_eq!(reader.next().unwrap().unwrap().topic, TopicId::POSTERIOR);

    let beliefs = |topic: &str| ["prober/belief", "controller/action"].contains(&topic);
    let mut reader = keep(&beliefs);
    assert!(reader.has(TopicId::BELIEF) && !reader.has(TopicId::FRAME));
    let error = reader.select([TopicId::FRAME, TopicId::ACTION]).unwrap_err().to_string();
    assert!(error.contains("`camera/frame`, `camera/image`; its topics: controller/action, prober/belief"), "{error}");
    reader.select([TopicId::BELIEF]).unwrap();
    assert_eq!(count(reader), FRAMES);
}

/// Recordings of two runs that a tool has merged are refused where the second run begins, because frames of both have the
/// same numbers. Parts of one run may be merged.
#[test]
fn merged_runs_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let original = copied(&recording(folder.path()));
    let path = folder.path().join("merged.mcap");
    let half = original.len() / 2;
    let parts = [&original[half..], &original[..half]].concat();
    write(&path, &parts, WriteOptions::new(), Place::First);
    assert_eq!(read(&path).0.len(), messages(0).len() * FRAMES as usize);

    let other_run = |mut message: Copied| {
        // Only the JSON forms have the id.
        if let Ok(text) = std::str::from_utf8(&message.4) {
            message.4 = text.replace("\"0000000000000005\"", "\"0000000000000006\"").into_bytes();
        }
        message.3.publish_time += 1_000_000_000_000;
        message
    };
    let both: Vec<Copied> = original.iter().cloned().chain(original.iter().cloned().map(other_run)).collect();
    write(&path, &both, WriteOptions::new(), Place::First);
    let mut reader = Reader::open(&path).unwrap();
    let mut entries = 0;
    let error = loop {
        match reader.next() {
            Ok(entry) => entries += u64::from(entry.is_some()),
            Err(error) => break error.to_string(),
        }
        assert!(entries <= 6 * FRAMES, "the second run was read");
    };
    assert_eq!(entries, messages(0).len() as u64 * FRAMES);
    assert!(error.contains("merged.mcap has messages of two runs (0000000000000005 and 0000000000000006)"), "{error}");
}

/// A file without topics of a run is refused by its topics, also if one has a name of this program, but another
/// encoding. A recording of another format is refused.
#[test]
fn foreign_files_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("foreign.mcap");
    let schema =
        mcap::Schema { id: 1, name: "std_msgs/msg/String".into(), encoding: "ros2msg".into(), data: vec![].into() };
    let header = MessageHeader { channel_id: 0, sequence: 0, log_time: 1, publish_time: 1 };
    let message = |topic: &str| (topic.to_owned(), "cdr".to_owned(), schema.clone(), header, vec![0, 1, 0, 0]);
    write(&path, &[message("/chatter"), message("camera/frame")], WriteOptions::new(), Place::Dropped);
    let error = Reader::open(&path).unwrap_err().to_string();
    assert!(error.contains("not a recording of this program") && error.contains("/chatter, camera/frame"), "{error}");

    // With topics of a run, the others are passed over.
    let mut messages = copied(&recording(folder.path()));
    messages.insert(0, message("camera/image"));
    write(&path, &messages, WriteOptions::new(), Place::First);
    assert!(matches(&read(&path).0, 0..FRAMES));

    let mut writer = WriteOptions::new().create(std::fs::File::create(&path).unwrap()).unwrap();
    let metadata = [("format".to_owned(), "99".to_owned())].into();
    writer.write_metadata(&Metadata { name: "carff".to_owned(), metadata }).unwrap();
    writer.finish().unwrap();
    assert!(matches!(Reader::open(&path), Err(RecordingError::Format { .. })));

    // Nothing, or less than the first bytes of the format.
    for bytes in [&mcap::MAGIC[..0], &mcap::MAGIC[..3], b"{}"] {
        std::fs::write(&path, bytes).unwrap();
        let error = Reader::open(&path).unwrap_err().to_string();
        assert!(error.contains("foreign.mcap is damaged, or is not an MCAP file"), "{error}");
    }
}

/// A recording with one channel for all views, as older versions wrote it, is read.
#[test]
fn older_recordings_are_read() {
    let folder = tempfile::tempdir().unwrap();
    let mut messages = copied(&recording(folder.path()));
    for message in messages.iter_mut().filter(|m| m.0.starts_with("renderer/") && m.0.ends_with("/image")) {
        message.0 = "renderer/image".to_owned();
    }
    let path = folder.path().join("old.mcap");
    write(&path, &messages, WriteOptions::new(), Place::First);
    assert!(matches(&read(&path).0, 0..FRAMES));
}

/// A recording with another version of the messages is refused with both versions and the remedy, for messages by
/// themselves and for images.
#[test]
fn other_versions_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let original = recording(folder.path());
    for channel in ["prober/belief", "camera/frame"] {
        let mut messages = copied(&original);
        for (.., data) in messages.iter_mut().filter(|m| m.0 == channel) {
            let mut form: serde_json::Value = serde_json::from_slice(data).unwrap();
            form["header"]["schema_version"] = (SCHEMA_VERSION - 1).into();
            *data = serde_json::to_vec(&form).unwrap();
        }
        let path = folder.path().join("old.mcap");
        write(&path, &messages, WriteOptions::new(), Place::First);
        for mut reader in [Reader::open(&path).unwrap(), Reader::open(&path).unwrap().without_images()] {
            let error = loop {
                match reader.next() {
                    Ok(entry) => assert!(entry.is_some(), "no error"),
                    Err(error) => break error.to_string(),
                }
            };
            let earlier = format!("version {} of the messages", SCHEMA_VERSION - 1);
            assert!(error.contains(channel) && error.contains(&earlier), "{error}");
            let own = format!("reads version {SCHEMA_VERSION}");
            assert!(error.contains(&own) && error.contains("the version of carff"), "{error}");
        }
    }
}
