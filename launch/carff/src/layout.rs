//! The layouts of the messages in shared memory, for programs in other languages.
//!
//! [`python`] and [`c`] write them as source text. Both texts contain sizes and offsets as this compiler lays them out,
//! and check them: Python when the module is imported, C and C++ when the header is compiled.

use carff_messages::{
    Action, ActionCode, Belief, DatasetView, Forecast, ForecastSource, FrameMeta, Gaussian, Header, Health,
    HealthState, Intrinsics, LATENT_DIM, MAX_COMPONENTS, MAX_HORIZON, MAX_IMAGE_BYTES, MAX_PLACES, MAX_SAMPLES,
    MAX_SIDE_PX, MAX_STATES, Observability, Posterior, ProbeResult, Reason, Rule, SCHEMA_VERSION, Stage, ViewKind,
    ViewMeta,
};
use carff_transport::{Limits, Payload, Topic, topics};
use iceoryx2::service::static_config::message_type_details::{TypeDetail, TypeVariant};
use std::fmt::Write as _;
use std::mem::offset_of;

/// Type of a field.
#[derive(Clone, Debug)]
enum Kind {
    /// A number, by its names in Python's ctypes and in C.
    Number([&'static str; 2]),
    /// An array with its length.
    Array(Box<Kind>, usize),
    /// Another structure.
    Struct(&'static str),
}

/// A type that a field can have.
trait Laid {
    fn kind() -> Kind;
}

macro_rules! numbers {
    ($($type:ty: $ctypes:literal $c:literal),+) => {
        $(impl Laid for $type { fn kind() -> Kind { Kind::Number([$ctypes, $c]) } })+
    };
}

numbers!(u8: "c_uint8" "uint8_t", u32: "c_uint32" "uint32_t", i32: "c_int32" "int32_t", u64: "c_uint64" "uint64_t",
    f32: "c_float" "float", f64: "c_double" "double");

impl<T: Laid, const N: usize> Laid for [T; N] {
    fn kind() -> Kind {
        Kind::Array(Box::new(T::kind()), N)
    }
}

#[derive(Clone, Debug)]
struct Field {
    name: &'static str,
    kind: Kind,
    offset: usize,
    size: usize,
    alignment: usize,
}

#[derive(Clone, Debug)]
struct Struct {
    name: &'static str,
    detail: TypeDetail,
    fields: Vec<Field>,
}

/// Describes a field; its type is that of the function that borrows it.
fn field<S, F: Laid>(name: &'static str, offset: usize, _: fn(&S) -> &F) -> Field {
    Field { name, kind: F::kind(), offset, size: size_of::<F>(), alignment: align_of::<F>() }
}

/// Adds a field to the fields before it, and before it the private field that fills a gap of four bytes.
fn append(mut fields: Vec<Field>, next: Field) -> Vec<Field> {
    let end = fields.last().map_or(0, |last| last.offset + last.size);
    if next.offset == end.next_multiple_of(next.alignment) + 4 {
        fields.push(Field { name: RESERVED, kind: u32::kind(), offset: end, size: 4, alignment: 4 });
    }
    fields.push(next);
    fields
}

/// Name of private fields, which are 0.
const RESERVED: &str = "reserved";

macro_rules! structs {
    ($($type:ident { $($field:ident),+ })+) => {
        $(impl Laid for $type { fn kind() -> Kind { Kind::Struct(stringify!($type)) } })+

        /// Returns all structures, each after those that it contains.
        fn structs() -> Vec<Struct> {
            vec![$(Struct {
                name: stringify!($type),
                detail: TypeDetail::new::<$type>(TypeVariant::FixedSize),
                fields: [
                    $(field(stringify!($field), offset_of!($type, $field), |all: &$type| &all.$field)),+
                ].into_iter().fold(Vec::new(), append),
            }),+]
        }
    };
}

structs! {
    Header { schema_version, step, run_id, frame_id, sequence, capture_time_ns, publish_time_ns, seed }
    Intrinsics { fl_x_px, fl_y_px, cx_px, cy_px }
    DatasetView { known, view, branch, timestamp, drive, frame_in_drive, observability, last_of_timestamp }
    FrameMeta { header, width_px, height_px, intrinsics, world_from_camera, dataset_view }
    ViewMeta {
        header, hypothesis, kind, state, width_px, height_px, probability, latent, intrinsics, world_from_camera,
        stage_latency_ns
    }
    Gaussian { mean, log_variance }
    Posterior { header, gaussian, stage_latency_ns }
    Forecast {
        header, source, component_count, sample_count, horizon, resolved_state, path_probability, weights, components,
        samples, sample_component, encoder_ns, stage_latency_ns
    }
    ProbeResult { state, confidence, hazard_likelihood, occupancies }
    Belief {
        header, horizon, state_count, place_count, component_count, sample_count, is_final, state_probability,
        hazard_probability, path_probability, component_weights, components, samples, sample_component, resolved_state,
        resolved, encoder_ns, forecaster_ns, stage_latency_ns
    }
    Action {
        header, action, reason, rule, sample_count, confidence, hazard_probability, is_decision, valid_until_ns,
        based_on_frame, latency_ns
    }
    Health {
        header, stage, state, pid, received, published, skipped, invalid, errors, last_latency_ns, max_latency_ns,
        last_progress_ns, rss_bytes
    }
}

/// Returns the limits and versions of the messages.
fn constants() -> [(&'static str, u64); 9] {
    [
        ("SCHEMA_VERSION", SCHEMA_VERSION.into()),
        ("LATENT_DIM", LATENT_DIM as u64),
        ("MAX_COMPONENTS", MAX_COMPONENTS as u64),
        ("MAX_SAMPLES", MAX_SAMPLES as u64),
        ("MAX_STATES", MAX_STATES as u64),
        ("MAX_PLACES", MAX_PLACES as u64),
        ("MAX_HORIZON", MAX_HORIZON.into()),
        ("MAX_SIDE_PX", MAX_SIDE_PX.into()),
        ("MAX_IMAGE_BYTES", MAX_IMAGE_BYTES as u64),
    ]
}

/// Codes of a field, by name.
type Codes = (&'static str, Vec<(String, i64)>);

fn codes() -> Vec<Codes> {
    macro_rules! codes {
        ($($type:ident),+) => {
            vec![$((stringify!($type), $type::ALL.map(|v| (upper(v.name()), i64::from(v.code()))).to_vec())),+]
        };
    }
    codes!(Stage, ActionCode, Reason, Rule, ForecastSource, Observability, ViewKind, HealthState)
}

/// Returns a name in the form of constants: `NO_BELIEF_YET`.
fn upper(name: &str) -> String {
    name.chars().map(|c| if c.is_ascii_alphanumeric() { c.to_ascii_uppercase() } else { '_' }).collect()
}

/// Name, message type, payload form and limits of a topic.
struct OneTopic {
    name: &'static str,
    message: &'static str,
    is_image: bool,
    limits: Limits,
}

fn topic<P: Payload>(topic: &Topic<P>) -> OneTopic {
    let message = std::any::type_name::<P::Message>().rsplit("::").next().unwrap_or_default();
    OneTopic { name: topic.name, message, is_image: P::IS_IMAGE, limits: topic.limits }
}

fn all_topics() -> Vec<OneTopic> {
    let mut all = vec![
        topic(&topics::FRAME),
        topic(&topics::POSTERIOR),
        topic(&topics::FORECAST),
        topic(&topics::BELIEF),
        topic(&topics::VIEW),
        topic(&topics::ACTION),
    ];
    all.extend(Stage::ALL.map(|stage| topic(topics::health(stage))));
    all
}

impl Kind {
    fn python(&self) -> String {
        match self {
            Self::Number([ctypes, _]) => format!("ctypes.{ctypes}"),
            Self::Array(of, length) => format!("({} * {length})", of.python()),
            Self::Struct(name) => (*name).to_owned(),
        }
    }

    /// Returns the element type, and the lengths as they follow a name.
    fn c(&self) -> (String, String) {
        match self {
            Self::Number([_, c]) => ((*c).to_owned(), String::new()),
            Self::Array(of, length) => {
                let (element, inner) = of.c();
                (element, format!("[{length}]{inner}"))
            }
            Self::Struct(name) => (format!("Carff{name}"), String::new()),
        }
    }
}

/// Returns the source text of a Python module with all layouts, as ctypes structures.
pub fn python() -> String {
    let mut text = "\"\"\"Messages, codes and topics of a run. Generated by `carff schema --python`.\"\"\"\n\n\
                    import ctypes\nfrom enum import IntEnum\nfrom typing import NamedTuple\n\n"
        .to_owned();
    for (name, value) in constants() {
        let _ = writeln!(text, "{name} = {value}");
    }
    for (name, values) in codes() {
        let _ = write!(text, "\n\nclass {name}(IntEnum):\n");
        for (value, code) in values {
            let _ = writeln!(text, "    {value} = {code}");
        }
    }
    for Struct { name, detail, fields } in structs() {
        let _ = write!(text, "\n\nclass {name}(ctypes.Structure):\n    _fields_ = [\n");
        for Field { name, kind, .. } in fields {
            let _ = writeln!(text, "        (\"{name}\", {}),", kind.python());
        }
        let _ = write!(
            text,
            "    ]\n\n    @staticmethod\n    def type_name() -> str:\n        return \"{}\"\n",
            detail.type_name()
        );
    }
    text += "\n\n# Size, alignment and offsets of the fields in the programs, bytes.\nLAYOUTS = {\n";
    for Struct { name, detail, fields } in structs() {
        let offsets: Vec<String> = fields.iter().map(|f| format!("\"{}\": {}", f.name, f.offset)).collect();
        let _ = writeln!(text, "    {name}: ({}, {}, {{{}}}),", detail.size(), detail.alignment(), offsets.join(", "));
    }
    text += "}\n\n\nclass Limits(NamedTuple):\n    \"\"\"Limits of a topic, equal for all its users.\"\"\"\n\n";
    for field in ["max_subscribers", "max_publishers", "max_nodes", "history", "buffer", "borrowed", "loaned"] {
        let _ = writeln!(text, "    {field}: int");
    }
    text += "\n\nclass Topic(NamedTuple):\n    \"\"\"A topic: its name, its message, and its limits.\"\"\"\n\n    \
             name: str\n    message: type\n    is_image: bool\n    limits: Limits\n\n\nTOPICS = [\n";
    for OneTopic { name, message, is_image, limits: l } in all_topics() {
        let limits = [l.max_subscribers, l.max_publishers, l.max_nodes, l.history, l.buffer, l.borrowed, l.loaned];
        let limits = limits.map(|n| n.to_string()).join(", ");
        let is_image = if is_image { "True" } else { "False" };
        let _ = writeln!(text, "    Topic(\"{name}\", {message}, {is_image}, Limits({limits})),");
    }
    text + "]\n"
}

/// Returns the source text of a header for C11 and C++11 with all layouts.
pub fn c() -> String {
    let mut text = "/* Messages, codes and topics of a run. Generated by `carff schema --c`. */\n\
                    #ifndef CARFF_MESSAGES_H\n#define CARFF_MESSAGES_H\n\n\
                    #include <assert.h>\n#include <stddef.h>\n#include <stdint.h>\n\n"
        .to_owned();
    for (name, value) in constants() {
        let _ = writeln!(text, "#define CARFF_{name} {value}");
    }
    for (name, values) in codes() {
        let name = upper_words(name);
        let values = values.iter().map(|(value, code)| format!("    CARFF_{name}_{value} = {code},\n"));
        let _ = write!(text, "\nenum {{\n{}}};\n", values.collect::<String>());
    }
    for Struct { name, detail, fields } in structs() {
        let (type_name, size, upper) = (detail.type_name(), detail.size(), upper_words(name));
        let _ = write!(text, "\n#define CARFF_{upper}_TYPE_NAME \"{type_name}\"\ntypedef struct Carff{name} {{\n");
        for field in &fields {
            let (element, lengths) = field.kind.c();
            let _ = writeln!(text, "    {element} {}{lengths};", field.name);
        }
        let _ = write!(text, "}} Carff{name};\n\nstatic_assert(sizeof(Carff{name}) == {size}, \"Carff{name}\");\n");
        for Field { name: field, offset, .. } in fields {
            let _ =
                writeln!(text, "static_assert(offsetof(Carff{name}, {field}) == {offset}, \"Carff{name}.{field}\");");
        }
    }
    text += "\n/* Names of the topics, and of the types of their messages. */\n";
    for OneTopic { name, message, is_image, .. } in all_topics() {
        let note = if is_image { " (user header of a slice of bytes)" } else { "" };
        let _ = writeln!(text, "#define CARFF_TOPIC_{} \"{name}\" /* Carff{message}{note} */", upper(name));
    }
    text + "\n#endif\n"
}

/// Returns the name of a type in the form of constants: `FRAME_META`.
fn upper_words(name: &str) -> String {
    let mut upper = String::new();
    for letter in name.chars() {
        if letter.is_ascii_uppercase() && !upper.is_empty() {
            upper.push('_');
        }
        upper.push(letter.to_ascii_uppercase());
    }
    upper
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::{Path, PathBuf};
    use std::process::Command;

    fn project(path: &str) -> PathBuf {
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../..").join(path)
    }

    /// The shipped files equal the output of `carff schema`.
    #[test]
    fn the_shipped_layouts_are_up_to_date() {
        for (path, text, option) in
            [("python/carff/layouts.py", python(), "python"), ("examples/cpp/carff.h", c(), "c")]
        {
            let found = std::fs::read_to_string(project(path)).unwrap_or_default();
            assert!(found == text, "run `carff schema --{option} > {path}`");
        }
    }

    /// No field is missing: each begins at the first aligned byte after the one before it, and only the belief has a
    /// private field.
    #[test]
    fn fields_are_complete_and_ordered() {
        let mut reserved = Vec::new();
        for Struct { name, detail, fields } in structs() {
            let end = fields.iter().fold(0, |end: usize, field| {
                assert_eq!(field.offset, end.next_multiple_of(field.alignment), "{name}.{}", field.name);
                field.offset + field.size
            });
            assert_eq!(end.next_multiple_of(detail.alignment()), detail.size(), "{name}");
            assert!(detail.type_name().to_string().starts_with(&format!("carff.{name}.v")), "{name}");
            reserved.extend(fields.iter().filter(|field| field.name == RESERVED).map(|_| name));
        }
        assert_eq!(reserved, ["Belief"]);
    }

    /// The header compiles as C and as C++ with its assertions on sizes and offsets, and a wrong one does not.
    #[test]
    fn the_header_compiles() {
        let compiler = std::env::var("CXX").unwrap_or_else(|_| "c++".to_owned());
        let folder = tempfile::tempdir().unwrap();
        let compile = |name: &str, text: &str, language: [&str; 2]| {
            let path = folder.path().join(name);
            std::fs::write(&path, text).unwrap();
            let command =
                Command::new(&compiler).args(["-x", language[0], language[1], "-fsyntax-only"]).arg(&path).output();
            command.map(|output| output.status.success())
        };
        let text = c();
        let Ok(as_cpp) = compile("carff.hpp", &text, ["c++", "-std=c++11"]) else {
            println!("skipped: there is no C++ compiler `{compiler}`");
            return;
        };
        assert!(as_cpp);
        assert!(compile("carff.h", &text, ["c", "-std=c11"]).unwrap());
        let wrong = text.replacen("uint32_t step;", "uint64_t step;", 1);
        assert_ne!(wrong, text);
        assert!(!compile("wrong.h", &wrong, ["c", "-std=c11"]).unwrap());
    }
}
