//! Figures that reports print: percentiles, intervals, picture quality.
