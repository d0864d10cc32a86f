//! What every stage process does the same way: start, log, report health, stop.
