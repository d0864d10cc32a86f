//! Tensors that borrow memory they do not own: the only `unsafe` of this crate.
//!
//! A picture lies in shared memory, written once by the camera. The tensor made here points at those bytes; nothing
//! is copied before the first arithmetic operation.

use tch::{Device, Kind, Tensor};

/// Calls `use_it` with a `[height, width, 3]` tensor of bytes that borrows `rgb`; its result must not keep the tensor.
///
/// Returns `None` when the slice has not `height * width * 3` bytes.
///
/// ```
/// let bytes = vec![7_u8; 2 * 4 * 3];
/// let mean = carff_models::borrow::with_picture(&bytes, 2, 4, |t| {
///     assert_eq!(t.data_ptr() as usize, bytes.as_ptr() as usize);
///     t.to_kind(tch::Kind::Float).mean(tch::Kind::Float).double_value(&[])
/// });
/// assert_eq!(mean, Some(7.0));
/// ```
pub fn with_picture<R>(rgb: &[u8], height_px: usize, width_px: usize, use_it: impl FnOnce(&Tensor) -> R) -> Option<R> {
    let wanted = height_px.checked_mul(width_px)?.checked_mul(3)?;
    if rgb.len() != wanted || wanted == 0 {
        return None;
    }
    let (h, w) = (height_px as i64, width_px as i64);
    // SAFETY: `rgb` holds exactly h * w * 3 readable bytes, contiguous in row-major order, as the sizes and strides
    // say, and outlives the call; libtorch only reads through this tensor, and it is dropped before this returns.
    let tensor = unsafe { Tensor::from_blob(rgb.as_ptr(), &[h, w, 3], &[w * 3, 3, 1], Kind::Uint8, Device::Cpu) };
    Some(use_it(&tensor))
}
