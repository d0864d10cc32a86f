//! The graph's answer to a camera whose images are bad: pure logic.

use carff_messages::{Action, ActionCode, Header, ImageCheck, ImageCondition};

/// Number of checked images, from the first bad one, within which the condition must be named.
const IMAGES: u64 = 3;
/// Time after the limit of a frozen camera within which it must be named, nanoseconds.
const FROZEN_NS: u64 = 200_000_000;

/// The checks and the safe action that follow the bad images of one fault.
#[derive(Clone, Debug)]
pub(super) struct Answer {
    /// Condition of the images.
    condition: ImageCondition,
    /// Number of the first bad frame.
    first_frame: u64,
    /// Time for which an image may repeat, nanoseconds.
    frozen_ns: u64,
    /// Capture time of the first checked one, nanoseconds.
    since_ns: Option<u64>,
    /// Number of checked images.
    checked: u64,
    /// First frame whose check names the condition.
    named: Option<u64>,
    /// Number of frames from the first bad one to the one that the safe action rests on, both counted.
    pub(super) frames: Option<u64>,
}

impl Answer {
    /// Awaits the answer to images of a condition that begin with a frame.
    pub(super) fn new(condition: ImageCondition, first_frame: u64, frozen_ns: u64) -> Self {
        Self { condition, first_frame, frozen_ns, since_ns: None, checked: 0, named: None, frames: None }
    }

    /// Returns the time after the first bad image in which the safe action must come, nanoseconds.
    pub(super) fn limit_ns(&self, period_ns: u64) -> u64 {
        if self.condition == ImageCondition::Frozen { self.frozen_ns + FROZEN_NS } else { IMAGES * period_ns }
    }

    /// Takes the check of an image; the error describes the violation. Images that the encoder skips do not count.
    pub(super) fn checked(&mut self, check: &ImageCheck) -> Result<(), String> {
        let Header { frame_id, capture_time_ns, .. } = check.header;
        if self.named.is_some() || frame_id < self.first_frame {
            return Ok(());
        }
        self.checked += 1;
        let repeats_ns = capture_time_ns.saturating_sub(*self.since_ns.get_or_insert(capture_time_ns));
        if check.condition() == Ok(self.condition) {
            self.named = Some(frame_id);
            return Ok(());
        }
        let is_late = match self.condition {
            ImageCondition::Frozen => repeats_ns >= self.frozen_ns + FROZEN_NS,
            _ => self.checked >= IMAGES,
        };
        if is_late {
            Err(format!("image {} of a camera with `{}`: {check:?}", self.checked, self.condition))
        } else {
            Ok(())
        }
    }

    /// Takes an action; the error describes the violation.
    pub(super) fn acted(&mut self, action: &Action) -> Result<(), String> {
        let frame = action.based_on_frame;
        if self.frames.is_some() || !action.is_decision() || self.named.is_none_or(|named| frame < named) {
            return Ok(());
        }
        if action.reason().ok() != self.condition.reason() || action.code() != Ok(ActionCode::Halt) {
            return Err(format!("an image with `{}` is not the reason of {action:?}", self.condition));
        }
        self.frames = Some((frame - self.first_frame).saturating_add(1));
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use carff_messages::{Reason, Rule};

    const MS: u64 = 1_000_000;
    /// Number of the first bad frame.
    const FIRST: u64 = 10;

    fn check(frame_id: u64, condition: ImageCondition) -> ImageCheck {
        let header = Header::of_frame(frame_id, frame_id * 50 * MS, 1);
        ImageCheck { condition: condition.code(), ..ImageCheck::of_frame(header) }
    }

    fn action(frame_id: u64, reason: Reason) -> Action {
        let halt = Action::halt(Header::of_frame(frame_id, 1, 1), reason, Rule::Calibrated);
        Action { is_decision: 1, based_on_frame: frame_id, ..halt }
    }

    /// A condition must be named within three checked images; earlier frames and skipped ones do not count.
    #[test]
    fn a_condition_is_named_in_time() {
        use ImageCondition::{Black, Usable, White};
        let mut answer = Answer::new(Black, FIRST, 300 * MS);
        for (frame, condition) in [(9, Usable), (9, Usable), (9, Usable), (10, Usable), (30, White), (44, Black)] {
            answer.checked(&check(frame, condition)).unwrap();
        }
        let mut late = Answer::new(Black, FIRST, 300 * MS);
        late.checked(&check(10, Usable)).unwrap();
        late.checked(&check(11, White)).unwrap();
        assert!(late.checked(&check(12, White)).unwrap_err().contains("image 3 of a camera with `black`"));
    }

    /// A frozen camera must be named within its limit and a fifth of a second, however many images that are.
    #[test]
    fn a_frozen_camera_is_named_in_time() {
        use ImageCondition::{Frozen, Usable};
        let mut answer = Answer::new(Frozen, FIRST, 300 * MS);
        for frame in 10..20 {
            answer.checked(&check(frame, Usable)).unwrap();
        }
        let mut late = answer.clone();
        answer.checked(&check(20, Frozen)).unwrap();
        assert!(late.checked(&check(20, Usable)).is_err());
        assert_eq!((answer.limit_ns(50 * MS), Answer::new(Usable, 0, 0).limit_ns(50 * MS)), (500 * MS, 150 * MS));
    }

    /// The first decision on a named image must be the safe action with the condition as its reason.
    #[test]
    fn the_safe_action_has_the_reason() {
        let named = || {
            let mut answer = Answer::new(ImageCondition::Covered, FIRST, 300 * MS);
            answer.checked(&check(11, ImageCondition::Covered)).unwrap();
            answer
        };
        let mut answer = named();
        answer.acted(&action(9, Reason::Belief)).unwrap();
        answer.acted(&Action { is_decision: 0, ..action(u64::MAX, Reason::StaleBelief) }).unwrap();
        assert_eq!(answer.frames, None);
        answer.acted(&action(11, Reason::CoveredLens)).unwrap();
        assert_eq!(answer.frames, Some(2));
        assert!(named().acted(&action(11, Reason::Belief)).is_err());
        assert!(named().acted(&action(12, Reason::BlackImage)).is_err());
        let advance = Action { action: ActionCode::Advance.code(), ..action(11, Reason::CoveredLens) };
        assert!(named().acted(&advance).is_err());
    }
}
