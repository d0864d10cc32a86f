//! Tests of probes, recordings and replays on whole graphs, attached as a user does from another terminal.

#![allow(clippy::unwrap_used, reason = "a helper of a test fails it by panicking")]

use carff_messages::Stage;
use carff_observe::attach;
use carff_tests::{
    Finished, PATIENT, PATIENT_AND_ENDLESS, Process, TestGraph, WATCHDOG, decisions, eventually, program, scenario_set,
    shipped_checkpoint, skipped,
};
use carff_transport::{OpenError, TopicId};
use foxglove::Decode as _;
use foxglove::messages::RawImage;
use rustix::process::Signal;
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::io::{Read as _, Write as _};
use std::net::{Ipv4Addr, TcpStream};
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Instant;
use tungstenite::client::IntoClientRequest as _;
use tungstenite::{Message, WebSocket};

fn running() -> (TestGraph, Process) {
    let graph = TestGraph::new(&scenario_set(), &shipped_checkpoint(), PATIENT_AND_ENDLESS);
    let mut launcher = Process::start(&mut graph.launch(&graph.file(), &[]));
    launcher.wait_for("decision", |text| text.contains("hazard "));
    (graph, launcher)
}

fn carff(graph: &TestGraph, words: &[&str], rest: &[&str]) -> Process {
    let mut command = Command::new(program("carff"));
    command.current_dir(graph.file().parent().unwrap()).args(words).args(["--run", graph.run().name()]).args(rest);
    Process::start(&mut command)
}

#[track_caller]
fn probe(graph: &TestGraph, words: &[&str], rest: &[&str]) -> String {
    let words: Vec<&str> = std::iter::once("probe").chain(words.iter().copied()).collect();
    let finished = carff(graph, &words, rest).end();
    finished.assert_success();
    finished.text
}

fn stop(graph: &TestGraph, launcher: Process) {
    launcher.signal(Signal::INT);
    let finished = launcher.end();
    assert_eq!(finished.status.code(), Some(130), "{}", finished.text);
    graph.assert_nothing_left();
}

/// Loading libtorch takes thirty times the start of a probe: programs that compute no tensors are not linked with it.
/// (On request, the dynamic loader lists the libraries that it would load, and ends.)
#[test]
fn what_needs_no_tensors_is_not_linked_with_libtorch() {
    let loads = |name: &str| {
        let output = Command::new(program(name)).env("LD_TRACE_LOADED_OBJECTS", "1").output().unwrap();
        let text = String::from_utf8(output.stdout).unwrap();
        assert!(text.contains("libc.so"), "{name}: {text}");
        text.contains("libtorch")
    };
    assert!(loads("carff-lab") && loads("carff-encoder-tch"));
    let stages = Stage::ALL.map(|stage| format!("carff-{stage}"));
    for name in stages.iter().map(String::as_str).chain(["carff", "carff-launch"]) {
        assert!(!loads(name), "{name} is linked with libtorch");
    }
}

