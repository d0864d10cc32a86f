//! Layouts of messages in memory, for programs in other languages.
//!
//! ```
//! use carff_messages::layout::Described;
//! use carff_messages::{FrameMeta, Intrinsics};
//! let frame = FrameMeta::layout();
//! assert_eq!((frame.size_bytes, frame.alignment_bytes), (size_of::<FrameMeta>(), align_of::<FrameMeta>()));
//! let intrinsics = frame.fields.iter().find(|field| field.name == "intrinsics").expect("frames have intrinsics");
//! assert_eq!(intrinsics.kind.fields[0].name, "fl_x_px");
//! # let _ = Intrinsics::layout();
//! ```

use crate::{
    Action, Belief, DatasetView, Forecast, FrameMeta, Gaussian, Header, Health, ImageCheck, Intrinsics, Occupancy,
    Posterior, ProbeResult, UnknownBox, Unknowns, ViewMeta,
};
use iceoryx2::prelude::ZeroCopySend;
use iceoryx2::service::static_config::message_type_details::{TypeDetail, TypeVariant};
use serde::Serialize;

/// A type in shared memory: a number, or a structure with fields.
///
/// ```
/// use carff_messages::{Header, layout::Described};
/// let header = Header::layout();
/// assert_eq!((header.type_name.as_str(), header.size_bytes), ("carff.Header.v1", size_of::<Header>()));
/// let frame = header.fields.iter().find(|field| field.name == "frame_id").expect("each header has a frame");
/// assert_eq!((frame.offset_bytes, frame.kind.type_name.as_str()), (16, "u64"));
/// ```
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Layout {
    /// Name that the transport compares: of a structure its `type_name`, of a number its Rust name.
    pub type_name: String,
    /// Size, bytes.
    pub size_bytes: usize,
    /// Alignment, bytes.
    pub alignment_bytes: usize,
    /// Fields of a structure, in the order of their offsets; empty for a number.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub fields: Vec<LayoutField>,
}

/// A field of a structure.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct LayoutField {
    /// Name of the field.
    pub name: &'static str,
    /// Offset in the structure, bytes.
    pub offset_bytes: usize,
    /// Lengths of an array, outermost first; empty for a single value.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub shape: Vec<usize>,
    /// Type of the value, or of an array's elements.
    #[serde(flatten)]
    pub kind: Layout,
}

/// A type with a known layout.
pub trait Described {
    /// Returns the layout of the type, or of an array's elements.
    fn layout() -> Layout;

    /// Returns the lengths of an array, outermost first.
    fn shape() -> Vec<usize> {
        Vec::new()
    }
}

impl Layout {
    /// Returns the layout of a type as the transport describes it.
    pub fn of<T: ZeroCopySend>(fields: Vec<LayoutField>) -> Self {
        let detail = TypeDetail::new::<T>(TypeVariant::FixedSize);
        Self {
            type_name: detail.type_name().to_string(),
            size_bytes: detail.size(),
            alignment_bytes: detail.alignment(),
            fields,
        }
    }
}

/// Returns a field; `_get` gives its type.
#[doc(hidden)]
pub fn field<S, T: Described>(name: &'static str, offset_bytes: usize, _get: fn(&S) -> &T) -> LayoutField {
    LayoutField { name, offset_bytes, shape: T::shape(), kind: T::layout() }
}

macro_rules! numbers {
    ($($number:ty),+) => {
        $(impl Described for $number {
            fn layout() -> Layout {
                Layout::of::<Self>(Vec::new())
            }
        })+
    };
}

numbers!(u8, u32, i32, u64, f32, f64);

impl<T: Described, const N: usize> Described for [T; N] {
    fn layout() -> Layout {
        T::layout()
    }

    fn shape() -> Vec<usize> {
        [N].into_iter().chain(T::shape()).collect()
    }
}

/// Implements [`Described`] for a structure by the names of all its fields. A missing field does not compile.
#[macro_export]
macro_rules! described {
    ($type:ident { $($field:ident),+ $(,)? }) => {
        impl $crate::layout::Described for $type {
            fn layout() -> $crate::layout::Layout {
                // Names each field, so that a new one cannot be forgotten here.
                let _complete = |value: &$type| { let $type { $($field: _),+ } = value; };
                $crate::layout::Layout::of::<Self>(vec![
                    $($crate::layout::field::<$type, _>(
                        stringify!($field),
                        std::mem::offset_of!($type, $field),
                        |value| &value.$field,
                    )),+
                ])
            }
        }
    };
}

