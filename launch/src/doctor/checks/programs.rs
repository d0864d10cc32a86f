//! Judges the programs of the stages and their libraries.

use crate::doctor::finding::{Area, Finding};
use std::path::Path;

/// The libtorch version that the programs are built for.
const LIBTORCH: &str = "2.11.0";

/// Checks the version of the libtorch that the programs find; `needed` if the encoder computes with it.
pub fn libtorch(library: Option<&Path>, version: Option<&str>, needed: bool) -> Finding {
    let area = Area::Programs;
    let advice = "make libtorch, or use your own libtorch: make build LIBTORCH=/path/to/libtorch, and \
                  LD_LIBRARY_PATH=/path/to/libtorch/lib at run time";
    let Some(library) = library else {
        if needed {
            return Finding::error(area, "libtorch", "it is missing", "the encoder stage cannot start", advice);
        }
        let found = "none; training, evaluation, the window and `backend = \"tch\"` need it, this graph does not";
        return Finding::ok(area, "libtorch", found);
    };
    match version {
        Some(version) if version == LIBTORCH || version.starts_with(&format!("{LIBTORCH}+")) => {
            Finding::ok(area, "libtorch", format!("{version} ({})", library.display()))
        }
        Some(version) => {
            let found = format!("{version} ({}); the programs are built for {LIBTORCH}", library.display());
            let finding = if needed { Finding::error } else { Finding::warning };
            finding(area, "libtorch", found, "its programs may crash, or compute wrong results", advice)
        }
        None => Finding::warning(
            area,
            "libtorch",
            format!("{}, without a file `build-version` next to it", library.display()),
            format!("the version may differ from {LIBTORCH}"),
            advice,
        ),
    }
}

/// Checks the build of ONNX Runtime, or the reason why it cannot be loaded; `needed` if the encoder computes with it.
pub fn onnx_runtime(library: &Path, build: Result<&str, &str>, needed: bool) -> Finding {
    let (area, subject, wanted) = (Area::Programs, "ONNX Runtime", carff_inference::library::VERSION);
    let advice = format!("make onnxruntime, or name a libonnxruntime.so of {wanted} in ORT_DYLIB_PATH");
    match build {
        Ok(build) if build.contains(carff_inference::library::BUILD) => {
            Finding::ok(area, subject, format!("{wanted} ({})", library.display()))
        }
        Ok(build) => Finding::warning(
            area,
            subject,
            format!("{} is not {wanted}: {build}", library.display()),
            "the encoder's last bits may differ",
            advice,
        ),
        Err(error) => {
            let finding = if needed { Finding::error } else { Finding::warning };
            finding(area, subject, error, "the encoder stage cannot start with `backend = \"onnx\"`", advice.as_str())
        }
    }
}

/// Checks that a folder contains the stages' programs.
pub fn programs(folder: &Path, missing: &[String]) -> Finding {
    if missing.is_empty() {
        return Finding::ok(Area::Programs, "stages", format!("all in {}", folder.display()));
    }
    Finding::error(
        Area::Programs,
        "stages",
        format!("{} not in {}", missing.join(", "), folder.display()),
        "`carff launch` cannot start them",
        "make build; programs that are installed elsewhere must be in one folder",
    )
}

#[cfg(test)]
mod tests {
    use super::super::testing::assert_level;
    use super::*;
    use crate::doctor::finding::Level;

    /// The version must be the version of the build, with any suffix. Without need of it, none may be there.
    #[test]
    fn versions_of_libtorch() {
        let library = Some(Path::new("lib/libtorch_cpu.so"));
        assert_level(&libtorch(library, Some("2.11.0"), true), Level::Ok);
        assert_level(&libtorch(library, Some("2.11.0+cu130"), true), Level::Ok);
        assert_level(&libtorch(library, Some("2.11.01"), true), Level::Error);
        assert_level(&libtorch(library, Some("2.13.0"), true), Level::Error);
        assert_level(&libtorch(library, Some("2.13.0"), false), Level::Warning);
        assert_level(&libtorch(library, None, true), Level::Warning);
        assert_level(&libtorch(None, None, true), Level::Error);
        assert_level(&libtorch(None, None, false), Level::Ok);
    }

    /// A missing library is an error where the encoder needs it; another version is a warning.
    #[test]
    fn versions_of_onnx_runtime() {
        let library = Path::new("lib/libonnxruntime.so.1");
        assert_level(&onnx_runtime(library, Ok(carff_inference::library::BUILD), true), Level::Ok);
        assert_level(&onnx_runtime(library, Ok("git-commit-id=0123456"), true), Level::Warning);
        assert_level(&onnx_runtime(library, Err("not found"), true), Level::Error);
        assert_level(&onnx_runtime(library, Err("not found"), false), Level::Warning);
    }

    /// Missing programs are reported by name.
    #[test]
    fn missing_programs() {
        assert_level(&programs(Path::new("bin"), &[]), Level::Ok);
        let finding = programs(Path::new("bin"), &["carff-prober".to_owned()]);
        assert_level(&finding, Level::Error);
        assert!(finding.found.contains("carff-prober not in bin"), "{finding:?}");
    }
}