/// Every probe shows the running graph without configuration; the graph's decisions continue, and nothing is left at
/// the end.
#[test]
fn probes_show_what_runs() {
    let (graph, launcher) = running();

    let topics: Value = serde_json::from_str(&probe(&graph, &["list"], &["--json", "--seconds", "2"])).unwrap();
    let topic = |name: &str| topics.as_array().unwrap().iter().find(|t| t["topic"] == name).unwrap().clone();
    assert_eq!(topic("encoder/posterior")["publishers"], serde_json::json!(["encoder"]));
    assert_eq!(topic("prober/belief")["type"], "carff.Belief.v5");
    let listeners = topic("prober/belief")["subscribers"].to_string();
    assert!(listeners.contains("controller") && listeners.contains("forecaster"), "{listeners}");
    assert!(topic("controller/action")["rate_hz"].as_f64().unwrap() > 0.0, "{topics:#}");
    let drawn = probe(&graph, &["graph"], &["--format", "mermaid"]);
    assert!(drawn.contains("p_prober --> t_prober_belief"), "{drawn}");

    let text = probe(&graph, &["echo", "belief"], &["--json", "--count", "3"]);
    let beliefs: Vec<Value> = text.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    assert_eq!(beliefs.len(), 3);
    assert!(beliefs.iter().all(|b| b["header"]["run_id"].as_str().is_some_and(|id| id.len() == 16)), "{text}");
    let rate = probe(&graph, &["hz", "camera/frame"], &["--count", "5"]);
    assert!(rate.contains(" Hz ") && rate.contains("between messages, ms"), "{rate}");
    let bandwidth = probe(&graph, &["bw", "frame"], &["--count", "5"]);
    assert!(bandwidth.contains("per second") && bandwidth.contains("size, bytes"), "{bandwidth}");
    let delay = probe(&graph, &["delay", "action"], &["--count", "5"]);
    assert!(delay.contains("age on arrival, ms"), "{delay}");
    let shown = probe(&graph, &["image", "camera/frame"], &["--as", "kitty", "--count", "1"]);
    assert!(
        shown.starts_with("\x1b_Ga=T,f=100,") && shown.trim_end().ends_with(|c: char| c.is_ascii_digit()),
        "{shown}"
    );
    probe(&graph, &["image", "camera/frame"], &["-o", "images", "--count", "2"]);
    let images: Vec<_> = std::fs::read_dir(graph.path("images")).unwrap().map(|e| e.unwrap().path()).collect();
    assert_eq!(images.len(), 2);
    assert!(carff_dataset::Image::load(&images[0]).is_ok());
    let belief = probe(&graph, &["belief"], &["--count", "1"]);
    assert!(belief.contains("step 1 of 2") && belief.contains("unknown"), "{belief}");
    // A busy machine has no time for the decision on some frames.
    let stages = ["camera", "encoder", "forecaster", "prober", "controller"];
    let is_whole = |trace: &String| stages.iter().all(|stage| trace.lines().any(|line| line.starts_with(stage)));
    let mut traces = (0..20).map(|_| probe(&graph, &["trace", "next"], &["--perfetto", "trace.json"]));
    let trace = traces.find(is_whole).expect("a frame with a decision");
    let events: Value = serde_json::from_str(&std::fs::read_to_string(graph.path("trace.json")).unwrap()).unwrap();
    assert!(events["traceEvents"].as_array().is_some_and(|e| e.iter().any(|e| e["cat"] == "encoder")), "{events}");
    let traced = trace.split_once("frame ").and_then(|(_, rest)| rest.split(',').next()).unwrap().to_owned();
    // The times, without their bars: what arrives later changes their scale.
    let is_of_controller = |line: &&str| line.starts_with("controller");
    let way = |text: &str| text.lines().filter(is_of_controller).collect::<String>().replace(['━', '·'], "");
    let past = probe(&graph, &["trace", &traced], &[]);
    assert!(!way(&past).is_empty() && way(&past) == way(&trace), "{past}\n{trace}");
    let top = probe(&graph, &["top", "--once"], &[]);
    assert!(stages.iter().all(|stage| top.contains(stage)) && top.contains(graph.run().name()), "{top}");
    let status = carff(&graph, &["metrics", "--once"], &[]).end();
    status.assert_success();
    let status: Value = serde_json::from_str(&status.text).unwrap();
    assert!(status["stages"]["prober"]["messages"].as_u64().is_some_and(|n| n > 0), "{status:#}");

    let unknown = carff(&graph, &["probe", "echo", "beleif"], &[]).end();
    assert!(unknown.text.contains("did you mean `prober/belief`"), "{}", unknown.text);
    stop(&graph, launcher);
    let ended = probe(&graph, &["trace", &traced], &[]);
    assert_eq!(way(&ended), way(&trace));
}