described!(Header { schema_version, step, run_id, frame_id, sequence, capture_time_ns, publish_time_ns, seed });
described!(Intrinsics { fl_x_px, fl_y_px, cx_px, cy_px });
described!(DatasetView { known, view, branch, timestamp, drive, frame_in_drive, observability, last_of_timestamp });
described!(FrameMeta { header, width_px, height_px, intrinsics, world_from_camera, dataset_view, take_start });
described!(ViewMeta {
    header,
    hypothesis,
    kind,
    state,
    width_px,
    height_px,
    probability,
    latent,
    intrinsics,
    world_from_camera,
    stage_latency_ns
});
described!(Gaussian { mean, log_variance });
described!(ImageCheck { header, condition, luminance, sharpness, change, covered, repeats_s });
described!(UnknownBox { center, half_size, probability, place });
described!(Unknowns {
    header,
    box_count,
    state_count,
    place_count,
    probability,
    residual,
    noise,
    gain,
    offset,
    explained,
    ratios,
    places,
    boxes,
    stage_latency_ns
});
described!(Occupancy {
    header,
    columns,
    rows,
    cell_m,
    low_corner_m,
    unknown_probability,
    probability,
    stage_latency_ns
});
described!(Posterior { header, gaussian, take_start, stage_latency_ns });
described!(Forecast {
    header,
    source,
    component_count,
    sample_count,
    horizon,
    resolved_state,
    path_probability,
    images,
    state_count,
    hazard_by_places,
    state_weights,
    weights,
    components,
    samples,
    sample_component,
    encoder_ns,
    stage_latency_ns
});
described!(ProbeResult { state, confidence, hazard_likelihood, occupancies });
described!(Belief {
    header,
    horizon,
    state_count,
    place_count,
    component_count,
    sample_count,
    is_final,
    state_probability,
    hazard_probability,
    path_probability,
    component_weights,
    components,
    samples,
    sample_component,
    resolved_state,
    unknown_probability,
    resolved,
    fed_back,
    fed_back_count,
    encoder_ns,
    forecaster_ns,
    stage_latency_ns
});
described!(Action {
    header,
    action,
    reason,
    rule,
    sample_count,
    confidence,
    hazard_probability,
    is_decision,
    unknown_probability,
    valid_until_ns,
    based_on_frame,
    latency_ns,
    target_speed_mps,
    look_gain_bits,
    clear_m
});
described!(Health {
    header,
    stage,
    state,
    pid,
    received,
    published,
    skipped,
    invalid,
    errors,
    last_latency_ns,
    max_latency_ns,
    last_progress_ns,
    rss_bytes
});

#[cfg(test)]
mod tests {
    use super::*;

    /// Fields are in the order of their offsets, do not overlap, and fit into their structure.
    fn check(layout: &Layout) {
        let mut end = 0;
        for field in &layout.fields {
            let bytes = field.kind.size_bytes * field.shape.iter().product::<usize>();
            assert!(field.offset_bytes >= end, "{}: {}", layout.type_name, field.name);
            assert_eq!(field.offset_bytes % field.kind.alignment_bytes, 0, "{}", field.name);
            end = field.offset_bytes + bytes;
            check(&field.kind);
        }
        assert!(end <= layout.size_bytes && layout.size_bytes < end + 8 || layout.fields.is_empty());
    }

    /// The layouts of all messages are consistent, and the frame's is the one that other programs were written for.
    #[test]
    fn layouts_describe_the_memory() {
        for layout in [
            FrameMeta::layout(),
            ViewMeta::layout(),
            Posterior::layout(),
            ImageCheck::layout(),
            Unknowns::layout(),
            Forecast::layout(),
            Belief::layout(),
            Action::layout(),
            Health::layout(),
        ] {
            check(&layout);
        }
        let frame = FrameMeta::layout();
        assert_eq!((frame.type_name.as_str(), frame.size_bytes), ("carff.FrameMeta.v2", 264));
        let pose = &frame.fields[4];
        assert_eq!((pose.name, pose.offset_bytes, &pose.shape[..]), ("world_from_camera", 96, &[16][..]));
        assert_eq!((pose.kind.type_name.as_str(), pose.kind.size_bytes), ("f64", 8));
        let samples = Forecast::layout().fields.remove(13);
        assert_eq!((samples.name, &samples.shape[..]), ("samples", &[64, 8][..]));
    }
}
