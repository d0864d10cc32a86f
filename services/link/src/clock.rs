//! Converts times of another machine to this machine's clock.
//!
//! Each machine's monotonic clock counts from its own start. Every message holds its time of sending, and arrives
//! later. The least difference of the two in the last minute is the difference of the clocks plus the shortest transfer
//! time. Times are moved by it, so that an age computed here lacks only the shortest transfer time.

/// Half of the time that a difference is stored for, nanoseconds: clocks drift apart by some 50 us a second.
const WINDOW_NS: u64 = 30_000_000_000;

/// Moves times of one sender at a time.
#[derive(Clone, Debug, Default)]
pub struct ClockDifference {
    sender: Option<u64>,
    /// Least differences of the previous window and of this one, nanoseconds: here minus there.
    before_ns: Option<i128>,
    this_ns: Option<i128>,
    ends_ns: u64,
}

impl ClockDifference {
    /// Takes a message's sender, its time of sending by that machine's clock, and its time of arrival.
    pub fn observe(&mut self, sender: u64, sent_ns: u64, arrived_ns: u64) {
        if self.sender != Some(sender) {
            *self = Self { sender: Some(sender), ends_ns: arrived_ns.saturating_add(WINDOW_NS), ..Self::default() };
        } else if arrived_ns >= self.ends_ns {
            (self.before_ns, self.this_ns) = (self.this_ns, None);
            self.ends_ns = arrived_ns.saturating_add(WINDOW_NS);
        }
        let difference_ns = i128::from(arrived_ns) - i128::from(sent_ns);
        self.this_ns = Some(self.this_ns.map_or(difference_ns, |least_ns| least_ns.min(difference_ns)));
    }

    /// Returns the sender whose times are moved.
    pub fn sender(&self) -> Option<u64> {
        self.sender
    }

    /// Returns the nanoseconds by which times are moved.
    pub fn difference_ns(&self) -> i128 {
        [self.before_ns, self.this_ns].into_iter().flatten().min().unwrap_or(0)
    }

    /// Returns a time of that machine on this one's clock. 0, which means no time, stays 0.
    pub fn here_ns(&self, there_ns: u64) -> u64 {
        match there_ns {
            0 => 0,
            there_ns => (i128::from(there_ns) + self.difference_ns()).clamp(1, i128::from(u64::MAX)) as u64,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SECOND_NS: u64 = 1_000_000_000;

    /// Times move by the least difference, so that no message comes from the future, and their distances are unchanged.
    #[test]
    fn times_move_by_the_quickest_way() {
        let mut clock = ClockDifference::default();
        clock.observe(1, 1_000, 501_000);
        clock.observe(1, 2_000, 500_500);
        clock.observe(1, 3_000, 509_000);
        assert_eq!(clock.difference_ns(), 498_500);
        assert_eq!(clock.here_ns(3_000) - clock.here_ns(2_000), 1_000);
        assert_eq!(clock.here_ns(0), 0);
    }

    /// A clock ahead of this one is moved back; every number in a message has a time in range.
    #[test]
    fn any_number_has_a_time() {
        let mut clock = ClockDifference::default();
        clock.observe(1, 10 * SECOND_NS, SECOND_NS);
        assert_eq!(clock.here_ns(12 * SECOND_NS), 3 * SECOND_NS);
        assert_eq!(clock.here_ns(5), 1);
        clock.observe(2, 0, u64::MAX);
        assert_eq!(clock.here_ns(u64::MAX), u64::MAX);
        clock.observe(3, u64::MAX, 0);
        assert_eq!(clock.here_ns(u64::MAX), 1);
    }

    /// A drifting clock is followed within two windows; another sender, with another clock, at once.
    #[test]
    fn drift_and_new_senders_are_followed() {
        let mut clock = ClockDifference::default();
        for second in 0..61 {
            // The sender's clock is slower: each second the difference grows by 50 us.
            clock.observe(1, second * SECOND_NS, second * SECOND_NS + second * 50_000);
        }
        assert_eq!(clock.difference_ns(), 30 * 50_000);
        clock.observe(2, 7, 100 * SECOND_NS);
        assert_eq!(clock.here_ns(7), 100 * SECOND_NS);
    }
}