/// Probes that come, go and are killed leave the graph running and nothing behind. If all slots of a topic are in use,
/// the next probe gets an error, and a probe that leaves frees its slot.
#[test]
fn probes_come_and_go() {
    let (graph, mut launcher) = running();
    for _ in 0..10 {
        let probe = carff(&graph, &["probe", "echo", "frame"], &["--json"]);
        assert!(eventually(|| !probe.text().is_empty()), "{}", launcher.text());
        probe.signal(Signal::KILL);
        assert!(!probe.end().status.success());
    }
    probe(&graph, &["echo", "frame"], &["--count", "1"]);
    let before = decisions(&launcher.text());
    launcher.wait_for("further decisions", |text| decisions(text) > before);

    let here = attach(Some(graph.run().name()), "crowd").unwrap();
    let mut crowd = Vec::new();
    let full = loop {
        match TopicId::FRAME.polled_receiver(&here.node) {
            Ok(receiver) => crowd.push(receiver),
            Err(error) => break error,
        }
        assert!(crowd.len() < 20);
    };
    assert!(matches!(full, OpenError::TooMany { .. }), "{full}");
    let told = carff(&graph, &["probe", "echo", "frame"], &["--count", "1"]).end();
    told.assert_one_error(&["camera/frame", "in use"]);
    crowd.pop();
    probe(&graph, &["echo", "frame"], &["--count", "1"]);
    drop((crowd, here));

    // A probe that cannot report the end of the run ends with it all the same.
    let mut command = Command::new("sh");
    command.args(["-c", "exec \"$0\" \"$@\" 2> /dev/full"]).arg(program("carff"));
    let mut deaf = Process::start(command.args(["probe", "echo", "action", "--json", "--run", graph.run().name()]));
    deaf.wait_for("an action", |text| !text.is_empty());
    launcher.signal(Signal::INT);
    assert_eq!(deaf.end().status.code(), Some(0));
    assert_eq!(launcher.end().status.code(), Some(130));
    graph.assert_nothing_left();
}

fn replay(graph: &TestGraph, words: &[&str]) -> Finished {
    carff(graph, &[&["replay", "run.mcap"], words].concat(), &[]).end()
}

fn export(graph: &TestGraph, words: &[&str]) -> Finished {
    let mut command = Command::new(program("carff"));
    command.current_dir(graph.file().parent().unwrap()).arg("export").args(words);
    Process::start(&mut command).end()
}

/// Writes a recording as other tools do: sorted by topic, without metadata, and only with the kept topics.
fn rewrite(from: &Path, to: &Path, kept: impl Fn(&str) -> bool) {
    let bytes = std::fs::read(from).unwrap();
    let mut messages: Vec<_> = mcap::MessageStream::new(&bytes).unwrap().map(Result::unwrap).collect();
    messages.retain(|message| kept(&message.channel.topic));
    messages.sort_by(|a, b| a.channel.topic.cmp(&b.channel.topic));
    let mut writer = mcap::Writer::new(std::fs::File::create(to).unwrap()).unwrap();
    for message in &messages {
        writer.write(message).unwrap();
    }
    writer.finish().unwrap();
}

/// A recording that another tool has rewritten is exported and replayed; what it lacks is named.
fn rewritten_recordings_are_read(graph: &TestGraph) {
    rewrite(&graph.path("run.mcap"), &graph.path("sorted.mcap"), |_| true);
    let replay = |words: &[&str]| carff(graph, &[&["replay"], words].concat(), &[]).end();
    replay(&["sorted.mcap"]).assert_one_error(&["sorted.mcap", "no metadata", "--graph"]);
    let same = replay(&["sorted.mcap", "--verify", "--graph", "graph.toml"]);
    same.assert_success();
    assert!(same.text.contains("all equal, bit for bit"), "{}", same.text);

    rewrite(&graph.path("run.mcap"), &graph.path("filtered.mcap"), |topic| !topic.ends_with("/image"));
    export(graph, &["filtered.mcap", "--csv", "filtered"]).assert_success();
    assert_eq!(rows(&graph.path("filtered/camera-frame.csv")), rows(&graph.path("csv/camera-frame.csv")));
    replay(&["filtered.mcap"]).assert_one_error(&["filtered.mcap", "no messages on `camera/image`", "camera/frame"]);
    export(graph, &["filtered.mcap", "--png", "none"]).assert_one_error(&["`camera/image`"]);
}

