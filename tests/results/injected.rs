//! Failures around a run: lost devices, full disks, deleted folders. Each has a defined outcome.
#![cfg(unix)]

use crate::common::command::{command, refused_with, run, succeed};
use crate::common::prelude::*;
use crate::common::process::{ended, ends, send, spawned, started};

#[test]
fn a_lost_device_and_a_lack_of_memory_exit_with_4_and_the_run_can_be_resumed() {
    let workspace = Workspace::new();
    let options = "--steps 40 --checkpoint-every 10";
    workspace.trained("straight", options);
    for (fault, message) in
        [("submission:60", "was lost while"), ("allocation:100", "out of device memory")]
    {
        let name = fault.replace(':', "-");
        let train = workspace.train(&name, &format!("{options} --progress none"));
        let output = command(&train).env("NIGHTSPLAT_FAULT", fault).output().unwrap();
        let stderr = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(4), "{fault}: {stderr}");
        assert!(stderr.lines().last().is_some_and(|line| line.contains(message)), "{stderr}");
        assert!(!workspace.path(&name).join("done.json").exists());
        workspace.trained(&name, &format!("{options} --resume"));
        assert!(workspace.model(&name) == workspace.model("straight"), "{fault}");
    }
    let nonsense = [("NIGHTSPLAT_FAULT", "flood:1")];
    refused_with(&workspace.train("new", options), &nonsense, 2, &["NIGHTSPLAT_FAULT=flood:1"]);
}

#[test]
fn a_full_disk_is_reported_and_existing_files_stay_intact() {
    let workspace = Workspace::new();
    // Runs of other lengths start equally if none converges before its end.
    let options = "--steps 40 --checkpoint-every 10 --set schedule.cooldown_steps=0";
    workspace.trained("run", &options.replace("40", "10"));
    let before = workspace.model("run");
    // Limits the size of files, as on a full disk; the checkpoint needs more.
    let program = command("").get_program().to_str().unwrap().to_owned();
    let train = workspace.train("run", &format!("{options} --resume --progress none"));
    let line = format!("trap '' XFSZ; ulimit -f 40; exec {program} {train}");
    let output =
        Command::new("sh").args(["-c", &line]).env("NIGHTSPLAT_TUNE", "off").output().unwrap();
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{stderr}");
    says(&stderr, &["cannot be written", "disk"]);
    let is_half = |name: &str| name.ends_with(".partial") || name.starts_with(".tmp");
    let files: Vec<_> = fs::read_dir(workspace.path("run")).unwrap().flatten().collect();
    let names = files.iter().map(|file| file.file_name().to_string_lossy().into_owned());
    assert!(!names.into_iter().any(|name| is_half(&name)), "{files:?}");
    if let Ok(model) = fs::read(workspace.path("run/model.ply")) {
        assert!(model == before, "half a model");
    }
    workspace.trained("run", &format!("{options} --resume"));
    workspace.trained("straight", options);
    assert!(workspace.model("run") == workspace.model("straight"));
}

#[test]
fn an_unwritable_directory_is_refused_before_training() {
    let workspace = Workspace::new();
    let read_only = workspace
        .train("run", "--steps 1")
        .replace(&workspace.path("run").display().to_string(), "/proc/nightsplat");
    let begin = Instant::now();
    says(&run(&read_only, 1).1, &["/proc/nightsplat"]);
    assert!(begin.elapsed() < Duration::from_secs(60));
}

#[test]
fn a_deleted_run_folder_is_reported_and_a_run_without_its_photographs_is_saved() {
    let workspace = Workspace::new();
    let endless = "--steps 1000000 --checkpoint-every 0 --progress json";
    let child = started(&mut command(&workspace.train("gone", endless)));
    fs::remove_dir_all(workspace.path("gone")).unwrap();
    send("-TERM", child.id());
    ends(child, 1, &["gone"]);

    // An empty cache: every photograph is on disk, as at the start of the run.
    let options = "--steps 300 --cache 1K --checkpoint-every 0";
    workspace.trained("straight", options);
    let train = workspace.train("run", &format!("{options} --progress json"));
    let mut child = started(&mut command(&train));
    fs::rename(workspace.path("set"), workspace.path("elsewhere")).unwrap();
    let _ = child.stdout.take();
    let (code, _, stderr) = ended(child);
    if code != 0 {
        assert!(code == 3 && stderr.contains("set"), "{code}: {stderr}");
        assert!(workspace.path("run/checkpoint.safetensors").exists(), "{stderr}");
        fs::rename(workspace.path("elsewhere"), workspace.path("set")).unwrap();
        workspace.trained("run", &format!("{options} --resume"));
    }
    assert!(workspace.model("run") == workspace.model("straight"));
}

#[test]
fn a_terminated_batch_saves_its_runs_and_resumes_to_the_same_leaderboard() {
    let workspace = Workspace::new();
    // A GPU must not be done before the log of its first steps is seen, which is written twice a second.
    let steps = if gpu().properties().is_cpu { 400 } else { 10_000 };
    let sweep = |name: &str| {
        let options = format!("--curves linear,ase --steps {steps} --sh-degree 1");
        workspace.named(&format!("sweep @set --out @{name} {options}"))
    };
    let child = spawned(&mut command(&sweep("sweep")));
    let first = workspace.path("sweep/curve=linear/train.csv");
    let begin = Instant::now();
    while fs::read_to_string(&first).map_or(0, |log| log.lines().count()) < 3 {
        assert!(begin.elapsed() < Duration::from_secs(120));
        std::thread::sleep(Duration::from_millis(10));
    }
    send("-TERM", child.id());
    ends(child, 143, &["stopped with 0 of 2 runs done (terminated)"]);
    assert!(workspace.path("sweep/curve=linear/checkpoint.safetensors").exists());
    assert!(!workspace.path("sweep/curve=ase/config.toml").exists());
    succeed(&sweep("sweep"));
    succeed(&sweep("straight"));
    assert!(workspace.read("sweep/leaderboard.csv") == workspace.read("straight/leaderboard.csv"));
}
