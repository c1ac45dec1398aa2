//! Installed files other than the program: completions, man pages, and the package itself.

use std::process::Command;
use std::{fs, str};

use crate::common::command::{refused, says, succeed};

#[test]
fn every_shell_completes_every_subcommand() {
    for shell in ["bash", "elvish", "fish", "powershell", "zsh"] {
        let script = succeed(&format!("completions {shell}"));
        says(&script, &["train", "export", "doctor", "device", "max-gaussians"]);
        // Values of options, where the shell has them.
        if shell == "bash" {
            assert!(["balanced", "ap3", "tonemapper", "lita"].iter().all(|it| script.contains(it)));
        }
    }
    refused("completions tcsh", 2, &["tcsh", "zsh"]);
}

#[test]
fn bash_loads_the_completions_and_completes_with_them() {
    let Ok(version) = Command::new("bash").arg("--version").output() else {
        return crate::common::not_run("bash", "it is not installed");
    };
    assert!(version.status.success());
    let script = succeed("completions bash")
        + "COMP_WORDS=(nightsplat exp); COMP_CWORD=1; _nightsplat nightsplat exp nightsplat; echo ${COMPREPLY[*]}";
    let output = Command::new("bash").args(["-c", &script]).output().unwrap();
    assert_eq!(str::from_utf8(&output.stdout).unwrap().trim(), "export");
}

#[test]
fn every_subcommand_has_a_man_page() {
    let folder = tempfile::tempdir().unwrap();
    let dir = folder.path().join("man/man1");
    succeed(&format!("man {}", dir.display()));
    let page = |name: &str| fs::read_to_string(dir.join(name)).unwrap();
    let main = page("nightsplat.1");
    for command in succeed("--help").lines().skip_while(|line| *line != "Commands:").skip(1) {
        // The first two columns; continuations of long help lines are indented further.
        let Some(name) = command.strip_prefix("  ").filter(|text| !text.starts_with(' ')) else {
            break;
        };
        let name = name.split(' ').next().unwrap();
        if name == "help" {
            continue;
        }
        assert!(main.contains(&format!("nightsplat\\-{name}(1)")), "nightsplat.1 lacks {name}");
        assert!(page(&format!("nightsplat-{name}.1")).contains(".SH OPTIONS"), "{name}");
    }
    for name in ["tone-list", "tone-apply", "check", "synth", "completions", "man"] {
        assert!(page(&format!("nightsplat-{name}.1")).contains(".SH OPTIONS"), "{name}");
    }
    assert!(page("nightsplat-train.1").contains("\\-\\-max\\-gaussians"));
    // A file is not a folder.
    refused(&format!("man {}/nightsplat.1", dir.display()), 1, &["nightsplat.1"]);
}

#[test]
fn the_package_has_all_that_its_build_needs_and_little_else() {
    let cargo = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    let mut list = Command::new(cargo);
    list.args(["package", "--list", "--allow-dirty", "--offline"]);
    let output = list.current_dir(env!("CARGO_MANIFEST_DIR")).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let files = String::from_utf8(output.stdout).unwrap();
    let has = |name: &str| files.lines().any(|file| file == name);
    for name in
        ["build.rs", "build/rust.rs", "src/main.rs", "README.md", "LICENSE-MIT", "Cargo.lock"]
    {
        assert!(has(name), "{name} is not packaged");
    }
    assert!(files.contains("shaders-glsl/splats/render/blend_forward.comp"), "no shaders");
    for folder in ["tests/", "scripts/", ".ci/", "target/"] {
        assert!(!files.lines().any(|file| file.starts_with(folder)), "{folder} is packaged");
    }
}

/// A file of the repository.
fn file(name: &str) -> String {
    fs::read_to_string(std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join(name)).unwrap()
}

#[test]
fn archives_are_stripped_and_the_container_has_the_programs_of_pose_and_of_videos() {
    assert!(file(".github/workflows/release.yml").contains("CARGO_PROFILE_RELEASE_STRIP: symbols"));
    assert!(file("scripts/package.sh").contains("*-linux-*) strip "));
    let container = file("Containerfile");
    let (_, packages) = container.split_once("no-install-recommends \\\n").unwrap();
    let packages = packages.lines().next().unwrap();
    for program in ["colmap", "ffmpeg", "mesa-vulkan-drivers"] {
        assert!(packages.split_whitespace().any(|package| package == program), "{packages}");
    }
}
