//! A sweep trains every point once, survives being killed, and always ranks its points in the same way.

use std::ops::Deref;

use crate::common::command::{Folder, command, json, refused, run, says};
use crate::common::prelude::*;

/// The smallest dataset with views to score.
fn set() -> &'static Path {
    static SET: OnceLock<Folder> = OnceLock::new();
    SET.get_or_init(|| {
        let folder = Folder::empty();
        folder.succeed("synth @ --views 9 --width 24 --height 16");
        folder
    })
}

struct Sweep {
    folder: Folder,
    arguments: String,
}

impl Deref for Sweep {
    type Target = Folder;

    fn deref(&self) -> &Folder {
        &self.folder
    }
}

impl Sweep {
    fn new(options: &str) -> Self {
        Self::with_dataset(set(), &format!("--sh-degree 0 {options}"))
    }

    fn with_dataset(set: &Path, options: &str) -> Self {
        let folder = Folder::empty();
        let (set, out) = (set.display(), folder.display());
        Self { arguments: format!("sweep {set} --out {out} {options}"), folder }
    }

    /// The results that must not depend on how the sweep was run.
    fn leaderboard(&self) -> [String; 3] {
        ["leaderboard.csv", "leaderboard.md", "index.html"].map(|name| self.text(name))
    }

    /// The names of the remaining points.
    fn names(&self) -> Vec<String> {
        let name = |line: &String| {
            let out = line.split("--out ").nth(1).unwrap().split(' ').next().unwrap();
            out.rsplit('/').next().unwrap().to_owned()
        };
        self.left().iter().map(name).collect()
    }

    /// The command lines of the remaining points.
    fn left(&self) -> Vec<String> {
        let (lines, _) = run(&format!("{} --dry-run", self.arguments), 0);
        lines.lines().map(str::to_owned).collect()
    }

    /// Whether these points are trained again by another run of the sweep, and its standard output.
    fn trained_again<const N: usize>(&self, points: [&str; N], more: &str) -> ([bool; N], String) {
        let time = |point| fs::metadata(self.path(point).join("model.ply")).unwrap().modified();
        let before = points.map(|point| time(point).unwrap());
        let (stdout, _) = run(&format!("{} {more}", self.arguments), 0);
        let mut before = before.into_iter();
        (points.map(|point| Some(time(point).unwrap()) != before.next()), stdout)
    }
}

