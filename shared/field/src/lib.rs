//! The latent-conditioned radiance field: native kernels, rendering, training.
