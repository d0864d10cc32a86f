//! What the model does not know: images of a bad camera or of another place, and things that no hypothesis explains.

mod compare;

pub use compare::{Comparer, Comparison, Fit};
