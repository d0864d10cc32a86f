//! The model: networks and hash grid, evaluation at points, and tensors by name.

pub(crate) mod field;
pub(crate) mod layout;
pub(crate) mod network;
pub(crate) mod points;
pub(crate) mod tensors;
