//! From a probed belief to an action: the decision rules.