/// Returns hazard probability and action of each printed decision.
fn decided(text: &str) -> Vec<String> {
    let decision = |line: &str| Some(line.split_once("hazard ")?.1.rsplit_once("  ")?.0.trim().to_owned());
    text.lines().filter(|line| line.trim_end().ends_with(" ms")).filter_map(decision).collect()
}

/// Returns the number of rows of a table; 0 if it does not exist.
fn rows(path: &Path) -> usize {
    std::fs::read_to_string(path).map_or(0, |text| text.lines().count().saturating_sub(1))
}

/// A recording replayed through the same graph gives the same beliefs and decisions, bit for bit. A graph that draws
/// fewer samples gives others, and the first difference is reported. The data for other tools can be exported.
#[test]
fn a_recording_is_decided_again_as_it_was() {
    let (graph, launcher) = running();
    let text = std::fs::read_to_string(graph.file()).unwrap();
    carff(&graph, &["record"], &["-o", "run.mcap", "--seconds", "5"]).end().assert_success();
    let live = decided(&launcher.text());
    stop(&graph, launcher);

    let same = replay(&graph, &["--verify"]);
    same.assert_success();
    assert!(same.text.contains("all equal, bit for bit"), "{}", same.text);
    graph.assert_nothing_left();

    std::fs::write(graph.path("other.toml"), text.replacen("[run]\n", "[run]\nsamples = 4\n", 1)).unwrap();
    let other = replay(&graph, &["--verify", "--graph", "other.toml"]);
    assert_eq!(other.status.code(), Some(1), "{}", other.text);
    let first = other.text.lines().find_map(|line| line.strip_prefix("first difference: frame ")).unwrap_or_default();
    // The recorder may join after the first forecast of a frame, which has the samples' number, or after both.
    let firsts = ["10 entries in the recording, 4", ", forecast of step 2: `", ", decision: `"];
    assert!(firsts.iter().any(|expected| first.contains(expected)), "{}", other.text);
    graph.assert_nothing_left();

    // Replay from the middle of the path: recorded beliefs lead to the recorded decisions, in their order.
    let only = carff(&graph, &["replay", "run.mcap", "--only", "belief", "--to", "1.5"], &[]).end();
    only.assert_success();
    let (again, mut recorded) = (decided(&only.text), live.iter());
    assert!(!again.is_empty() && again.iter().all(|d| recorded.any(|r| r == d)), "{again:?}\n{live:?}");
    graph.assert_nothing_left();

    for range in [["--from", "1e9", "--to", "2e9"], ["--from", "2", "--to", "1"]] {
        let none = carff(&graph, &[&["replay", "run.mcap"], &range[..]].concat(), &[]).end();
        none.assert_one_error(&["run.mcap", "has no message to replay from"]);
    }

    export(&graph, &["run.mcap", "--png", "png", "--csv", "csv", "--mp4", "film.mp4", "--trace", "t.json"])
        .assert_success();
    assert!(std::fs::read(graph.path("film.mp4")).unwrap()[4..].starts_with(b"ftyp"));
    let frames = rows(&graph.path("csv/camera-frame.csv"));
    assert!(frames > 0);
    let images = std::fs::read_dir(graph.path("png")).unwrap().flatten();
    assert_eq!(images.filter(|e| e.file_name().to_string_lossy().starts_with("frame-")).count(), frames);
    rewritten_recordings_are_read(&graph);
}

