//! Posed image sets: reading, writing, checking, splitting.
