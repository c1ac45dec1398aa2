//! `nightsplat doctor`, as a script runs it, and on machines that lack something.
#![cfg(feature = "cli")]
#![allow(clippy::unwrap_used, reason = "a failed unwrap is a failed test")]

use std::path::Path;
use std::process::{Command, Output};

use nightsplat::gpu::REQUIREMENTS;
use serde_json::Value;

fn doctor(environment: &[(&str, &Path)]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_nightsplat"))
        .args(["doctor", "--json"])
        .envs(environment.iter().copied())
        .output()
        .unwrap()
}

#[test]
fn json_holds_every_requirement_of_every_device_and_the_choice() {
    let output = doctor(&[]);
    assert!(output.status.success());
    let printed: Value = serde_json::from_slice(&output.stdout).unwrap();
    let devices = printed["devices"].as_array().unwrap();
    let chosen = &devices[printed["chosen"].as_u64().unwrap() as usize];
    assert!(chosen["memory"].as_u64() > Some(0) && chosen["subgroup_size"].as_u64() >= Some(4));
    for device in devices {
        let requirements = device["requirements"].as_array().unwrap();
        let names = requirements.iter().map(|requirement| requirement["name"].as_str().unwrap());
        assert!(names.eq(REQUIREMENTS.iter().map(|requirement| requirement.name)));
    }
    let mut requirements = chosen["requirements"].as_array().unwrap().iter();
    assert!(requirements.all(|requirement| requirement["met"] == true));
}

#[test]
#[cfg(target_os = "linux")]
fn without_a_loader_the_remedy_is_said() {
    let folder = tempfile::tempdir().unwrap();
    // The linker finds this file first, and it is no library.
    std::fs::write(folder.path().join("libvulkan.so.1"), "").unwrap();
    let output = doctor(&[("LD_LIBRARY_PATH", folder.path())]);
    let stderr = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(1), "{stderr}");
    assert!(output.stdout.is_empty());
    assert!(stderr.starts_with("error: there is no Vulkan loader"), "{stderr}");
    assert!(stderr.contains("apt install libvulkan1"), "{stderr}");
    assert_eq!(stderr.lines().count(), 1, "{stderr}");
}
