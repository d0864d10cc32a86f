//! Assertions about findings, for the tests of the checks.

use crate::doctor::finding::{Finding, Level};

/// A mebibyte, bytes.
pub const MIB: u64 = 1 << 20;

/// Returns subject and level of each finding.
pub fn levels(findings: &[Finding]) -> Vec<(&'static str, Level)> {
    findings.iter().map(|f| (f.subject, f.level)).collect()
}

/// A finding that is not ok has a meaning and advice; an ok finding has neither.
#[track_caller]
pub fn assert_level(finding: &Finding, level: Level) {
    assert_eq!(finding.level, level, "{finding:?}");
    assert_eq!(finding.means.is_empty(), level == Level::Ok, "{finding:?}");
    assert_eq!(finding.advice.is_empty(), level == Level::Ok, "{finding:?}");
}
