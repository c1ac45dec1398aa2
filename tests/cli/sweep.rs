//! A sweep trains every point once, survives being killed, and ranks what it finds the same way every time.
#![cfg(feature = "cli")]
#![allow(clippy::unwrap_used, reason = "a failed unwrap is a failed test")]

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::OnceLock;
use std::time::{Duration, Instant};

use crate::common::command::{command, refused, run};

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

struct Sweep {
    folder: tempfile::TempDir,
    arguments: String,
}

impl Sweep {
    fn new(options: &str) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let (set, out) = (set().display(), folder.path().display());
        Self { arguments: format!("sweep {set} --out {out} --sh-degree 0 {options}"), folder }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn read(&self, name: &str) -> String {
        fs::read_to_string(self.path(name)).unwrap()
    }

    /// What must not depend on how the sweep came to its end.
    fn leaderboard(&self) -> [String; 3] {
        ["leaderboard.csv", "leaderboard.md", "index.html"].map(|name| self.read(name))
    }

    /// The command lines of the points that are left.
    fn left(&self) -> Vec<String> {
        let (lines, _) = run(&format!("{} --dry-run", self.arguments), 0);
        lines.lines().map(str::to_owned).collect()
    }
}

/// As when a new version is installed while a sweep is under way.
#[cfg(target_os = "linux")]
#[test]
fn a_sweep_outlives_the_file_of_its_program() {
    let sweep = Sweep::new("--steps 2 --curves linear,ase");
    let program = sweep.folder.path().with_extension("program");
    fs::copy(command("").get_program(), &program).unwrap();
    let mut sweeping = Command::new(&program)
        .args(sweep.arguments.split_whitespace())
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    while !sweep.path("sweep.toml").exists() {
        std::thread::sleep(Duration::from_millis(1));
    }
    fs::remove_file(&program).unwrap();
    assert!(sweeping.wait().unwrap().success());
    assert_eq!(sweep.left().len(), 0);
}

#[test]
fn a_finished_point_is_never_trained_twice_and_a_killed_one_is() {
    let sweep = Sweep::new("--steps 2 --seeds 2,1 --curves linear,ase");
    let points =
        ["curve=linear,seed=2", "curve=linear,seed=1", "curve=ase,seed=2", "curve=ase,seed=1"];
    let left = sweep.left();
    assert_eq!(left.len(), 4);
    for (line, point) in left.iter().zip(points) {
        assert!(line.ends_with(&format!("{point} --resume")), "{line}");
    }
    assert!(!sweep.path("sweep.toml").exists(), "--dry-run writes nothing");

    let (shown, _) = run(&sweep.arguments, 0);
    assert!(shown.contains("PSNR, dB") && shown.contains("index.html"), "{shown}");
    let leaderboard = sweep.leaderboard();
    let [csv, markdown, html] = &leaderboard;
    let lines: Vec<&str> = csv.lines().collect();
    assert_eq!(
        lines[0],
        "curve,psnr,psnr_sd,psnr_channel_mean,psnr_channel_mean_sd,ssim,ssim_sd,gaussians,runs"
    );
    let psnr = |line: &str| line.split(',').nth(1).unwrap().parse::<f64>().unwrap();
    assert!(lines.len() == 3 && psnr(lines[1]) >= psnr(lines[2]), "{csv}");
    assert!(markdown.contains("| curve | PSNR, dB | sd |"), "{markdown}");
    assert_eq!(html.matches("<rect").count(), 2, "a bar per curve");
    assert_eq!(sweep.read("timings.csv").lines().count(), 5);
    // The mean over the seeds and their spread are those of the runs.
    let scores = [1, 2].map(|seed| {
        let text = sweep.read(&format!("curve=ase,seed={seed}/metrics.json"));
        let metrics: serde_json::Value = serde_json::from_str(&text).unwrap();
        metrics["mean"]["psnr"].as_f64().unwrap()
    });
    let ase: Vec<&str> =
        csv.lines().find(|line| line.starts_with("ase")).unwrap().split(',').collect();
    let close = |text: &str, value: f64| (text.parse::<f64>().unwrap() - value).abs() < 1e-9;
    assert!(close(ase[1], (scores[0] + scores[1]) / 2.0), "{ase:?} {scores:?}");
    assert!(close(ase[2], (scores[0] - scores[1]).abs() / 2f64.sqrt()), "{ase:?} {scores:?}");

    // As if it had been killed while the second point was trained.
    fs::remove_file(sweep.path(points[1]).join("metrics.json")).unwrap();
    fs::remove_file(sweep.path("index.html")).unwrap();
    let trained = |point: &str| {
        fs::metadata(sweep.path(point).join("model.ply")).unwrap().modified().unwrap()
    };
    let before = points.map(trained);
    assert_eq!(sweep.left(), left[1..2]);
    run(&sweep.arguments, 0);
    let again: Vec<bool> =
        points.iter().zip(before).map(|(point, before)| trained(point) != before).collect();
    assert_eq!(again, [false, true, false, false]);
    assert_eq!(sweep.leaderboard(), leaderboard);
    assert!(sweep.left().is_empty());
}

