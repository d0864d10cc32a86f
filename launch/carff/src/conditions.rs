//! The conditions of a run's camera, counted over its checked images.

use carff_messages::{Action, ImageCheck, ImageCondition};
use serde::Serialize;
use std::collections::{BTreeMap, VecDeque};

/// Number of episodes that wait for their safe action.
const WAITING: usize = 16;

/// Counts of one condition.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct ConditionCount {
    /// Number of images.
    pub images: u64,
    /// Number of episodes: consecutive images of the condition.
    pub episodes: u64,
    /// Largest number of frames from an episode's first image to the one that the safe action rests on, both counted;
    /// `None` before a safe action.
    pub worst_frames_to_safe_action: Option<u64>,
}

/// An episode without a safe action.
#[derive(Clone, Copy, Debug)]
struct Waiting {
    condition: ImageCondition,
    /// Frame whose check began the episode.
    begun: u64,
    /// Frame of its first image: of a frozen camera, the one that repeats.
    first: u64,
}

/// Conditions of a camera: the current one, and counts of all.
///
/// ```
/// use carff::conditions::Conditions;
/// use carff_messages::{Header, ImageCheck, ImageCondition};
/// let mut conditions = Conditions::default();
/// let black = ImageCondition::Black.code();
/// conditions.take_check(&ImageCheck { condition: black, ..ImageCheck::of_frame(Header::default()) });
/// assert_eq!(conditions.current(), Some(ImageCondition::Black));
/// assert_eq!(conditions.line(80), "camera black   unusable images: black 1 (1x)");
/// ```
#[derive(Clone, Debug, Default)]
pub struct Conditions {
    current: Option<ImageCondition>,
    counts: BTreeMap<ImageCondition, ConditionCount>,
    /// Frame of the latest image that differs from the one before.
    changed: u64,
    waiting: VecDeque<Waiting>,
}

impl Conditions {
    /// Adds the check of an image.
    pub fn take_check(&mut self, check: &ImageCheck) {
        let Ok(condition) = check.condition() else { return };
        let frame = check.header.frame_id;
        if check.repeats_s <= 0.0 {
            self.changed = frame;
        }
        let count = self.counts.entry(condition).or_default();
        count.images += 1;
        if self.current.replace(condition) == Some(condition) {
            return;
        }
        count.episodes += 1;
        if condition == ImageCondition::Usable {
            return;
        }
        if self.waiting.len() >= WAITING {
            self.waiting.pop_front();
        }
        let first = if condition == ImageCondition::Frozen { self.changed.min(frame) } else { frame };
        self.waiting.push_back(Waiting { condition, begun: frame, first });
    }

    /// Adds an action. The actions of a frame follow its check.
    pub fn take_action(&mut self, action: &Action) {
        let Ok(reason) = action.reason() else { return };
        let frame = action.based_on_frame;
        let is_answer = |w: &Waiting| w.condition.reason() == Some(reason) && w.begun <= frame;
        if !action.is_decision() {
            return;
        }
        let Some(at) = self.waiting.iter().rposition(is_answer) else { return };
        let Waiting { condition, first, .. } = self.waiting[at];
        // Earlier episodes of the condition have no safe action that was received.
        self.waiting.retain(|w| !is_answer(w));
        let worst = &mut self.counts.entry(condition).or_default().worst_frames_to_safe_action;
        *worst = (*worst).max(Some((frame - first).saturating_add(1)));
    }

    /// Returns the condition of the latest image; `None` before the first check.
    pub fn current(&self) -> Option<ImageCondition> {
        self.current
    }

    /// Returns the counts of each condition that occurred.
    pub fn counts(&self) -> impl Iterator<Item = (ImageCondition, &ConditionCount)> {
        self.counts.iter().map(|(&condition, count)| (condition, count))
    }

    /// Returns the counts of the conditions in which no decision rests on an image.
    pub fn unusable(&self) -> impl Iterator<Item = (ImageCondition, &ConditionCount)> {
        self.counts().filter(|(condition, _)| *condition != ImageCondition::Usable)
    }

