//! The file of `NIGHTSPLAT_STATISTICS`: a line for every pipeline.

use serde_json::Value;

use crate::common::command::{command, refused_with};

const BENCH: &str = "bench --unchecked --repeats 1 --gaussians 10 --width 32 --height 16 --json";

#[test]
fn every_pipeline_has_a_line_with_its_kernel_and_constants() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("lines");
    let output = command(BENCH).env("NIGHTSPLAT_STATISTICS", &file).output().unwrap();
    assert!(output.status.success(), "{output:?}");
    let text = std::fs::read_to_string(file).unwrap();
    let lines: Vec<Value> = text.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    let is_blend = |line: &&Value| line["kernel"] == "blend_forward";
    let channels = |wanted: &str| {
        lines
            .iter()
            .filter(is_blend)
            .any(|line| line["constants"].as_str().unwrap().contains(wanted))
    };
    assert!(channels("channels: 3,") && channels("channels: 11,"), "{text}");
    assert!(lines.iter().all(|line| line["subgroup_size"].as_u64() > Some(0)), "{text}");
}

#[test]
fn a_file_that_cannot_be_written_is_named() {
    let file = tempfile::NamedTempFile::new().unwrap();
    let within = file.path().join("lines").display().to_string();
    let variable = [("NIGHTSPLAT_STATISTICS", within.as_str())];
    refused_with(BENCH, &variable, 1, &[&within, "NIGHTSPLAT_STATISTICS"]);
}
