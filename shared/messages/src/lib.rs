//! The messages that cross process boundaries, and their validation.