#[test]
fn a_sweep_killed_twice_ends_as_one_that_a_scheduler_ran() {
    let options = "--steps 60 --curves ap3,linear --gain 0.5";
    let scheduled = Sweep::new(options);
    for line in scheduled.left() {
        let output = Command::new("sh").args(["-c", &line]).output().unwrap();
        assert!(output.status.success(), "{line}: {}", String::from_utf8_lossy(&output.stderr));
    }
    assert!(scheduled.left().is_empty());
    run(&scheduled.arguments, 0);

    let killed = Sweep::new(options);
    let left = killed.left();
    for log in ["curve=ap3,gain=0.5/train.csv", "curve=linear,gain=0.5/train.csv"] {
        let mut process =
            command(&killed.arguments).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
        let begin = Instant::now();
        while !killed.path(log).exists() {
            assert!(begin.elapsed() < Duration::from_secs(60), "{log} never came");
            std::thread::sleep(Duration::from_millis(5));
        }
        // The training itself lives on, and the next sweep must not write beside it.
        process.kill().unwrap();
        process.wait().unwrap();
    }
    run(&killed.arguments, 0);
    assert_eq!(killed.leaderboard(), scheduled.leaderboard());
    for (line, point) in left.iter().zip(["curve=ap3,gain=0.5", "curve=linear,gain=0.5"]) {
        let log = killed.read(&format!("{point}/log.txt"));
        assert_eq!(log.lines().next(), Some(line.as_str()), "what runs is what --dry-run says");
        assert_eq!(killed.read(&format!("{point}/train.csv")).lines().count(), 61);
        let models =
            [&killed, &scheduled].map(|sweep| fs::read(sweep.path(point).join("model.ply")));
        assert!(models[0].as_ref().unwrap() == models[1].as_ref().unwrap(), "{point}");
    }
}

#[test]
fn a_point_that_fails_is_reported_and_the_others_finish() {
    let sweep = Sweep::new("--steps 2 --grid device=\"\",voodoo,0");
    let (shown, said) = run(&sweep.arguments, 1);
    assert!(shown.contains("voodoo"), "{shown}");
    for part in ["device=voodoo failed", "there are: ", "error: 1 of 3 points failed", "log.txt"] {
        assert!(said.contains(part), "no `{part}` in: {said}");
    }
    let [csv, markdown, html] = sweep.leaderboard();
    assert_eq!(csv.lines().filter(|line| line.ends_with(",1")).count(), 2, "{csv}");
    assert_eq!(csv.lines().last(), Some("voodoo,,,,,0"), "what failed comes last");
    for page in [markdown, html] {
        assert!(page.contains("device=voodoo failed: "), "{page}");
    }
    assert_eq!(sweep.left().len(), 1);
}

#[test]
fn the_offset_sweep_marks_the_adaptive_black_level() {
    let sweep = Sweep::new("--steps 2 --table offset --offset 0,0.1,adaptive --jobs 2");
    run(&sweep.arguments, 0);
    let [csv, _, html] = sweep.leaderboard();
    assert!(csv.starts_with("offset,psnr,psnr_channel_mean,ssim,gaussians,runs\n"), "{csv}");
    assert_eq!((html.matches("<circle").count(), html.matches("<path").count()), (2, 1), "{html}");
    assert!(html.contains("adaptive 0."), "{html}");
    let config = |point: &str| sweep.read(&format!("curve=ap3,offset={point}/config.toml"));
    for (point, lines) in [
        ("0.1", ["\nalpha = 0.1  # --set\n", "\nbeta = 0.0  # --set\n"]),
        ("adaptive", ["\nalpha = 0.12  # the curve's\n", "\nbeta = 2.5  # default\n"]),
    ] {
        let config = config(point);
        assert!(lines.iter().all(|line| config.contains(line)), "{config}");
    }
}