/// With comparisons that count for the next frame, a recording is decided again as it was. The first frame of a take is
/// answered safely, because nothing has been compared yet.
#[test]
fn comparisons_count_for_the_next_frame() {
    let rest = format!("[checks]\ncompare = \"next-frame\"\n{PATIENT}");
    let graph = TestGraph::new(&scenario_set(), &shipped_checkpoint(), &rest);
    let mut launcher =
        Process::start(&mut graph.launch(&graph.file(), &["--drives", "4", "--decisions", "decisions.jsonl"]));
    launcher.wait_for("decision", |text| text.contains("hazard "));
    carff(&graph, &["record"], &["-o", "run.mcap"]).end().assert_success();
    launcher.end().assert_success();
    let lines = std::fs::read_to_string(graph.path("decisions.jsonl")).unwrap();
    let first: Value = serde_json::from_str(lines.lines().next().unwrap()).unwrap();
    assert_eq!(first["action"], "halt", "{first}");
    assert!(first["unknown"].as_f64() > Some(0.8), "{first}");
    let same = replay(&graph, &["--verify"]);
    same.assert_success();
    assert!(same.text.contains("all equal, bit for bit"), "{}", same.text);
    graph.assert_nothing_left();
}

/// A recorder that is killed leaves its written messages; a second recording of the same name is refused.
#[test]
fn a_killed_recorder_leaves_its_recording() {
    let (graph, launcher) = running();
    let recorder = carff(&graph, &["record"], &["-o", "run.mcap"]);
    let readable = || {
        let finished = export(&graph, &["run.mcap", "--csv", "csv"]);
        finished.status.success() && rows(&graph.path("csv/controller-action.csv")) > 0
    };
    // The recording is readable while it is written.
    assert!(eventually(readable), "{}", recorder.text());
    recorder.signal(Signal::KILL);
    recorder.end();
    assert!(readable());
    carff(&graph, &["record"], &["-o", "run.mcap"]).end().assert_one_error(&["run.mcap", "exists"]);
    stop(&graph, launcher);
}

/// Fails if Prometheus's own check finds fault with a metrics page; skipped where it is not installed.
#[track_caller]
fn promtool_accepts(page: &str) {
    let mut command = Command::new("promtool");
    command.args(["check", "metrics"]).stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped());
    let Ok(mut promtool) = command.spawn() else { return skipped("promtool is missing") };
    promtool.stdin.take().unwrap().write_all(page.as_bytes()).unwrap();
    let output = promtool.wait_with_output().unwrap();
    let text = String::from_utf8_lossy(&output.stdout) + String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success() && text.trim().is_empty(), "{text}\n{page}");
}

/// Connections that send no request do not end `carff metrics`, and do not keep others out, although they are more than
/// the files that it may open.
#[test]
fn metrics_survive_idle_connections() {
    let (graph, launcher) = running();
    let mut command = Command::new("sh");
    command.args(["-c", "ulimit -n 256; exec \"$0\" \"$@\""]).arg(program("carff")).args(["metrics", "--run"]);
    let mut metrics = Process::start(command.arg(graph.run().name()).args(["--listen", "127.0.0.1:0"]));
    metrics.wait_for("address", |text| text.contains("/status"));
    let address = metrics.text().split(['/', ' ']).nth(2).unwrap().to_owned();
    let connect = |sent: &str| {
        let mut stream = TcpStream::connect(&address).unwrap();
        stream.set_read_timeout(Some(WATCHDOG)).unwrap();
        stream.write_all(sent.as_bytes()).unwrap();
        stream
    };
    let idle: Vec<TcpStream> = (0..400).map(|_| connect("GET /metrics HTTP/1.1\r\nX-")).collect();
    let mut text = String::new();
    connect("GET /metrics HTTP/1.1\r\n\r\n").read_to_string(&mut text).unwrap();
    assert!(text.starts_with("HTTP/1.1 200 OK") && text.contains("carff_frames_total{"), "{text}");
    let origin = ["version=", "commit=", "host=", "started=", "checkpoint_sha256="];
    assert!(text.lines().any(|l| l.starts_with("carff_build_info{") && origin.iter().all(|o| l.contains(o))), "{text}");
    promtool_accepts(text.split_once("\r\n\r\n").unwrap().1);
    drop(idle);
    metrics.signal(Signal::INT);
    let finished = metrics.end();
    assert_eq!((finished.status.code(), finished.text.lines().count()), (Some(130), 1), "{}", finished.text);
    stop(&graph, launcher);
}

