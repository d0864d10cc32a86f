//! Judges whether a log-out removes the shared memory of a running graph.

use crate::doctor::finding::{Area, Finding};
use std::path::PathBuf;

/// First user number of a person: logind keeps the files of system users.
const FIRST_PERSON: u32 = 1000;

/// Settings that decide whether logind removes shared memory at log-out.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Logind {
    /// True if logind runs.
    pub runs: bool,
    /// Value of `RemoveIPC`, and the file that sets it.
    pub setting: Option<(bool, PathBuf)>,
    /// Number of this user.
    pub uid: u32,
    /// True if the user's services continue after log-out.
    pub lingers: bool,
}

/// Returns the last `RemoveIPC` of logind's configuration files, in the order in which logind reads them.
pub fn remove_ipc_setting(files: &[(PathBuf, String)]) -> Option<(bool, PathBuf)> {
    let mut setting = None;
    for (path, text) in files {
        for line in text.lines() {
            if let Some((key, value)) = line.split_once('=')
                && key.trim() == "RemoveIPC"
            {
                let on = matches!(value.trim().to_ascii_lowercase().as_str(), "yes" | "true" | "on" | "1" | "y" | "t");
                setting = Some((on, path.clone()));
            }
        }
    }
    setting
}

/// Checks that a log-out does not remove shared memory of a running graph.
pub fn remove_ipc(logind: &Logind) -> Finding {
    let ok = |found: String| Finding::ok(Area::Limits, "RemoveIPC", found);
    if !logind.runs {
        return ok("logind does not run here".to_owned());
    }
    if logind.uid < FIRST_PERSON {
        return ok(format!("not for user {}, a system user", logind.uid));
    }
    let found = match &logind.setting {
        Some((false, path)) => return ok(format!("no ({})", path.display())),
        Some((true, path)) => format!("yes ({})", path.display()),
        None => "not set, which means yes".to_owned(),
    };
    if logind.lingers {
        return ok(format!("{found}, but this user lingers"));
    }
    Finding::warning(
        Area::Limits,
        "RemoveIPC",
        found,
        "when you log out, logind removes the shared memory of running graphs: they fail",
        "write `[Login]` and `RemoveIPC=no` to /etc/systemd/logind.conf.d/carff.conf and restart systemd-logind; or \
         loginctl enable-linger; or run the graph as a service of a system user",
    )
}

#[cfg(test)]
mod tests {
    use super::super::testing::assert_level;
    use super::*;
    use crate::doctor::finding::Level;

    /// The last file that sets the value wins; comments are ignored.
    #[test]
    fn settings_of_logind() {
        let file = |name: &str, text: &str| (PathBuf::from(name), text.to_owned());
        let files =
            [file("a", "[Login]\n#RemoveIPC=no\n"), file("b", "RemoveIPC = yes\n"), file("c", "RemoveIPC=no\n")];
        assert_eq!(remove_ipc_setting(&files[..1]), None);
        assert_eq!(remove_ipc_setting(&files[..2]), Some((true, "b".into())));
        assert_eq!(remove_ipc_setting(&files), Some((false, "c".into())));
    }

    /// Only a person's files are removed, at a log-out that logind sees, unless a setting or lingering prevents it.
    #[test]
    fn log_outs() {
        let person = Logind { runs: true, setting: None, uid: 1000, lingers: false };
        assert_level(&remove_ipc(&person), Level::Warning);
        assert_level(&remove_ipc(&Logind { setting: Some((true, "x".into())), ..person.clone() }), Level::Warning);
        for well in [
            Logind { runs: false, ..person.clone() },
            Logind { uid: 999, ..person.clone() },
            Logind { lingers: true, ..person.clone() },
            Logind { setting: Some((false, "x".into())), ..person },
        ] {
            assert_level(&remove_ipc(&well), Level::Ok);
        }
    }
}