/// As when a new version is installed during a sweep.
#[cfg(target_os = "linux")]
#[test]
fn a_sweep_survives_the_replacement_of_its_program() {
    let sweep = Sweep::new("--steps 2 --curves linear,ase");
    let program = sweep.folder.with_extension("program");
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
fn a_finished_point_is_never_trained_twice_and_a_killed_one_is_resumed() {
    let sweep = Sweep::new("--steps 2 --seeds 2,1 --curves linear,ase");
    let points =
        ["curve=linear,seed=2", "curve=linear,seed=1", "curve=ase,seed=2", "curve=ase,seed=1"];
    let left = sweep.left();
    assert_eq!(left.len(), 4);
    for (line, point) in left.iter().zip(points) {
        assert!(line.ends_with(&format!("{point} --resume")), "{line}");
    }
    assert!(!sweep.path("sweep.toml").exists(), "--dry-run writes nothing");

    let (shown, message) = run(&sweep.arguments, 0);
    says(&shown, &["PSNR, dB", "index.html"]);
    says(&message, &["1 of 4: curve=", "4 of 4: curve="]);
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
    let costs = sweep.text("costs.csv");
    assert!(costs.lines().count() == 3 && costs.contains(",2,"), "{costs}");
    // The mean over the seeds and their spread are those of the runs.
    let scores = [1, 2].map(|seed| {
        let metrics = sweep.json(&format!("curve=ase,seed={seed}/metrics.json"));
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
    assert_eq!(sweep.left(), left[1..2]);
    assert_eq!(sweep.trained_again(points, "").0, [false, true, false, false]);
    assert_eq!(sweep.leaderboard(), leaderboard);
    assert!(sweep.left().is_empty());
}

#[test]
fn a_sweep_killed_twice_ends_like_one_run_by_a_scheduler() {
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
        // The training process itself continues, and the next sweep must not write at the same time.
        process.kill().unwrap();
        process.wait().unwrap();
    }
    run(&killed.arguments, 0);
    assert_eq!(killed.leaderboard(), scheduled.leaderboard());
    for (line, point) in left.iter().zip(["curve=ap3,gain=0.5", "curve=linear,gain=0.5"]) {
        let log = killed.text(&format!("{point}/log.txt"));
        assert_eq!(log.lines().next(), Some(line.as_str()), "what runs is what --dry-run says");
        assert_eq!(killed.text(&format!("{point}/train.csv")).lines().count(), 61);
        assert!(killed.model(point) == scheduled.model(point), "{point}");
    }
}

#[test]
fn a_point_that_fails_is_reported_and_the_others_finish() {
    let sweep = Sweep::new("--steps 2 --grid device=\"\",voodoo,0");
    let (shown, message) = run(&sweep.arguments, 1);
    assert!(shown.contains("voodoo"), "{shown}");
    let parts = ["device=voodoo failed", "there are: ", "error: 1 of 3 points failed", "log.txt"];
    says(&message, &parts);
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
    for (point, lines) in [
        ("0.1", ["\nalpha = 0.1  # --set\n", "\nbeta = 0.0  # --set\n"]),
        ("adaptive", ["\nalpha = 0.12  # the curve's\n", "\nbeta = 2.5  # default\n"]),
    ] {
        says(&sweep.text(&format!("curve=ap3,offset={point}/config.toml")), &lines);
    }
}

#[test]
fn tables_and_all_curves_are_grids() {
    let lines = |options: &str| Sweep::new(options).left();
    let curves = ToneCurve::ALL.len();
    assert_eq!(lines("--curves all").len(), curves);
    assert_eq!(lines("--table leaderboard --seeds 1,2").len(), 2 * curves);
    assert_eq!(lines("--table offset").len(), 10);
    assert_eq!(lines("--table alpha").len(), 7);
    assert_eq!(lines("--table presets").len(), 4);
    assert_eq!(lines("--table changes").len(), 14, "degree 0 is what all have");
    let gain = lines("--table gain --ssim-weight 0.3 --config /dev/null");
    assert_eq!(gain.len(), 9);
    // The options of `train` in its own order, then the point's.
    let expected = "--config /dev/null --sh-degree 0 --ssim-weight 0.3 --curve ase --gain 0 --set \
     tone.base_gain=1 --plan none --out";
    assert!(gain[0].contains(expected), "{}", gain[0]);
}

#[test]
fn values_may_be_added_to_a_sweep_but_not_another_sweep() {
    let sweep = Sweep::new("--steps 1 --curves ap3");
    run(&sweep.arguments, 0);
    let wider = Sweep { arguments: sweep.arguments.replace("ap3", "ap3,linear"), ..sweep };
    assert_eq!(wider.left().len(), 1);
    let arguments = &wider.arguments;
    let run_differs = ["curve=ap3", "another run", "steps = 1", "--out"];
    refused(&arguments.replace("--steps 1", "--steps 2"), 1, &run_differs);
    let sweep_differs = ["another sweep", "lists = [\"curve\"]", "--out"];
    refused(&format!("{arguments} --alpha 0.1"), 1, &sweep_differs);
    let two = Folder::empty();
    two.succeed("synth @ --views 9 --width 24 --height 16");
    let other = arguments.replace(set().to_str().unwrap(), two.to_str().unwrap());
    refused(&other, 1, &["another", "--out"]);
    // A foreign folder.
    fs::remove_file(wider.path("sweep.toml")).unwrap();
    refused(arguments, 1, &["leaderboard.csv", "no sweep wrote", "--out"]);
}

#[test]
fn misuse_is_refused_before_anything_is_trained() {
    let sweep = Sweep::new("");
    let table = "
        2 | SWEEP | grid is empty & --curves
        2 | SWEEP --alpha 0.1,,0.2 | alpha & empty
        2 | SWEEP --grid tone.alhpa=0.1 | tone.alhpa & tone.alpha
        2 | SWEEP --grid downscale=2,4 | downscale & resolution_steps
        2 | SWEEP --presets fast,slow | slow & draft
        2 | SWEEP --table parts --model lita | leave out --model
        2 | SWEEP --grid steps | --grid steps & KEY=V1,V2
        2 | SWEEP --grid steps=many | steps (--steps) is \"many\" & a whole number
        2 | SWEEP --curves ap3,sepia | curve=sepia & unknown curve & linear
        2 | SWEEP --alpha 0.1,0.10 | alpha=0.1 and alpha=0.10 & same run
        2 | SWEEP --alpha 0.1 --offset 0.1 | --offset
        2 | SWEEP --alpha 2 | alpha is 2
        2 | SWEEP --steps no --curves all | --steps
        2 | SWEEP --curves all --jobs 0 | --jobs
        4 | SWEEP --curves all --device voodoo | voodoo
        3 | SWEEP --curves all --reference nowhere | nowhere";
    sweep.refuses_all(&table.replace("SWEEP", &sweep.arguments));
    assert_eq!(fs::read_dir(&sweep.folder).unwrap().count(), 0);
    let (_, message) = sweep.run("sweep @nowhere --out @nowhere/out --curves all", 3);
    assert!(message.contains("is not a folder") && !sweep.path("nowhere").exists(), "{message}");

    // A dataset of one photograph has none to score.
    let one = Folder::empty();
    one.succeed("synth @ --views 2 --width 24 --height 16");
    for name in ["transforms_test.json", "transforms_val.json"] {
        let mut list = one.json(name);
        list["frames"] = serde_json::json!([]);
        one.write(name, list.to_string());
    }
    let sweep = Sweep::with_dataset(&one, "--steps 2 --curves ap3");
    let (_, message) = run(&sweep.arguments, 3);
    let parts = [one.to_str().unwrap(), "no held-out view to score"];
    says(message.lines().last().unwrap(), &parts);
    assert!(!sweep.path("sweep.toml").exists());
}

/// The same trainings as `train --preset`, with every figure on every page.
#[test]
fn presets_are_trained_by_their_plans_scored_during_training_and_compared() {
    let sweep = Sweep::with_dataset(
        set(),
        "--table presets --presets draft,paper,balanced --steps 6 --eval-every 2",
    );
    let points = ["preset=draft", "preset=paper", "preset=balanced"];
    assert_eq!(sweep.names(), points);
    let (shown, _) = run(&sweep.arguments, 0);
    says(&shown, &["PSNR, dB", "processor time, s", "device, MiB", "balanced", "index.html"]);
    let csv = sweep.text("costs.csv");
    assert!(csv.starts_with("preset,runs,psnr,psnr_sd,") && csv.lines().count() == 4, "{csv}");
    let way = sweep.text("preset=draft/evals.csv");
    let seconds: Vec<f64> =
        way.lines().skip(1).map(|line| line.split(',').nth(5).unwrap().parse().unwrap()).collect();
    assert!(seconds.len() == 3 && seconds.is_sorted() && seconds[0] > 0.0, "{way}");
    let metrics = sweep.json("preset=draft/metrics.json");
    let whole = metrics["seconds"].as_f64().unwrap();
    assert!((whole - seconds[2]).abs() < 1e-3, "{whole} {way}");
    assert!(metrics["spent"]["device_bytes"].as_u64().unwrap() > 1000, "{metrics}");
    let html = sweep.text("costs.html");
    assert!(html.contains("during training") && html.contains("The difference to preset balanced"));
    for outside in ["http:", "https:", "<script", "<link", "@import", "url("] {
        assert!(!html.contains(outside), "{outside}");
    }
    let at = |what: &str| html.find(what).unwrap();
    assert!(at("<svg") < at("<table"), "plots before tables");
    assert!(sweep.text("preset=paper/log.txt").contains("--plan none"));
    assert!(sweep.path("preset=draft/plan.toml").is_file());

    // As if it had been killed while a point was trained: that point is trained again, to the same bits.
    let (bits, leaderboard) = (sweep.model(points[0]), sweep.leaderboard());
    fs::remove_file(sweep.path(points[0]).join("metrics.json")).unwrap();
    assert_eq!(sweep.names(), points[..1]);
    let (again, printed) = sweep.trained_again(points, "--json");
    assert_eq!(again, [true, false, false]);
    assert!(bits == sweep.model(points[0]), "the same seed, the same bits");
    assert_eq!(sweep.leaderboard(), leaderboard);
    let json = json(printed);
    let points = json["points"].as_array().unwrap();
    let find = |name: &str| points.iter().find(|point| point["point"] == name).unwrap();
    let psnr = |name: &str| find(name)["mean"]["psnr"].as_f64().unwrap();
    let difference = find("preset=draft")["difference"]["psnr"].as_f64().unwrap();
    let expected = psnr("preset=draft") - psnr("preset=balanced");
    assert!((difference - expected).abs() < 1e-9, "{json}");
    assert!(points.iter().any(|point| point["on_front"] == true), "{json}");
    assert!(points.iter().all(|point| point["scored"] == "against reference images"), "{json}");
    assert!(sweep.left().is_empty());
}

#[test]
fn without_references_test_views_are_scored_against_their_own_targets() {
    let root = Folder::copy_of(set());
    fs::remove_dir_all(root.join("high")).unwrap();
    let sweep = Sweep::with_dataset(&root, "--presets draft --steps 2 --json");
    let json = json(run(&sweep.arguments, 0).0);
    let point = &json["points"][0];
    assert!(point["scored"].as_str().unwrap().contains("pseudo-GT"), "{json}");
    assert!(point["mean"]["psnr"].as_f64().unwrap() > 3.0, "{json}");
    for page in ["index.html", "costs.html"] {
        assert!(sweep.text(page).contains("pseudo-GT"), "{page}");
    }
    assert!(sweep.left().is_empty());
}

#[test]
fn train_sets_any_setting_by_its_path() {
    let folder = Folder::empty();
    let train = format!("train {} --out @run", set().display());
    says(&folder.run(&format!("{train} --set density.grad=1"), 2).1, &["density.grad", "nearest"]);
    let settings = "--steps 9 --set steps=1 --set tone.alpha=0.2 --set background=black";
    folder.succeed(&format!("{train} {settings}"));
    let lines =
        ["steps = 1  # --set\n", "alpha = 0.2  # --set\n", "background = \"black\"  # --set\n"];
    says(&folder.text("run/config.toml"), &lines);
}