/// Fails if a stage was restarted, had an error, or dropped an input as invalid.
#[track_caller]
fn assert_unharmed(graph: &TestGraph) {
    let status = carff(graph, &["metrics", "--once"], &[]).end();
    status.assert_success();
    let status: Value = serde_json::from_str(&status.text).unwrap();
    for (stage, vitals) in status["stages"].as_object().unwrap() {
        for count in ["restarts", "errors", "invalid"] {
            assert_eq!(vitals[count], 0, "{count} of {stage}: {status:#}");
        }
    }
}

/// On a full disk the recorder reports it in one sentence and ends. Its written messages are readable, and the graph
/// continues unaffected.
#[test]
fn a_full_disk_ends_the_recording_alone() {
    let (graph, mut launcher) = running();
    // The disk is in memory, has a megabyte, and is only visible to the recorder. Inside, switch back to this user: the
    // run's folder is named after the user.
    let user = rustix::process::getuid();
    let (enter, back) = if user.is_root() {
        (vec!["--mount"], String::new())
    } else {
        (vec!["--user", "--map-root-user", "--mount"], format!("unshare --user --map-user={} ", user.as_raw()))
    };
    let on_small_disk = |what: &str| {
        let mut command = Command::new("unshare");
        command.current_dir(graph.file().parent().unwrap()).args(&enter).args(["sh", "-c"]);
        command.arg(format!("mount -t tmpfs -o size=1m tmpfs disk && {what}"));
        command.arg("sh").arg(program("carff")).args(["record", "--run", graph.run().name(), "-o", "disk/run.mcap"]);
        Process::start(&mut command).end()
    };
    std::fs::create_dir(graph.path("disk")).unwrap();
    if !on_small_disk(&format!("{back}true")).status.success() {
        skipped("this system does not let users mount");
        stop(&graph, launcher);
        return;
    }
    let recorder = on_small_disk(&format!("{back}\"$@\"; code=$?; cp disk/run.mcap kept.mcap; exit $code"));
    recorder.assert_one_error(&["disk/run.mcap", "No space left", "is readable"]);

    let before = decisions(&launcher.text());
    launcher.wait_for("further decisions", |text| decisions(text) > before);
    assert_unharmed(&graph);
    assert!(std::fs::metadata(graph.path("kept.mcap")).unwrap().len() > 500_000);
    export(&graph, &["kept.mcap", "--csv", "csv"]).assert_success();
    let kept =
        ["camera-frame", "prober-belief", "controller-action"].map(|t| rows(&graph.path(&format!("csv/{t}.csv"))));
    assert!(kept.iter().all(|&rows| rows > 0), "{kept:?}");
    stop(&graph, launcher);
}

/// On a disk that takes eight seconds for each of its first writes the recorder drops whole messages, reports and
/// counts them, and continues. Its file is valid, and the graph's decisions are unaffected.
#[test]
fn a_slow_disk_costs_messages_alone() {
    let (graph, mut launcher) = running();
    let folder = graph.file().parent().unwrap().canonicalize().unwrap();
    let path = folder.join("run.mcap");
    // strace delays the system call itself, and the recorder is this test's own child under it.
    let slow = |program: &Path| {
        let mut command = Command::new("strace");
        command.current_dir(&folder).args(["-D", "-f", "-qq", "--seccomp-bpf", "-o", "/dev/null", "-P"]).arg(&path);
        command.args(["-e", "trace=write", "-e", "inject=write:delay_exit=8000000:when=1..2"]).arg(program);
        command
    };
    if !slow(Path::new("true")).status().is_ok_and(|status| status.success()) {
        skipped("strace is missing, or may not trace");
        stop(&graph, launcher);
        return;
    }
    let mut record = slow(&program("carff"));
    record.args(["record", "--run", graph.run().name(), "--queue-mb", "1", "-o"]).arg(&path);
    let mut recorder = Process::start(&mut record);
    recorder.wait_for("a report of the slow disk", |text| text.contains("the disk is too slow"));
    let before = decisions(&launcher.text());
    launcher.wait_for("further decisions", |text| decisions(text) > before);
    assert_unharmed(&graph);

    recorder.signal(Signal::INT);
    let finished = recorder.end();
    assert_eq!(finished.status.code(), Some(130), "{}", finished.text);
    let counts: Vec<usize> = finished.text.lines().last().unwrap().split(' ').filter_map(|w| w.parse().ok()).collect();
    let [written, dropped] = counts[..] else { panic!("{}", finished.text) };
    assert!(written > 0 && dropped > 0, "{}", finished.text);
    export(&graph, &["run.mcap", "--csv", "csv"]).assert_success();
    let tables = std::fs::read_dir(graph.path("csv")).unwrap().flatten();
    assert_eq!(tables.map(|table| rows(&table.path())).sum::<usize>(), written);
    stop(&graph, launcher);
}

