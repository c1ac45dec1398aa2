//! A test or check that is not run names what it lacks, so that a run which must have it fails.

use std::path::Path;
use std::process::Command;

use crate::architecture::files;

/// What a script or a test prints of its own accord cannot fail.
#[test]
fn tests_and_scripts_say_that_they_are_not_run_by_one_function() {
    let folders =
        [("src", "rs"), ("crates", "rs"), ("tests", "rs"), ("scripts", "sh"), ("scripts", "py")];
    for (path, text) in folders.into_iter().flat_map(|(folder, kind)| files(folder, kind)) {
        let is_the_one = path.ends_with("skips.rs") || path.ends_with("not-run.sh");
        for print in ["echo \"not run", "print(\"not run", "print(f\"not run", "!(\"not run"] {
            assert!(is_the_one || !text.contains(print), "{}: {print}", path.display());
        }
    }
}

#[test]
fn a_script_fails_if_what_it_lacks_is_required() {
    let code = |required: &str| {
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("scripts/not-run.sh");
        let mut bash = Command::new("bash");
        bash.arg(script).args(["chromium,ffmpeg", "a page"]).env("NIGHTSPLAT_REQUIRE", required);
        bash.output().unwrap().status.code()
    };
    assert_eq!((code(""), code("radv"), code("ffmpeg2")), (Some(0), Some(0), Some(0)));
    assert_eq!((code("chromium"), code("radv,ffmpeg")), (Some(1), Some(1)));
}
