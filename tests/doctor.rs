//! `nightsplat doctor`, as a script runs it, and on machines that lack something.
#![cfg(feature = "cli")]
#![allow(clippy::unwrap_used, reason = "a failed unwrap is a failed test")]

use nightsplat::gpu::REQUIREMENTS;
use serde_json::Value;

mod common;
use common::command::{refused_with, succeed};

#[test]
fn json_holds_every_requirement_of_every_device_and_the_choice() {
    let printed: Value = serde_json::from_str(&succeed("doctor --json")).unwrap();
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
    let environment = [("LD_LIBRARY_PATH", folder.path().to_str().unwrap())];
    let remedy = ["there is no Vulkan loader", "apt install libvulkan1"];
    refused_with("doctor --json", &environment, 4, &remedy);
}
