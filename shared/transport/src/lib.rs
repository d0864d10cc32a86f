//! The typed layer over iceoryx2: topics, limits, deadlines.
