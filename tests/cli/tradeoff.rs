//! A comparison trains every point once, survives being interrupted, and says what time and memory buy.
#![cfg(feature = "cli")]
#![allow(clippy::unwrap_used, reason = "a failed unwrap is a failed test")]

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use serde_json::Value;

use crate::common::command::{refused, run};

/// The smallest set with views to score.
fn set() -> &'static Path {
    static SET: OnceLock<tempfile::TempDir> = OnceLock::new();
    SET.get_or_init(|| {
        let folder = tempfile::tempdir().unwrap();
        run(&format!("synth {} --views 9 --width 24 --height 16", folder.path().display()), 0);
        folder
    })
    .path()
}

struct Tradeoff {
    folder: tempfile::TempDir,
    arguments: String,
}

impl Tradeoff {
    fn new(options: &str) -> Self {
        Self::of(set(), options)
    }

    fn of(set: &Path, options: &str) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let (set, out) = (set.display(), folder.path().display());
        Self { arguments: format!("tradeoff {set} --out {out} {options}"), folder }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn read(&self, name: &str) -> String {
        fs::read_to_string(self.path(name)).unwrap()
    }

    /// The names of the points that are left.
    fn left(&self) -> Vec<String> {
        let (lines, _) = run(&format!("{} --dry-run", self.arguments), 0);
        let names = lines.lines().filter_map(|line| line.split_whitespace().next());
        names.filter(|name| name.starts_with("preset=")).map(str::to_owned).collect()
    }
}

#[test]
fn points_are_trained_once_scored_on_the_way_and_compared() {
    let options = "--presets draft,paper --no-knobs --knob sh_degree=1,2 --steps 6 --eval-every 2";
    let tradeoff = Tradeoff::new(options);
    let points = ["preset=draft", "preset=paper", "preset=balanced", "preset=balanced,sh_degree=1"];
    let left = tradeoff.left();
    assert_eq!(left[..4], points);
    assert!(
        left.len() == 5 && !tradeoff.path("tradeoff.toml").exists(),
        "--dry-run writes nothing"
    );

    let (shown, _) = run(&tradeoff.arguments, 0);
    for part in ["PSNR, dB", "processor time, s", "device, MiB", "sh_degree = 2", "index.html"] {
        assert!(shown.contains(part), "no `{part}` in: {shown}");
    }
    let csv = tradeoff.read("tradeoff.csv");
    assert!(csv.starts_with("preset,knob,value,runs,psnr,psnr_sd,"), "{csv}");
    assert_eq!(csv.lines().count(), 6);
    assert!(csv.lines().nth(4).unwrap().starts_with("balanced,sh_degree,1,1,"), "{csv}");
    let anytime = tradeoff.read("anytime.csv");
    assert!(
        anytime.starts_with("point,step,seconds,processor_seconds,joules,gaussians,psnr,ssim\n")
    );
    let steps: Vec<&str> =
        anytime.lines().filter(|line| line.starts_with("preset=draft,")).collect();
    assert_eq!(steps.len(), 3, "{anytime}");
    let seconds: Vec<f64> =
        steps.iter().map(|line| line.split(',').nth(2).unwrap().parse().unwrap()).collect();
    assert!(seconds.is_sorted() && seconds[0] > 0.0, "{anytime}");
    let metrics: Value = serde_json::from_str(&tradeoff.read("preset=draft/metrics.json")).unwrap();
    assert_eq!(
        metrics["seconds"].as_f64().map(|it| format!("{it:.3}")),
        Some(format!("{:.3}", seconds[2]))
    );
    assert!(metrics["spent"]["device_bytes"].as_u64().unwrap() > 1000, "{metrics}");
    let html = tradeoff.read("index.html");
    assert!(
        html.contains("against their reference images") && html.contains("on the way: sh_degree")
    );
    for outside in ["http:", "https:", "<script", "<link", "@import", "url("] {
        assert!(!html.contains(outside), "{outside}");
    }
    // Plots, then pictures, then tables.
    let at = |what: &str| html.find(what).unwrap();
    assert!(at("<svg") < at("<img") && at("<img") < at("<table"));
    assert!(tradeoff.read("preset=paper/log.txt").contains("--plan none"));
    assert!(tradeoff.path("preset=draft/plan.toml").is_file());

    // As if it had been killed while a point was trained: that one is trained anew, to the same bits.
    let model = |point: &str| fs::read(tradeoff.path(point).join("model.ply")).unwrap();
    let trained = |point: &str| {
        fs::metadata(tradeoff.path(point).join("model.ply")).unwrap().modified().unwrap()
    };
    let (bits, before) = (model(points[3]), points.map(trained));
    fs::remove_file(tradeoff.path(points[3]).join("metrics.json")).unwrap();
    assert_eq!(tradeoff.left(), [points[3]]);
    let (json, _) = run(&format!("{} --json", tradeoff.arguments), 0);
    let again: Vec<bool> =
        points.iter().zip(before).map(|(point, before)| trained(point) != before).collect();
    assert_eq!(again, [false, false, false, true]);
    assert!(bits == model(points[3]), "the same seed, the same bits");
    let json: Value = serde_json::from_str(&json).unwrap();
    assert_eq!(json["scored_against"], "references");
    let of = |index: usize, what: &str| json["points"][index]["mean"][what].as_f64().unwrap();
    let difference = json["points"][3]["difference"]["psnr"].as_f64().unwrap();
    assert!((difference - (of(3, "psnr") - of(2, "psnr"))).abs() < 1e-9, "{json}");
    assert!(json["points"].as_array().unwrap().iter().any(|point| point["on_front"] == true));
    assert!(tradeoff.left().is_empty());
    // More points may join; other options may not.
    let wider =
        Tradeoff { arguments: format!("{} --knob ssim_weight=0", tradeoff.arguments), ..tradeoff };
    assert_eq!(wider.left(), ["preset=balanced,ssim_weight=0"]);
    let other = wider.arguments.replace("--steps 6", "--steps 7");
    refused(&other, 1, &["another tradeoff", "--out"]);
}

