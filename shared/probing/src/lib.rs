//! From densities in a hypothesis to the state it shows.
