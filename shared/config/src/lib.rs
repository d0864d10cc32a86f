//! The graph file: one typed, documented configuration per stage.