#[test]
fn a_point_that_fails_is_named_and_the_others_finish() {
    let tradeoff =
        Tradeoff::new("--presets draft --no-knobs --knob device=voodoo --steps 2 --seeds 1,2");
    let (shown, said) = run(&tradeoff.arguments, 1);
    assert!(shown.contains("draft") && shown.contains("sd"), "{shown}");
    for part in ["device=voodoo", "error: 2 of 6 points were skipped", "voodoo"] {
        assert!(said.contains(part), "no `{part}` in: {said}");
    }
    let html = tradeoff.read("index.html");
    assert!(html.contains("device=voodoo,seed=1 was skipped: "), "{html}");
    let csv = tradeoff.read("tradeoff.csv");
    assert!(csv.lines().nth(1).unwrap().starts_with("draft,,,2,"), "{csv}");
    assert!(csv.lines().nth(3).unwrap().starts_with("balanced,device,voodoo,0,,"), "{csv}");
}

#[test]
fn without_references_the_held_out_views_own_targets_are_what_is_scored_against() {
    let copy = tempfile::tempdir().unwrap();
    let status =
        std::process::Command::new("cp").arg("-r").arg(set()).arg(copy.path()).status().unwrap();
    assert!(status.success());
    let root = copy.path().join(set().file_name().unwrap());
    fs::remove_dir_all(root.join("high")).unwrap();
    let tradeoff = Tradeoff::of(&root, "--presets draft --no-knobs --steps 2 --json");
    let (json, _) = run(&tradeoff.arguments, 0);
    let json: Value = serde_json::from_str(&json).unwrap();
    assert_eq!(json["scored_against"], "pseudo_gt");
    assert!(json["points"][0]["mean"]["psnr"].as_f64().unwrap() > 3.0, "{json}");
    let html = tradeoff.read("index.html");
    assert!(html.contains("against their own pseudo-GT") && html.contains("<b>pseudo-GT</b>"));
    assert!(tradeoff.left().is_empty());
}

#[test]
fn misuse_is_refused_before_anything_is_trained() {
    let refused = |options: &str, code: i32, parts: &[&str]| {
        let tradeoff = Tradeoff::new(options);
        refused(&tradeoff.arguments, code, parts);
        assert_eq!(fs::read_dir(tradeoff.folder.path()).unwrap().count(), 0, "{options}");
    };
    refused("--knob density.grad=1", 2, &["density.grad", "nearest"]);
    refused("--knob steps", 2, &["--knob steps", "KEY=V1,V2"]);
    refused("--knob steps=many", 2, &["steps (--steps) is \"many\"", "a whole number"]);
    refused("--knob downscale=2,4", 2, &["downscale", "resolution_steps"]);
    refused("--preset fast", 2, &["--presets"]);
    refused("--presets fast,slow", 2, &["slow", "draft"]);
    refused("--device voodoo", 4, &["voodoo"]);
    refused("--reference nowhere", 3, &["nowhere"]);
    let nowhere = tempfile::tempdir().unwrap().path().join("set");
    let (_, said) = run(&format!("tradeoff {0} --out {0}/out", nowhere.display()), 3);
    assert!(said.contains("is not a folder") && !nowhere.exists(), "{said}");

    // A set of one photograph has none to score.
    let one = tempfile::tempdir().unwrap();
    run(&format!("synth {} --views 2 --width 24 --height 16", one.path().display()), 0);
    for name in ["transforms_test.json", "transforms_val.json"] {
        let path = one.path().join(name);
        let mut list: Value = serde_json::from_str(&fs::read_to_string(&path).unwrap()).unwrap();
        list["frames"] = Value::Array(vec![]);
        fs::write(path, list.to_string()).unwrap();
    }
    let tradeoff = Tradeoff::of(one.path(), "--steps 2");
    let (_, said) = run(&tradeoff.arguments, 3);
    let line = said.lines().last().unwrap();
    assert!(line.contains(one.path().to_str().unwrap()), "{line}");
    assert!(line.contains("no held-out view to score"), "{line}");
    assert!(!tradeoff.path("tradeoff.toml").exists());

    // A folder of another dataset, and one of something else.
    let tradeoff = Tradeoff::new("--presets draft --no-knobs --steps 1");
    run(&tradeoff.arguments, 0);
    let two = tempfile::tempdir().unwrap();
    run(&format!("synth {} --views 9 --width 24 --height 16", two.path().display()), 0);
    let other = tradeoff.arguments.replace(set().to_str().unwrap(), two.path().to_str().unwrap());
    crate::common::command::refused(&other, 1, &["another", "--out"]);
    fs::remove_file(tradeoff.path("tradeoff.toml")).unwrap();
    crate::common::command::refused(
        &tradeoff.arguments,
        1,
        &["index.html", "no tradeoff wrote", "--out"],
    );
}

#[test]
fn help_names_its_options_and_fits_its_lines() {
    let (help, _) = run("tradeoff --help", 0);
    assert!(help.lines().all(|line| line.chars().count() < 100), "{help}");
    for option in
        "--presets --knob --no-knobs --seeds --dry-run --json --steps --set".split_whitespace()
    {
        assert!(help.contains(option), "{option}");
    }
    assert!(run("--help", 0).0.contains("tradeoff"));
}