    /// Returns the current condition (`ok` if usable), and images and episodes of the others, in at most `width`
    /// characters. The most frequent conditions come first, and a number stands for those that do not fit.
    pub fn line(&self, width: usize) -> String {
        let current = match self.current {
            None => "-",
            Some(ImageCondition::Usable) => "ok",
            Some(condition) => condition.name(),
        };
        let mut unusable: Vec<_> = self.unusable().collect();
        unusable.sort_by_key(|(_, count)| std::cmp::Reverse(count.images));
        let texts: Vec<String> =
            unusable.iter().map(|(name, count)| format!("{name} {} ({}x)", count.images, count.episodes)).collect();
        let line = |shown: usize| {
            let mut parts = texts[..shown].to_vec();
            if shown < texts.len() {
                parts.push(format!("{} more", texts.len() - shown));
            }
            format!("camera {current}   unusable images: {}", parts.join(", "))
        };
        let fits = (0..=texts.len()).rev().map(line).find(|line| line.chars().count() <= width);
        fits.filter(|_| !texts.is_empty()).unwrap_or_else(|| format!("camera {current}"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use carff_messages::{Header, Reason, Rule};

    fn check(frame_id: u64, condition: ImageCondition, repeats_s: f32) -> ImageCheck {
        ImageCheck { condition: condition.code(), repeats_s, ..ImageCheck::of_frame(Header::of_frame(frame_id, 1, 1)) }
    }

    fn action(frame_id: u64, reason: Reason) -> Action {
        let halt = Action::halt(Header::of_frame(frame_id, 1, 1), reason, Rule::Calibrated);
        Action { is_decision: 1, based_on_frame: frame_id, ..halt }
    }

    /// Consecutive images of a condition are one episode, and every image counts.
    #[test]
    fn images_and_episodes_are_counted() {
        use ImageCondition::{Black, Clock, Usable};
        let mut conditions = Conditions::default();
        assert_eq!((conditions.current(), conditions.line(80)), (None, "camera -".to_owned()));
        for (frame, condition) in (0..).zip([Usable, Black, Black, Usable, Black, Clock, Usable]) {
            conditions.take_check(&check(frame, condition, 0.0));
        }
        let counts: Vec<_> = conditions.counts().map(|(c, n)| (c, n.images, n.episodes)).collect();
        assert_eq!(counts, [(Usable, 3, 3), (Black, 3, 2), (Clock, 1, 1)]);
        assert_eq!(conditions.unusable().count(), 2);
        assert_eq!(conditions.line(80), "camera ok   unusable images: black 3 (2x), camera clock 1 (1x)");
    }

    /// The safe action of an episode is the first with its reason, on the episode's images. The first image of a frozen
    /// camera is the one that repeats. An episode without a safe action does not count for a later one.
    #[test]
    fn frames_to_the_safe_action_are_counted() {
        use ImageCondition::{Black, Frozen, Usable};
        let mut conditions = Conditions::default();
        let worst = |conditions: &Conditions, wanted: ImageCondition| {
            let found = conditions.counts().find(|(condition, _)| *condition == wanted);
            found.and_then(|(_, count)| count.worst_frames_to_safe_action)
        };
        conditions.take_check(&check(7, Black, 0.0));
        conditions.take_action(&action(6, Reason::Belief));
        conditions.take_action(&Action { is_decision: 0, ..action(7, Reason::BlackImage) });
        assert_eq!(worst(&conditions, Black), None);
        conditions.take_action(&action(8, Reason::BlackImage));
        conditions.take_action(&action(9, Reason::BlackImage));
        assert_eq!(worst(&conditions, Black), Some(2));
        for (frame, condition, repeats_s) in
            [(20, Usable, 0.0), (21, Usable, 0.1), (22, Usable, 0.2), (23, Frozen, 0.3), (24, Frozen, 0.4)]
        {
            conditions.take_check(&check(frame, condition, repeats_s));
        }
        conditions.take_action(&action(23, Reason::FrozenImage));
        assert_eq!(worst(&conditions, Frozen), Some(4));
        for (frame, condition) in [(30, Black), (31, Usable), (40, Black)] {
            conditions.take_check(&check(frame, condition, 0.0));
        }
        conditions.take_action(&action(40, Reason::BlackImage));
        assert_eq!(worst(&conditions, Black), Some(2));
    }

    /// The line is never wider than asked, if the condition's name fits; conditions without a place are counted.
    #[test]
    fn the_line_fits() {
        let mut conditions = Conditions::default();
        for condition in ImageCondition::ALL {
            conditions.take_check(&check(1, condition, 0.0));
            conditions.counts.entry(condition).or_default().images = 1_234_567;
        }
        let line = conditions.line(80);
        assert!(line.chars().count() <= 80 && line.ends_with(" more"), "{line}");
        assert!(line.starts_with("camera camera clock   unusable images: "), "{line}");
        assert_eq!(conditions.line(3), "camera camera clock");
    }
}