/// A client of the Foxglove WebSocket protocol, version 1, with its subscriptions.
struct Client(WebSocket<TcpStream>, Value);

impl Client {
    fn connect(port: u16, protocol: Option<&'static str>) -> Result<Self, String> {
        let stream = TcpStream::connect((Ipv4Addr::LOCALHOST, port)).unwrap();
        stream.set_read_timeout(Some(WATCHDOG)).unwrap();
        let mut request = format!("ws://127.0.0.1:{port}").into_client_request().unwrap();
        if let Some(protocol) = protocol {
            request.headers_mut().insert("Sec-WebSocket-Protocol", protocol.parse().unwrap());
        }
        tungstenite::client(request, stream)
            .map(|(socket, _)| Self(socket, Value::Null))
            .map_err(|error| error.to_string())
    }

    fn say(&mut self, what: &Value) {
        self.0.send(Message::text(what.to_string())).unwrap();
    }

    /// Returns what `select` takes from the next messages; fails at the watchdog's limit, with other messages too.
    fn next<T>(&mut self, what: &str, select: impl Fn(Message) -> Option<T>) -> T {
        let deadline = Instant::now() + WATCHDOG;
        let mut others = 0;
        loop {
            match select(self.0.read().unwrap()) {
                Some(found) => return found,
                None => others += 1,
            }
            assert!(Instant::now() < deadline, "no {what} within {WATCHDOG:?}, but {others} other messages");
        }
    }

    /// Returns the next text message of a kind.
    fn hear(&mut self, op: &str) -> Value {
        self.next(op, |message| {
            let Message::Text(text) = message else { return None };
            let said: Value = serde_json::from_str(&text).unwrap();
            // Warnings, such as one of a repeated subscription, do not count as answers.
            (said["op"] == op && said["level"].as_u64().is_none_or(|level| level == 2)).then_some(said)
        })
    }

    /// Returns the next data of a subscription, and its time, nanoseconds since 1970.
    fn receive(&mut self, subscription: u32) -> (u64, Vec<u8>) {
        loop {
            let received = self.next("data", |message| match message {
                // The server advertises a channel a moment before it accepts subscriptions to it.
                Message::Text(text) => text.contains("Unknown channel ID").then_some(None),
                Message::Binary(bytes) => {
                    let (kind, rest) = bytes.split_first().unwrap();
                    let (id, rest) = rest.split_first_chunk().unwrap();
                    let (time_ns, data) = rest.split_first_chunk().unwrap();
                    let wanted = *kind == 1 && u32::from_le_bytes(*id) == subscription;
                    wanted.then(|| Some((u64::from_le_bytes(*time_ns), data.to_vec())))
                }
                _ => None,
            });
            match received {
                Some(received) => return received,
                None => self.say(&self.1.clone()),
            }
        }
    }
}

