//! What was looked at, in order, with a way back and forward.

/// Entries that are kept; the oldest go first.
const MOST: usize = 200;

/// A line of entries, one of which is the current one.
#[derive(Clone, Debug)]
pub struct History<T> {
    entries: Vec<T>,
    current: usize,
}

impl<T> Default for History<T> {
    fn default() -> Self {
        Self { entries: Vec::new(), current: 0 }
    }
}

impl<T> History<T> {
    /// The entry that is shown.
    pub fn current(&self) -> Option<&T> {
        self.entries.get(self.current)
    }

    /// The entry that is shown, to be changed.
    pub fn current_mut(&mut self) -> Option<&mut T> {
        self.entries.get_mut(self.current)
    }

    /// Goes on from the current entry: what came after it is forgotten.
    pub fn push(&mut self, entry: T) {
        self.entries.truncate(self.current + 1);
        self.entries.push(entry);
        let surplus = self.entries.len().saturating_sub(MOST);
        self.entries.drain(..surplus);
        self.current = self.entries.len() - 1;
    }

    /// Puts other entries in place of all; the one at the same place is shown, or else the last.
    pub fn replace(&mut self, entries: Vec<T>) {
        self.entries = entries;
        self.current = self.current.min(self.entries.len().saturating_sub(1));
    }

    /// Whether there is an entry before the current one.
    pub fn has_back(&self) -> bool {
        self.current > 0
    }

    /// Whether there is an entry after the current one.
    pub fn has_forward(&self) -> bool {
        self.current + 1 < self.entries.len()
    }

    /// Goes to the entry before; false when there is none.
    pub fn back(&mut self) -> bool {
        let moved = self.has_back();
        self.current -= usize::from(moved);
        moved
    }

    /// Goes to the entry after; false when there is none.
    pub fn forward(&mut self) -> bool {
        let moved = self.has_forward();
        self.current += usize::from(moved);
        moved
    }

    /// Shows the entry at a place; false when there is none.
    pub fn go_to(&mut self, place: usize) -> bool {
        let there = place < self.entries.len();
        if there {
            self.current = place;
        }
        there
    }

    /// All entries, oldest first.
    pub fn entries(&self) -> &[T] {
        &self.entries
    }

    /// The current entry's place among them.
    pub fn place(&self) -> usize {
        self.current
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Back and forward walk the line and stop at its ends; going on from the middle forgets what came after.
    #[test]
    fn walks_and_branches() {
        let mut history = History::default();
        assert!(!history.back() && !history.forward() && history.current().is_none());
        for i in 0..4 {
            history.push(i);
        }
        assert!(history.back() && history.back());
        assert_eq!(history.current(), Some(&1));
        assert!(history.forward());
        history.push(9);
        assert_eq!((history.entries(), history.has_forward()), ([0, 1, 2, 9].as_slice(), false));
        while history.back() {}
        assert_eq!((history.current(), history.has_back()), (Some(&0), false));
        assert!(history.go_to(3) && !history.go_to(4));
        assert_eq!(history.current(), Some(&9));
    }

    /// A full line forgets its oldest entries, and the newest stays current.
    #[test]
    fn is_bounded() {
        let mut history = History::default();
        for i in 0..2 * MOST {
            history.push(i);
        }
        assert_eq!((history.entries().len(), history.current()), (MOST, Some(&(2 * MOST - 1))));
    }

    /// Replaced entries keep the place; a shorter line shows its last.
    #[test]
    fn replacing_keeps_the_place() {
        let mut history = History::default();
        history.replace(vec![0, 1, 2]);
        history.forward();
        history.replace(vec![5, 6, 7]);
        assert_eq!(history.current(), Some(&6));
        history.replace(vec![8]);
        assert_eq!((history.current(), history.place()), (Some(&8), 0));
        history.replace(Vec::new());
        assert!(history.current().is_none() && !history.has_forward() && !history.has_back());
        history.push(3);
        assert_eq!(history.current(), Some(&3));
    }
}
