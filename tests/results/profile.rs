//! A camera profile end to end: fitted, used, and named with all its results.

use std::fs;
use std::path::Path;

use serde_json::Value;

use crate::common::command::{refused, run, succeed};

/// The label of results that depend on references.
const LABEL: &str = "a camera profile of 9 pairs of set";

fn psnr(command: &str) -> (f64, Value) {
    let told: Value = serde_json::from_str(&succeed(command)).unwrap();
    (told["scene"]["psnr"].as_f64().unwrap(), told)
}

#[test]
fn a_profile_is_fitted_used_and_named_with_every_result() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).display().to_string();
    let (set, file, out) = (path("set"), path("profile.toml"), path("run"));
    succeed(&format!("synth {set} --views 9 --width 64 --height 48"));

    let told = succeed(&format!("tone fit {set} --profile --out {file} --cross-validate"));
    assert!(told.contains("held out: set 5/5") && told.contains(LABEL), "{told}");
    let text = fs::read_to_string(&file).unwrap();
    assert!(text.contains("reference = \"set\"") && text.contains("matrix = ["), "{text}");
    succeed(&format!("tone fit {set} --profile --out {file}.again"));
    assert_eq!(fs::read_to_string(format!("{file}.again")).unwrap(), text);

    let (auto, plain) = psnr(&format!("tone apply {set} --json"));
    let page = path("page.html");
    let (profiled, told) =
        psnr(&format!("tone apply {set} --profile {file} --json --report {page}"));
    assert!(profiled > auto + 3.0, "{profiled} dB, the automatic curve {auto} dB");
    assert_eq!(
        (told["with_reference"].as_str(), &plain["with_reference"]),
        (Some(LABEL), &Value::Null)
    );
    assert!(succeed(&format!("tone apply {set} --profile {file}")).contains(LABEL));
    assert!(fs::read_to_string(page).unwrap().contains(LABEL));

    let train = format!("train {set} --steps 2 --sh-degree 0");
    assert!(succeed(&format!("{train} --profile {file} --out {out}")).contains(LABEL));
    let metrics = |run: &str| -> Value {
        serde_json::from_slice(&fs::read(Path::new(run).join("metrics.json")).unwrap()).unwrap()
    };
    assert_eq!(metrics(&out)["with_reference"], LABEL);
    // The run does not need the file.
    fs::remove_file(&file).unwrap();
    assert!(succeed(&format!("eval {out}")).contains(LABEL));
    let again: Value = serde_json::from_str(&succeed(&format!("eval {out} --json"))).unwrap();
    assert_eq!(again["with_reference"], LABEL);
    let plain = path("plain");
    assert!(!succeed(&format!("{train} --out {plain}")).contains(LABEL));
    assert_eq!(metrics(&plain)["with_reference"], Value::Null);

    fs::rename(format!("{file}.again"), &file).unwrap();
    let sweep = path("sweep");
    run(
        &format!("sweep {set} --out {sweep} --seeds 1 --steps 2 --sh-degree 0 --profile {file}"),
        0,
    );
    for name in ["leaderboard.md", "leaderboard.csv", "index.html"] {
        let text = fs::read_to_string(Path::new(&sweep).join(name)).unwrap();
        assert!(
            text.contains("with reference") || text.contains("with_reference"),
            "{name}: {text}"
        );
    }
}

#[test]
fn an_invalid_profile_is_refused_in_one_line() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).display().to_string();
    let (set, file) = (path("set"), path("profile.toml"));
    succeed(&format!("synth {set} --views 3 --width 32 --height 24"));
    succeed(&format!("tone fit {set} --profile --out {file}"));
    let good = fs::read_to_string(&file).unwrap();

    let train = format!("train {set} --out {} --steps 2", path("run"));
    let tone = format!("tone apply {set}");
    for command in [&train, &tone] {
        refused(&format!("{command} --profile {file} --curve ap3"), 2, &["--profile", "--curve"]);
        refused(&format!("{command} --profile {file} --gain 2"), 2, &["--profile", "--gain"]);
        refused(&format!("{command} --curve {file}"), 3, &["profile.toml", "--profile"]);
        refused(&format!("{command} --curve profile"), 2, &["--profile FILE"]);
        refused(&format!("{command} --profile {}", path("absent.toml")), 3, &["absent.toml"]);
    }
    refused(&format!("{train} --profile {file} --set tone.brightness=0.5"), 2, &["references"]);
    refused(&format!("{train} --set tone.curve=profile"), 2, &["--profile"]);
    for (from, to, part) in [
        ("pairs = 3", "pairs = 0", "0 pairs"),
        ("pairs = 3", "pears = 3", "pears"),
        ("bias = [", "bias = [nan, 0.0, 0.0]\n#", "NaN"),
        ("gain = [", "gain = [-1.0, 1.0, 1.0]\n#", "gain of red"),
        ("segments = [\n    [", "segments = [\n    [0.99, ", "red has 18 values"),
    ] {
        fs::write(&file, good.replacen(from, to, 1)).unwrap();
        refused(&format!("{tone} --profile {file}"), 3, &["profile.toml", part]);
    }
    let mut lines: Vec<String> = good.lines().map(str::to_owned).collect();
    let red = lines.iter().position(|line| line.starts_with("segments")).unwrap() + 1;
    lines[red] = format!("    [0.9{}],", ", 0.1".repeat(16));
    fs::write(&file, lines.join("\n")).unwrap();
    refused(&format!("{tone} --profile {file}"), 3, &["segments of red fall from 0.9 to 0.1"]);

    refused(&format!("tone fit {set} --profile --family ase"), 2, &["--profile", "--family"]);
    fs::remove_dir_all(folder.path().join("set/high")).unwrap();
    refused(&format!("tone fit {set} --profile --out {file}"), 3, &["contains no pairs"]);
    fs::create_dir(folder.path().join("set/high")).unwrap();
    refused(&format!("tone fit {set} --profile --out {file}"), 3, &["set/"]);
}
