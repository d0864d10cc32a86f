//! The learned models in tch, their weights and manifests.
