//! `nightsplat doctor` in scripts, and on machines that lack something.

use nightsplat::gpu::REQUIREMENTS;
use serde_json::Value;

use crate::common::command::{command, json, refused_with, succeed};
use crate::common::not_run;
use crate::fixture;

#[test]
fn json_has_every_requirement_of_every_device_and_the_choice() {
    let printed = json(succeed("doctor --json"));
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
        assert!(device["limits"]["max_buffer_size"].as_u64() >= Some(1 << 30));
        assert!(device["driver"].is_string() && device.get("self_test").is_some());
    }
    assert_eq!(chosen["missing"].as_array().map(Vec::len), Some(0));
    assert_eq!(chosen["self_test"], "passed");
    let mut requirements = chosen["requirements"].as_array().unwrap().iter();
    assert!(requirements.all(|requirement| requirement["met"] == true));
}

#[test]
fn scheduler_variables_without_a_device_are_refused_in_one_line() {
    for (variable, value) in [("HIP_VISIBLE_DEVICES", "99"), ("ROCR_VISIBLE_DEVICES", "GPU-ff")] {
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
    let printed = json(succeed("doctor --json"));
    let chosen = &printed["devices"][printed["chosen"].as_u64().unwrap() as usize];
    let sizes = chosen["subgroup_sizes"].as_array().unwrap();
    assert!(sizes.contains(&chosen["subgroup_size"]), "{chosen}");
    let message =
        ["NIGHTSPLAT_SUBGROUP on", "`48` is no size", &format!("{} lanes", sizes.last().unwrap())];
    refused_with("bench", &[("NIGHTSPLAT_SUBGROUP", "48")], 2, &message);
}

#[test]
fn an_empty_list_of_gpus_leaves_the_software_device() {
    let printed = json(succeed("doctor --json"));
    let is_software = |device: &Value| device["kind"] == "software";
    if !printed["devices"].as_array().unwrap().iter().any(is_software) {
        return not_run("lavapipe", "there is no software device");
    }
    let empty = ["CUDA", "ROCR", "HIP"].map(|vendor| (format!("{vendor}_VISIBLE_DEVICES"), ""));
    let output = command("doctor --json").envs(empty).output().unwrap();
    let printed = json(&output.stdout);
    let chosen = &printed["devices"][printed["chosen"].as_u64().unwrap() as usize];
    let name = chosen["name"].as_str().unwrap();
    assert!(!name.contains("NVIDIA") && !name.contains("AMD"), "{name}");
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

#[test]
fn a_device_that_fails_the_self_test_is_not_used_and_doctor_says_why() {
    let planted = [("NIGHTSPLAT_FAULT", "self_test:5")];
    let parts = ["fails the self-test: subgroupInclusiveAdd is wrong", "NIGHTSPLAT_SUBGROUP"];
    refused_with("bench", &planted, 4, &parts);
    let output = command("doctor --json").envs(planted).output().unwrap();
    assert_eq!(output.status.code(), Some(4));
    let printed = json(&output.stdout);
    let devices = printed["devices"].as_array().unwrap();
    assert!(devices.iter().all(|device| device["self_test"] != "passed"), "{printed}");
    assert!(printed["verdict"].as_str().unwrap().starts_with("not ready"));
    let untested = [planted[0], ("NIGHTSPLAT_DEVICE_TEST", "off")];
    let output = command("check --help").envs(untested).output().unwrap();
    assert!(output.status.success());
}

#[test]
fn a_kernel_that_the_driver_refuses_is_named() {
    let planted = [("NIGHTSPLAT_FAULT", "refuse:adam")];
    refused_with("bench", &planted, 4, &["refuses", "kernel `adam (", "update the driver"]);
}

/// Also when the command is repeated, and not once the driver is another.
#[test]
fn a_driver_that_crashes_costs_a_line_that_names_device_and_kernel() {
    let cache = tempfile::tempdir().unwrap();
    let cache = cache.path().to_str().unwrap();
    let checking = [("XDG_CACHE_HOME", cache), ("NIGHTSPLAT_DEVICE_TEST", "always")];
    let [crashing, sound] = [Some(("NIGHTSPLAT_FAULT", "crash:depth_boxes")), None]
        .map(|fault| checking.into_iter().chain(fault).collect::<Vec<_>>());
    let parts = ["crashed when it compiled kernel `depth_boxes`", "update the driver", cache];
    refused_with("bench", &crashing, 4, &parts);
    let (run, out) = (fixture().named("@run"), format!("{cache}/out"));
    for command in [
        "bench".to_owned(),
        format!("eval {run}"),
        format!("render {run} --split test --out {out}"),
        format!("compare {run} {run}"),
        format!("edit {run} --floaters --out {out}.ply"),
    ] {
        refused_with(&command, &sound, 4, &parts);
    }
    let verdict = std::fs::read_dir(format!("{cache}/nightsplat")).unwrap().map(Result::unwrap);
    let verdict =
        verdict.map(|file| file.path()).find(|path| path.extension().unwrap() == "driver");
    std::fs::remove_file(verdict.unwrap()).unwrap();
    // A driver that compiles all is asked once.
    let refused = [&sound[..], &[("NIGHTSPLAT_FAULT", "refuse:self_test")]].concat();
    refused_with("bench", &refused, 4, &["refuses"]);
}
