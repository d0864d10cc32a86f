//! How the three models are trained.