/// A client of the Foxglove protocol finds the topics, subscribes and gets messages that it can read, in JSON and in
/// protobuf; it cannot publish. By default the bridge only listens on this machine.
#[test]
fn a_bridge_serves_clients_that_only_look() {
    let (graph, launcher) = running();
    let remote = carff(&graph, &["bridge", "--listen", "0.0.0.0:0"], &[]).end();
    remote.assert_one_error(&["0.0.0.0", "--remote"]);
    let mut bridge = carff(&graph, &["bridge", "--listen", "127.0.0.1:0"], &[]);
    bridge.wait_for("address", |text| text.contains("ws://127.0.0.1:") && text.ends_with('\n'));
    let port: u16 = bridge.text().trim().rsplit_once(':').unwrap().1.parse().unwrap();
    // A bridge that listens on all addresses listens on this one too.
    assert!(TcpStream::connect((Ipv4Addr::new(127, 0, 0, 2), port)).is_err());

    assert!(Client::connect(port, None).is_err() && Client::connect(port, Some("chat")).is_err());
    let mut client = Client::connect(port, Some("foxglove.sdk.v1")).unwrap();
    let info = client.hear("serverInfo");
    assert!(info["name"].as_str().unwrap().contains(graph.run().name()), "{info}");
    assert_eq!(info["capabilities"], json!([]));
    let mut channels = BTreeMap::new();
    while !["prober/belief", "camera/image"].iter().all(|topic| channels.contains_key(*topic)) {
        for channel in client.hear("advertise")["channels"].as_array().unwrap() {
            channels.insert(channel["topic"].as_str().unwrap().to_owned(), channel.clone());
        }
    }
    let (belief, image) = (&channels["prober/belief"], &channels["camera/image"]);
    assert_eq!((&belief["encoding"], &belief["schemaName"]), (&json!("json"), &json!("carff.Belief")));
    let schema: Value = serde_json::from_str(belief["schema"].as_str().unwrap()).unwrap();
    assert!(schema["properties"]["hazard_probability"].is_object(), "{schema}");
    assert_eq!((&image["encoding"], &image["schemaName"]), (&json!("protobuf"), &json!("foxglove.RawImage")));

    client.1 = json!({ "op": "subscribe", "subscriptions": [
        { "id": 7, "channelId": belief["id"] }, { "id": 8, "channelId": image["id"] },
    ] });
    client.say(&client.1.clone());
    let run_id = format!("{:016x}", attach(Some(graph.run().name()), "test").unwrap().live.run_id);
    let belief_of = |(_, data): (u64, Vec<u8>)| serde_json::from_slice::<Value>(&data).unwrap();
    let (first_ns, data) = client.receive(7);
    let belief = belief_of((first_ns, data));
    assert_eq!(belief["header"]["run_id"], run_id.as_str());
    assert!(belief["hazard_probability"].as_f64().is_some_and(|p| (0.0..=1.0).contains(&p)), "{belief}");
    let image = RawImage::decode(&client.receive(8).1[..]).unwrap();
    assert_eq!((image.encoding.as_str(), image.step), ("rgb8", image.width * 3));
    assert!(image.height > 0 && image.data.len() as u32 == image.step * image.height);

    // The client's own action is not accepted as a channel, and its data is not forwarded.
    client.say(&json!({ "op": "advertise", "channels": [
        { "id": 1, "topic": "controller/action", "encoding": "json", "schemaName": "carff.Action" },
    ] }));
    let refused = client.hear("status");
    assert!(refused["level"] == 2 && refused["message"].as_str().unwrap().contains("clientPublish"), "{refused}");
    client.0.send(Message::binary([&[1], &1_u32.to_le_bytes()[..], b"{}"].concat())).unwrap();
    let refused = client.hear("status");
    assert!(refused["level"] == 2 && refused["message"].as_str().unwrap().contains("nknown channel"), "{refused}");
    assert!(client.receive(7).0 > first_ns, "it still runs");
    let topics: Value = serde_json::from_str(&probe(&graph, &["list"], &["--json", "--seconds", "1"])).unwrap();
    let actions = topics.as_array().unwrap().iter().find(|t| t["topic"] == "controller/action").unwrap();
    assert_eq!(actions["publishers"], json!(["controller"]));
    assert_unharmed(&graph);

    // The client is still connected, and does not read any more: the bridge does not wait for it.
    bridge.signal(Signal::INT);
    assert_eq!(bridge.end().status.code(), Some(130));
    stop(&graph, launcher);
}
