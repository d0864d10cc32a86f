//! The history of shown entries, with back and forward.

/// Maximum number of entries; the oldest are dropped first.
const MOST: usize = 200;

/// A list of entries with a current one.
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
    /// Returns the current entry.
    pub fn current(&self) -> Option<&T> {
        self.entries.get(self.current)
    }

    /// Returns the current entry for changes.
    pub fn current_mut(&mut self) -> Option<&mut T> {
        self.entries.get_mut(self.current)
    }

    /// Appends an entry after the current one and drops the entries that followed it.
    pub fn push(&mut self, entry: T) {
        self.entries.truncate(self.current + 1);
        self.entries.push(entry);
        let surplus = self.entries.len().saturating_sub(MOST);
        self.entries.drain(..surplus);
        self.current = self.entries.len() - 1;
    }

    /// Replaces all entries; the position stays, or becomes the last one if the list is shorter.
    pub fn replace(&mut self, entries: Vec<T>) {
        self.entries = entries;
        self.current = self.current.min(self.entries.len().saturating_sub(1));
    }

    /// Returns true if there is an entry before the current one.
    pub fn has_back(&self) -> bool {
        self.current > 0
    }

    /// Returns true if there is an entry after the current one.
    pub fn has_forward(&self) -> bool {
        self.current + 1 < self.entries.len()
    }

    /// Goes to the previous entry; returns false if there is none.
    pub fn back(&mut self) -> bool {
        let moved = self.has_back();
        self.current -= usize::from(moved);
        moved
    }

    /// Goes to the next entry; returns false if there is none.
    pub fn forward(&mut self) -> bool {
        let moved = self.has_forward();
        self.current += usize::from(moved);
        moved
    }

    /// Goes to the entry at an index; returns false if there is none.
    pub fn go_to(&mut self, place: usize) -> bool {
        let there = place < self.entries.len();
        if there {
            self.current = place;
        }
        there
    }

    /// Returns all entries, oldest first.
    pub fn entries(&self) -> &[T] {
        &self.entries
    }

    /// Returns the index of the current entry.
    pub fn place(&self) -> usize {
        self.current
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Back and forward walk the list and stop at its ends; a push from the middle drops the entries after it.
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

    /// A full list drops its oldest entries, and the newest stays current.
    #[test]
    fn is_bounded() {
        let mut history = History::default();
        for i in 0..2 * MOST {
            history.push(i);
        }
        assert_eq!((history.entries().len(), history.current()), (MOST, Some(&(2 * MOST - 1))));
    }

    /// Replacing entries keeps the position; a shorter list shows its last entry.
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
