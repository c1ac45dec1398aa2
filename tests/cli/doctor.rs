//! `nightsplat doctor` in scripts, and on machines that lack something.
#![cfg(feature = "cli")]
#![allow(clippy::unwrap_used, reason = "a failed unwrap is a failed test")]

use nightsplat::gpu::REQUIREMENTS;
use serde_json::Value;

use crate::common::command::{command, refused_with, succeed};
use crate::common::not_run;

#[test]
fn json_has_every_requirement_of_every_device_and_the_choice() {
    let printed: Value = serde_json::from_str(&succeed("doctor --json")).unwrap();
    let devices = printed["devices"].as_array().unwrap();
    let chosen = &devices[printed["chosen"].as_u64().unwrap() as usize];
    assert!(chosen["memory"].as_u64() > Some(0) && chosen["subgroup_size"].as_u64() >= Some(4));
    for device in devices {
        let requirements = device["requirements"].as_array().unwrap();
        let names = requirements.iter().map(|requirement| requirement["name"].as_str().unwrap());
        assert!(names.eq(REQUIREMENTS.iter().map(|requirement| requirement.name)));
        assert_eq!(device["uuid"].as_str().map(str::len), Some(36));
        assert!(device["kind"].is_string() && device.get("pci").is_some());
        assert!(device["limits"]["max_storage_buffer_range"].as_u64() >= Some(1 << 27));
    }
    assert_eq!(chosen["missing"].as_array().map(Vec::len), Some(0));
    let mut requirements = chosen["requirements"].as_array().unwrap().iter();
    assert!(requirements.all(|requirement| requirement["met"] == true));
}

#[test]
fn scheduler_variables_without_a_device_are_refused_in_one_line() {
    for (variable, value) in [("CUDA_VISIBLE_DEVICES", "99"), ("ROCR_VISIBLE_DEVICES", "GPU-ff")] {
        let message = [&format!("{variable}={value}"), "which Vulkan does not have", "--device"];
        for command in ["doctor", "bench"] {
            refused_with(command, &[(variable, value)], 4, &message.map(|part| part as &str));
        }
    }
    for choice in ["uuid:fedcba98", "pci:ffff:ff:1f.7", "no such device"] {
        let command = format!("bench --device {}", choice.replace(' ', "_"));
        refused_with(&command, &[], 4, &["there is no Vulkan device", "there are: "]);
    }
    refused_with("bench --device uuid:xyz", &[], 2, &["is no UUID"]);
}

#[test]
fn an_unsupported_subgroup_size_is_refused_in_one_line_with_the_supported_ones() {
    let printed: Value = serde_json::from_str(&succeed("doctor --json")).unwrap();
    let chosen = &printed["devices"][printed["chosen"].as_u64().unwrap() as usize];
    let sizes = chosen["subgroup_sizes"].as_array().unwrap();
    assert!(sizes.contains(&chosen["subgroup_size"]), "{chosen}");
    let message =
        ["NIGHTSPLAT_SUBGROUP on", "`48` is no size", &format!("{} lanes", sizes.last().unwrap())];
    refused_with("bench", &[("NIGHTSPLAT_SUBGROUP", "48")], 2, &message);
}

#[test]
fn an_empty_list_of_gpus_leaves_the_software_device() {
    let printed: Value = serde_json::from_str(&succeed("doctor --json")).unwrap();
    let is_software = |device: &Value| device["kind"] == "software";
    if !printed["devices"].as_array().unwrap().iter().any(is_software) {
        return not_run("lavapipe", "there is no software device");
    }
    let empty = ["CUDA", "ROCR", "HIP"].map(|vendor| (format!("{vendor}_VISIBLE_DEVICES"), ""));
    let output = command("doctor --json").envs(empty).output().unwrap();
    let printed: Value = serde_json::from_slice(&output.stdout).unwrap();
    let chosen = &printed["devices"][printed["chosen"].as_u64().unwrap() as usize];
    assert!(
        !["NVIDIA", "AMD"].iter().any(|vendor| chosen["name"].as_str().unwrap().contains(vendor))
    );
    let reason = "CUDA_VISIBLE_DEVICES= ROCR_VISIBLE_DEVICES= HIP_VISIBLE_DEVICES=";
    assert_eq!(printed["reason"], reason);
}

#[test]
#[cfg(target_os = "linux")]
fn without_a_loader_the_remedy_is_printed() {
    let folder = tempfile::tempdir().unwrap();
    // The linker finds this file first, and it is not a library.
    std::fs::write(folder.path().join("libvulkan.so.1"), "").unwrap();
    let environment = [("LD_LIBRARY_PATH", folder.path().to_str().unwrap())];
    let remedy = ["there is no Vulkan loader", "apt install libvulkan1"];
    refused_with("doctor --json", &environment, 4, &remedy);
}