#[test]
fn the_paper_s_tables_and_all_curves_are_grids() {
    let lines = |options: &str| Sweep::new(options).left();
    let curves = nightsplat::photographs::tone::ToneCurve::ALL.len();
    assert_eq!(lines("--curves all").len(), curves);
    assert_eq!(lines("--table leaderboard --seeds 1,2").len(), 2 * curves);
    assert_eq!(lines("--table offset").len(), 10);
    assert_eq!(lines("--table alpha").len(), 7);
    let gain = lines("--table gain --ssim-weight 0.3 --config /dev/null");
    assert_eq!(gain.len(), 9);
    // The options of `train` in its own order, then the point's.
    let expected = "--config /dev/null --sh-degree 0 --ssim-weight 0.3 --curve ase --gain 0 --set tone.base_gain=1 --plan none --out";
    assert!(gain[0].contains(expected), "{}", gain[0]);
}

#[test]
fn more_values_may_join_and_another_sweep_may_not() {
    let sweep = Sweep::new("--steps 1 --curves ap3");
    run(&sweep.arguments, 0);
    let wider = Sweep { arguments: sweep.arguments.replace("ap3", "ap3,linear"), ..sweep };
    assert_eq!(wider.left().len(), 1);
    let arguments = &wider.arguments;
    let run_differs = ["curve=ap3", "another run", "steps = 1", "--out"];
    refused(&arguments.replace("--steps 1", "--steps 2"), 1, &run_differs);
    let sweep_differs = ["another sweep", "lists = [\"curve\"]", "--out"];
    refused(&format!("{arguments} --alpha 0.1"), 1, &sweep_differs);
    // A folder of something else.
    fs::remove_file(wider.path("sweep.toml")).unwrap();
    refused(arguments, 1, &["leaderboard.csv", "no sweep wrote", "--out"]);
}

#[test]
fn misuse_is_refused_before_anything_is_trained() {
    let refused = |options: &str, code: i32, parts: &[&str]| {
        let sweep = Sweep::new(options);
        refused(&sweep.arguments, code, parts);
        assert_eq!(fs::read_dir(sweep.folder.path()).unwrap().count(), 0, "{options}");
    };
    refused("", 2, &["grid is empty", "--curves"]);
    refused("--alpha 0.1,,0.2", 2, &["alpha", "empty"]);
    refused("--grid tone.alhpa=0.1", 2, &["tone.alhpa", "tone.alpha"]);
    refused("--grid steps", 2, &["--grid steps", "KEY=V1,V2"]);
    refused("--grid steps=many", 2, &["steps (--steps) is \"many\"", "a whole number"]);
    refused("--curves ap3,sepia", 2, &["curve=sepia", "unknown curve", "linear"]);
    refused("--alpha 0.1,0.10", 2, &["alpha=0.1 and alpha=0.10", "same run"]);
    refused("--alpha 0.1 --offset 0.1", 2, &["--offset"]);
    refused("--alpha 2", 2, &["alpha is 2"]);
    refused("--steps no --curves all", 2, &["--steps"]);
    refused("--curves all --jobs 0", 2, &["--jobs"]);
    refused("--curves all --device voodoo", 4, &["voodoo"]);
    refused("--curves all --reference nowhere", 3, &["nowhere"]);
    let nowhere = tempfile::tempdir().unwrap().path().join("set");
    let arguments = format!("sweep {0} --out {0}/out --curves all", nowhere.display());
    let (_, said) = run(&arguments, 3);
    assert!(said.contains("is not a folder") && !nowhere.exists(), "{said}");
}

#[test]
fn help_names_the_lists_and_fits_its_lines() {
    let (help, _) = run("sweep --help", 0);
    assert!(help.lines().all(|line| line.chars().count() < 100), "{help}");
    for option in "--curves --alpha --beta --gain --theta --offset --grid --seeds --table --jobs --dry-run --steps --set"
        .split_whitespace()
    {
        assert!(help.contains(option), "{option}");
    }
    assert!(run("--help", 0).0.contains("sweep"));
}

#[test]
fn train_sets_any_setting_by_its_path() {
    let folder = tempfile::tempdir().unwrap();
    let (set, out) = (set().display(), folder.path().join("run"));
    let train = format!("train {set} --out {}", out.display());
    let (_, said) = run(&format!("{train} --set density.grad=1"), 2);
    assert!(said.contains("density.grad") && said.contains("nearest"), "{said}");
    run(&format!("{train} --steps 9 --set steps=1 --set tone.alpha=0.2 --set background=black"), 0);
    let config = fs::read_to_string(out.join("config.toml")).unwrap();
    for line in
        ["steps = 1  # --set\n", "alpha = 0.2  # --set\n", "background = \"black\"  # --set\n"]
    {
        assert!(config.contains(line), "{config}");
    }
}
