//! Values by role of the camera pose.

use carff_dataset::PoseRole;
use serde::{Deserialize, Serialize};

/// Roles of the poses, in the order of tables.
pub const ROLES: [PoseRole; 3] = [PoseRole::Rest, PoseRole::Calibration, PoseRole::Unseen];

/// Returns the name of a role in tables.
pub fn role_name(role: PoseRole) -> &'static str {
    match role {
        PoseRole::Rest => "trained",
        PoseRole::Calibration => "calibration",
        PoseRole::Unseen => "held-out",
    }
}

/// One value for each role of the poses. A role without a value is absent in files.
///
/// ```
/// use carff_evaluation::ByRole;
/// let poses: ByRole<usize> = serde_json::from_str(r#"{"trained": 40, "unseen": 5}"#)?;
/// assert_eq!((poses.trained, poses.calibration), (Some(40), None));
/// assert!(serde_json::from_str::<ByRole<usize>>(r#"{"held_out": 5}"#).is_err());
/// # Ok::<(), serde_json::Error>(())
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ByRole<T> {
    /// Trained poses from which the threshold was chosen.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub calibration: Option<T>,
    /// Trained poses that chose no setting.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub trained: Option<T>,
    /// Held-out poses.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub unseen: Option<T>,
}

impl<T> Default for ByRole<T> {
    fn default() -> Self {
        Self { calibration: None, trained: None, unseen: None }
    }
}

impl<T> ByRole<T> {
    /// Sets the value of a role.
    pub fn set(&mut self, role: PoseRole, value: T) {
        match role {
            PoseRole::Rest => self.trained = Some(value),
            PoseRole::Calibration => self.calibration = Some(value),
            PoseRole::Unseen => self.unseen = Some(value),
        }
    }

    /// Value of a role.
    pub fn get(&self, role: PoseRole) -> Option<&T> {
        match role {
            PoseRole::Rest => self.trained.as_ref(),
            PoseRole::Calibration => self.calibration.as_ref(),
            PoseRole::Unseen => self.unseen.as_ref(),
        }
    }

    /// Names and values, in the order of tables.
    pub fn iter(&self) -> impl Iterator<Item = (&'static str, &T)> {
        ROLES.into_iter().filter_map(|role| Some((role_name(role), self.get(role)?)))
    }

    /// Returns true if no role has a value.
    pub fn is_empty(&self) -> bool {
        self.iter().next().is_none()
    }
}
