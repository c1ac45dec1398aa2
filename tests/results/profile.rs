//! A camera profile end to end: fitted, used, and named with all its results.

use std::fs;

use serde_json::Value;

use crate::common::command::{Folder, json, says};

/// The label of results that depend on references.
const LABEL: &str = "a camera profile of 9 pairs of set";

#[test]
fn a_profile_is_fitted_used_and_named_with_every_result() {
    let folder = Folder::empty();
    let file = folder.path("profile.toml");
    folder.succeed("synth @set --views 9 --width 64 --height 48");

    let told = folder.succeed("tone fit @set --profile --out @profile.toml --cross-validate");
    says(&told, &["held out: set 5/5", LABEL]);
    let text = folder.text("profile.toml");
    says(&text, &["reference = \"set\"", "matrix = ["]);
    folder.succeed("tone fit @set --profile --out @again.toml");
    assert_eq!(folder.text("again.toml"), text);

    let apply = |options: &str| folder.succeed(&format!("tone apply @set {options}"));
    let psnr = |told: &Value| told["scene"]["psnr"].as_f64().unwrap();
    let plain = json(apply("--json"));
    let told = json(apply("--profile @profile.toml --json --report @page.html"));
    let (profiled, auto) = (psnr(&told), psnr(&plain));
    assert!(profiled > auto + 3.0, "{profiled} dB, the automatic curve {auto} dB");
    assert_eq!((&told["with_reference"], &plain["with_reference"]), (&LABEL.into(), &Value::Null));
    says(&apply("--profile @profile.toml"), &[LABEL]);
    says(&folder.text("page.html"), &[LABEL]);

    let train = "train @set --steps 2 --sh-degree 0";
    says(&folder.succeed(&format!("{train} --profile @profile.toml --out @run")), &[LABEL]);
    assert_eq!(folder.json("run/metrics.json")["with_reference"], LABEL);
    // The run does not need the file.
    fs::remove_file(&file).unwrap();
    says(&folder.succeed("eval @run"), &[LABEL]);
    assert_eq!(json(folder.succeed("eval @run --json"))["with_reference"], LABEL);
    assert!(!folder.succeed(&format!("{train} --out @plain")).contains(LABEL));
    assert_eq!(folder.json("plain/metrics.json")["with_reference"], Value::Null);

    fs::rename(folder.path("again.toml"), &file).unwrap();
    let sweep = "sweep @set --out @sweep --seeds 1 --steps 2 --sh-degree 0";
    folder.succeed(&format!("{sweep} --profile @profile.toml"));
    for name in ["leaderboard.md", "leaderboard.csv", "index.html"] {
        says(&folder.text(&format!("sweep/{name}")).replace('_', " "), &["with reference"]);
    }
}

#[test]
fn an_invalid_profile_is_refused_in_one_line() {
    let folder = Folder::empty();
    folder.succeed("synth @set --views 3 --width 32 --height 24");
    folder.succeed("tone fit @set --profile --out @profile.toml");
    let good = folder.text("profile.toml");
    for command in ["train @set --out @run --steps 2", "tone apply @set"] {
        let table = "
            2 | COMMAND --profile @profile.toml --curve ap3 | --profile & --curve
            2 | COMMAND --profile @profile.toml --gain 2 | --profile & --gain
            3 | COMMAND --curve @profile.toml | profile.toml & --profile
            2 | COMMAND --curve profile | --profile FILE
            3 | COMMAND --profile @absent.toml | absent.toml";
        folder.refuses_all(&table.replace("COMMAND", command));
    }
    folder.refuses_all(
        "
        2 | train @set --out @run --steps 2 --profile @profile.toml --set tone.brightness=0.5 | references
        2 | train @set --out @run --steps 2 --set tone.curve=profile | --profile",
    );
    let mut lines: Vec<String> = good.lines().map(str::to_owned).collect();
    let red = lines.iter().position(|line| line.starts_with("segments")).unwrap() + 1;
    lines[red] = format!("    [0.9{}],", ", 0.1".repeat(16));
    let changed = |from: &str, to: &str| good.replacen(from, to, 1);
    for (text, part) in [
        (changed("pairs = 3", "pairs = 0"), "0 pairs"),
        (changed("pairs = 3", "pears = 3"), "pears"),
        (changed("bias = [", "bias = [nan, 0.0, 0.0]\n#"), "NaN"),
        (changed("gain = [", "gain = [-1.0, 1.0, 1.0]\n#"), "gain of red"),
        (changed("segments = [\n    [", "segments = [\n    [0.99, "), "red has 18 values"),
        (lines.join("\n"), "segments of red fall from 0.9 to 0.1"),
    ] {
        folder.write("profile.toml", text);
        folder.refused("tone apply @set --profile @profile.toml", 3, &["profile.toml", part]);
    }
    folder.refused("tone fit @set --profile --family ase", 2, &["--profile", "--family"]);
    let fit = "tone fit @set --profile --out @profile.toml";
    fs::remove_dir_all(folder.path("set/high")).unwrap();
    folder.refused(fit, 3, &["contains no pairs"]);
    fs::create_dir(folder.path("set/high")).unwrap();
    folder.refused(fit, 3, &["set/"]);
}
