//! The list of what the compilers of GPUs make of the kernels, compared as `scripts/test-on-gpu-compilers.sh` does it.

use std::fs;
use std::path::Path;
use std::process::Command;

use serde_json::{Value, json};

use crate::common::not_run;

/// A line of statistics of kernel `name`.
fn line(name: &str, numbers: Value) -> Value {
    let mut line = json!({
        "device": "null", "driver": "radv", "subgroup_size": 32, "kernel": name, "constants": "",
        "registers": 8, "spills": 0, "scratch": 0, "instructions": 100,
    });
    line.as_object_mut().unwrap().extend(numbers.as_object().unwrap().clone());
    line
}

#[test]
fn a_spill_and_another_list_of_kernels_fail_and_more_instructions_are_a_warning() {
    let Ok(_) = Command::new("python3").arg("--version").output() else {
        return not_run("python3", "it is not installed");
    };
    let folder = tempfile::tempdir().unwrap();
    let [list, statistics] = ["navi.json", "lines.jsonl"].map(|name| folder.path().join(name));
    let compare = |lines: &[Value], option: Option<&str>| {
        let lines: String = lines.iter().map(|line| format!("{line}\n")).collect();
        fs::write(&statistics, lines).unwrap();
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("scripts/gpu-compilers/ledger.py");
        let mut python = Command::new("python3");
        python.arg(script).args(option).arg(&list).arg(&statistics);
        let output = python.env("NIGHTSPLAT_REQUIRE", "radv").output().unwrap();
        (output.status.code(), String::from_utf8(output.stdout).unwrap())
    };
    let known = || line("own", json!({}));
    let both = [known(), line("other", json!({ "spills": 3 }))];
    assert_eq!(compare(&both, Some("--write")).0, Some(0));
    assert_eq!(compare(&both, None).0, Some(0), "a spill that was there before");
    let changed = |numbers| compare(&[known(), line("other", numbers)], None);
    let (code, text) = changed(json!({ "spills": 3, "instructions": 111 }));
    assert!(
        code == Some(0) && text.contains("warning: navi: other: instructions 100 > 111"),
        "{text}"
    );
    for (numbers, problem) in [
        (json!({ "spills": 4 }), "other: spills 3 > 4"),
        (json!({ "spills": 3, "scratch": 64 }), "other: scratch 0 > 64"),
        (json!({ "spills": 3, "kernel": "third" }), "third: is not in the list"),
        (json!({ "spills": 3, "kernel": "third" }), "other: is in the list"),
        (json!({ "spills": 3, "kernel": "third" }), "third: spills 0 > 3"),
    ] {
        let (code, text) = changed(numbers);
        assert!(code == Some(1) && text.contains(problem), "{text}");
    }
    let newer = line("own", json!({ "driver": "newer radv" }));
    assert_eq!(compare(&[newer], None).0, Some(1), "a required list that says nothing");
}
