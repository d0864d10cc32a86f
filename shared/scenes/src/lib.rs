//! Scenarios as data, and the ray tracer that takes their pictures.
