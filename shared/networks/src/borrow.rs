//! Tensors that borrow memory: the only `unsafe` code of this crate.
//!
//! The camera writes an image once, into shared memory. The tensor points to those bytes; nothing is copied before the
//! first arithmetic operation.

use ndarray::ArrayView3;
use tch::{Device, Kind, Tensor};

/// Calls `use_it` with a (height, width, channel) tensor of bytes that borrows an image. The result must not contain
/// the tensor.
///
/// Returns `None` for an image without bytes, and for one whose axes do not run forward in memory.
///
/// ```
/// let image = ndarray::Array3::from_elem((2, 4, 3), 7_u8);
/// let mean = carff_networks::borrow::with_image(image.view(), |tensor| {
///     assert_eq!(tensor.data_ptr() as usize, image.as_ptr() as usize);
///     tensor.to_kind(tch::Kind::Float).mean(tch::Kind::Float).double_value(&[])
/// });
/// assert_eq!(mean, Some(7.0));
/// ```
pub fn with_image<R>(image: ArrayView3<'_, u8>, use_it: impl FnOnce(&Tensor) -> R) -> Option<R> {
    if image.is_empty() || image.strides().iter().any(|&stride| stride <= 0) {
        return None;
    }
    let sizes: Vec<i64> = image.shape().iter().map(|&size| size as i64).collect();
    let strides: Vec<i64> = image.strides().iter().map(|&stride| stride as i64).collect();
    // SAFETY: the view guarantees that each element which its shape and strides reach is readable, all strides are
    // positive, and it outlives the call. libtorch only reads through this tensor, and the tensor is dropped before
    // this function returns.
    let tensor = unsafe { Tensor::from_blob(image.as_ptr(), &sizes, &strides, Kind::Uint8, Device::Cpu) };
    Some(use_it(&tensor))
}
