//! Runs that are interrupted, doubled, damaged or given another dataset: nothing is lost, nothing is mixed.
#![cfg(unix)]

use std::fs::File;
use std::process::Child;
use std::time::SystemTime;

use nightsplat::gpu::testing::not_run;

use crate::common::command::{command, refused, run, says, succeed};
use crate::common::prelude::*;
use crate::common::process::{ended, ends, send, started, wait_for};
use crate::common::workspace::log;

const ENDLESS: &str = "--steps 1000000 --checkpoint-every 0 --checkpoint-minutes 0";

/// A training that has started and has thousands of steps to go.
fn begun(arguments: &str) -> Child {
    started(&mut command(&format!("{arguments} --progress json")))
}

#[test]
fn a_signal_saves_and_stops_and_the_run_resumes_to_the_same_bits() {
    let workspace = Workspace::new();
    workspace.trained("straight", "--steps 400");
    for (signal, code, message) in [("-INT", 130, "interrupted"), ("-TERM", 143, "terminated")] {
        let name = format!("stopped{signal}");
        let mut child = begun(&workspace.train(&name, "--steps 400"));
        send(signal, child.id());
        let _ = child.stdout.take();
        let saved = ", saved; go on with `nightsplat train ";
        let parts = ["stopped after step ", message, saved, " --resume --finish`"];
        let stderr = ends(child, code, &parts);
        assert!(!stderr.contains("error"), "stopping is none: {stderr}");
        let metrics = workspace.path(&name).join("metrics.json");
        assert!(!metrics.exists(), "the run ended before the signal");
        assert!(!workspace.path(&name).join(".lock").exists());
        workspace.trained(&name, "--steps 400 --resume");
        assert!(workspace.model(&name) == workspace.model("straight"));
        assert_eq!(log(&workspace.path(&name)), log(&workspace.path("straight")));
    }
}

#[test]
fn a_run_saves_on_request_and_when_its_checkpoint_is_old_and_continues() {
    let workspace = Workspace::new();
    let child = begun(&workspace.train("asked", ENDLESS));
    let checkpoint = workspace.path("asked/checkpoint.safetensors");
    assert!(!checkpoint.exists());
    send("-USR1", child.id());
    wait_for(&checkpoint);
    // A second run in the directory is refused, and the process of the first named.
    let holder = format!("process {}", child.id());
    for held in ["", "--resume", "--overwrite"] {
        refused(&workspace.train("asked", held), 1, &["asked", &holder]);
    }
    send("-KILL", child.id());
    ended(child);

    let child = begun(&workspace.train("old", &format!("{ENDLESS}.01")));
    wait_for(&workspace.path("old/checkpoint.before.safetensors"));
    // From a terminal, and from a parent that forwards it.
    send("-INT", child.id());
    send("-INT", child.id());
    ends(child, 130, &[", saved;"]);
}

#[test]
fn a_run_that_is_to_finish_cools_down_and_is_complete_also_if_it_is_stopped_meanwhile() {
    let workspace = Workspace::new();
    refused(&workspace.train("absent", "--resume --finish"), 3, &["absent", "no checkpoint"]);
    refused(&workspace.train("absent", "--finish"), 2, &["--resume"]);
    let child = begun(&workspace.train("asked", ENDLESS));
    send("-USR2", child.id());
    ends(child, 0, &[]);
    let metrics = workspace.json("asked/metrics.json");
    assert_eq!(metrics["ended"]["reason"], "requested");
    assert!(metrics["steps"].as_u64().unwrap() < 900_000, "{}", metrics["steps"]);
    assert!(workspace.trained("asked", &format!("{ENDLESS} --resume")).contains("is done"));

    let steps = "--steps 900 --hash-every 40";
    let child = begun(&workspace.train("stopped", steps));
    send("-INT", child.id());
    ends(child, 130, &[]);
    crate::common::copy(&workspace.path("stopped"), &workspace.path("again"));
    let told = workspace.trained("stopped", &format!("{steps} --resume --finish"));
    assert!(told.contains("its end was requested"), "{told}");
    // The request is recorded at its first step.
    let stops = format!("{steps} --resume --max-minutes 0.000001");
    let first = run(&workspace.train("again", &format!("{stops} --finish")), 75).1;
    says(&first, &["stopped after step", "its time was up"]);
    while command(&workspace.train("again", &stops)).output().unwrap().status.code() == Some(75) {}
    assert!(workspace.model("again") == workspace.model("stopped"));
    assert_eq!(log(&workspace.path("again")), log(&workspace.path("stopped")));
}

#[test]
fn a_closed_terminal_saves_and_stops_unless_the_run_was_started_to_outlive_it() {
    let ignores = Command::new("sh").args(["-c", "kill -HUP $$"]).status().unwrap().success();
    if ignores {
        return not_run("terminal", "the tests were started to outlive theirs, as by nohup");
    }
    let workspace = Workspace::new();
    let child = begun(&workspace.train("closed", ENDLESS));
    send("-HUP", child.id());
    ends(child, 129, &["(hung up), saved"]);
    assert!(workspace.path("closed/checkpoint.safetensors").exists());

    // As `nohup` starts it.
    let train = workspace.train("outlives", &format!("{ENDLESS} --progress json"));
    let (program, line) = (command("").get_program().to_owned(), "trap '' HUP; exec \"$@\"");
    let mut shell = Command::new("sh");
    shell.args(["-c", line, "sh"]).arg(program).args(train.split_whitespace());
    let mut child = started(&mut shell);
    send("-HUP", child.id());
    send("-USR1", child.id());
    wait_for(&workspace.path("outlives/checkpoint.safetensors"));
    assert!(child.try_wait().unwrap().is_none(), "it is gone");
    send("-INT", child.id());
    ends(child, 130, &[", saved;"]);
}

#[test]
fn a_run_out_of_processor_time_saves_and_asks_to_be_repeated() {
    let workspace = Workspace::new();
    let child = begun(&workspace.train("run", ENDLESS));
    send("-XCPU", child.id());
    ends(child, 75, &["(its time was up), saved"]);
    assert!(workspace.path("run/checkpoint.safetensors").exists());
}

#[test]
fn a_run_whose_time_is_up_asks_to_be_repeated_and_a_finished_one_does_not() {
    let workspace = Workspace::new();
    // The time is checked when the ledger is written: on any fast device, that is before the last step. A slow device
    // checks more often.
    let stops = "--resume --hash-every 40 --max-minutes 0.000001";
    let train = workspace.train("run", &format!("--steps 120 {stops}"));
    let mut rounds = 0;
    loop {
        let output = command(&train).output().unwrap();
        match output.status.code() {
            Some(75) => rounds += 1,
            code => {
                assert_eq!(code, Some(0), "{}", String::from_utf8_lossy(&output.stderr));
                break;
            }
        }
        assert!(!workspace.path("run/done.json").exists() && rounds < 300);
    }
    assert!(rounds >= 2, "{rounds}");
    workspace.trained("straight", "--steps 120");
    assert!(workspace.model("run") == workspace.model("straight"));
    // Repeated: nothing is done, and no file changes.
    let modified = || fs::metadata(workspace.path("run/model.ply")).unwrap().modified().unwrap();
    let before = modified();
    assert!(succeed(&train).contains("is done"));
    assert_eq!(modified(), before);
    workspace.trained("run", "--steps 130 --resume");
    assert!(modified() > before, "a longer run is another");
}

#[test]
fn a_finished_run_is_kept_until_its_replacement_has_done_a_step() {
    let workspace = Workspace::new();
    workspace.trained("run", "--steps 3");
    let before = workspace.model("run");
    // A network too large for any device: the run fails after all earlier checks.
    let hopeless = "--overwrite --steps 3 --parts denoiser --denoiser-channels 16384";
    let output = command(&workspace.train("run", hopeless)).output().unwrap();
    assert_ne!(output.status.code(), Some(0));
    assert!(workspace.model("run") == before && !workspace.path("run/.replaced").exists());
    // Killed before the first step: the next start restores it.
    fs::create_dir(workspace.path("run/.replaced")).unwrap();
    for name in ["model.ply", "config.toml", "metrics.json", "train.csv"] {
        fs::rename(workspace.path("run").join(name), workspace.path("run/.replaced").join(name))
            .unwrap();
    }
    workspace.write("run/.tmpA1b2C3", "half a checkpoint");
    workspace.write("run/config.toml", workspace.read("run/.replaced/config.toml"));
    refused(
        &workspace.train("run", "--steps 3 --resume"),
        1,
        &["already contains a run", "--overwrite"],
    );
    assert!(workspace.model("run") == before && !workspace.path("run/.tmpA1b2C3").exists());
    workspace.trained("run", "--steps 4 --overwrite");
    assert!(workspace.model("run") != before && !workspace.path("run/.replaced").exists());
}

#[test]
fn foreign_files_are_neither_replaced_nor_resumed() {
    let workspace = Workspace::new();
    fs::create_dir(workspace.path("theirs")).unwrap();
    for (file, content) in [("config.toml", "title = \"my app\"\n"), ("train.csv", "a,b\n")] {
        workspace.write(&format!("theirs/{file}"), content);
        for held in ["--resume", "--overwrite"] {
            refused(&workspace.train("theirs", held), 1, &["theirs", "no config.toml"]);
        }
    }
    assert_eq!(workspace.read("theirs/config.toml"), b"title = \"my app\"\n");
    assert_eq!(workspace.read("theirs/train.csv"), b"a,b\n");
}

#[test]
fn a_damaged_checkpoint_is_reported_and_the_previous_one_resumes_to_the_same_bits() {
    let workspace = Workspace::new();
    let options = "--steps 50 --checkpoint-every 20";
    workspace.trained("run", options);
    let expected = workspace.model("run");
    let checkpoint = workspace.path("run/checkpoint.safetensors");
    let whole = fs::read(&checkpoint).unwrap();
    fs::remove_file(workspace.path("run/done.json")).unwrap();
    // A bit of a value, which no format detects.
    let mut flipped = whole.clone();
    let at = flipped.len() - 9;
    flipped[at] ^= 1;
    for damaged in [&flipped[..], &whole[..whole.len() - 7], b""] {
        fs::write(&checkpoint, damaged).unwrap();
        let (_, stderr) = run(&workspace.train("run", &format!("{options} --resume")), 0);
        says(&stderr, &["checkpoint.safetensors", "previous checkpoint"]);
        assert!(workspace.model("run") == expected);
        fs::remove_file(workspace.path("run/done.json")).unwrap();
    }
    fs::write(&checkpoint, &flipped).unwrap();
    workspace.write("run/checkpoint.before.safetensors", &flipped);
    refused(&workspace.train("run", &format!("{options} --resume")), 3, &["checksum"]);
}

#[test]
fn a_run_resumes_only_with_its_own_dataset() {
    let workspace = Workspace::new();
    workspace.trained("run", "--steps 12 --checkpoint-every 10");
    let resumed = workspace.train("run", "--steps 14 --resume");
    let (photograph, listing) = ("set/low/003.png", "set/transforms_train.json");
    let before = workspace.read(photograph);
    workspace.write(photograph, workspace.read("set/low/004.png"));
    refused(&resumed, 3, &["another dataset", "view 003 shows other pixels"]);
    fs::remove_file(workspace.path(photograph)).unwrap();
    says(&run(&resumed, 3).1, &["another dataset (view 003 is gone)"]);
    workspace.write(photograph, before);
    let text = workspace.text(listing);
    workspace.write(listing, text.replace("\"fl_x\": ", "\"fl_x\": 1"));
    refused(&resumed, 3, &["another dataset", "another camera or pose"]);
    // In another folder, it is the same dataset.
    workspace.write(listing, text);
    fs::rename(workspace.path("set"), workspace.path("moved")).unwrap();
    succeed(&resumed.replace("/set ", "/moved "));
}

#[test]
fn a_relative_dataset_means_the_same_from_everywhere() {
    let workspace = Workspace::new();
    let train = "train set --out run --steps 2 --curve ap3 --plan none";
    let output = command(train).current_dir(&**workspace).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let eval = |config: &str| {
        workspace.write("run/config.toml", config);
        workspace.succeed("eval @run --json")
    };
    let config = workspace.text("run/config.toml");
    let absolute = workspace.path("set").display().to_string();
    assert!(config.contains(&absolute), "{config}");
    let expected = eval(&config);
    assert_eq!(eval(&config.replace(&absolute, "../set")), expected, "from the run's folder");
}

#[test]
fn two_runs_and_a_resumed_one_have_equal_ledgers() {
    let workspace = Workspace::new();
    let options = "--steps 40 --hash-every 10 --checkpoint-every 25";
    for name in ["a", "b"] {
        workspace.trained(name, options);
    }
    let ledger = workspace.read("a/hashes.csv");
    assert_eq!(ledger.iter().filter(|&&byte| byte == b'\n').count(), 5);
    assert!(workspace.read("b/hashes.csv") == ledger);
    fs::remove_file(workspace.path("b/done.json")).unwrap();
    workspace.trained("b", &format!("{options} --resume"));
    assert!(workspace.read("b/hashes.csv") == ledger);
    workspace.trained("c", &format!("{options} --seed 11"));
    assert!(workspace.read("c/hashes.csv") != ledger);
}

#[test]
fn hostile_names_break_no_table_and_reach_no_terminal() {
    let workspace = Workspace::new();
    let wild = "a,\u{1b}[31mb";
    for folder in ["set/low", "set/high"].map(|folder| workspace.path(folder)) {
        fs::rename(folder.join("003.png"), folder.join(format!("{wild}.png"))).unwrap();
    }
    let listing = "set/transforms_train.json";
    let text = workspace.text(listing).replace("low/003.png", "low/a,\\u001b[31mb.png");
    workspace.write(listing, text.replace("low/005.png", "low/gone\\u001b]0;x\\u0007.png"));
    let (stdout, stderr) = run(&workspace.train("run", "--steps 9"), 0);
    assert!(
        stderr.contains("gone") && !(stdout + &stderr).contains(['\u{1b}', '\u{7}']),
        "{stderr:?}"
    );
    let log = workspace.text("run/train.csv");
    assert_eq!(log.lines().count(), 10);
    assert!(log.contains(r#""a,\u{1b}[31mb""#), "{log}");
    refused("eval /nowhere\u{1b}[2J", 3, &[r"/nowhere\u{1b}[2J"]);
}

#[test]
fn too_little_address_space_is_reported_before_a_driver_crashes() {
    let workspace = Workspace::new();
    let program = command("").get_program().to_str().unwrap().to_owned();
    for kilobytes in [300_000, 600_000] {
        let train = workspace.train("run", "--steps 1");
        let line = format!("ulimit -v {kilobytes}; exec {program} {train}");
        let output = Command::new("sh").args(["-c", &line]).output().unwrap();
        let stderr = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(4), "{stderr}");
        assert!(stderr.contains("`ulimit -v`") && stderr.lines().count() == 1, "{stderr}");
    }
}

#[test]
fn a_finished_run_is_recognised_without_decoding_a_photograph() {
    let workspace = Workspace::new();
    let train = workspace.train("run", "--steps 2 --resume");
    succeed(&train);
    let photograph = workspace.path("set/low/001.png");
    let (bytes, time) = (fs::read(&photograph).unwrap(), modified(&photograph));
    // Of the same length and time, but not an image: decoding it would leave the view out.
    fs::write(&photograph, vec![0; bytes.len()]).unwrap();
    set_modified(&photograph, time);
    assert!(succeed(&train).contains("is done"));
    // With another time, the pixels decide.
    fs::write(&photograph, &bytes).unwrap();
    set_modified(&photograph, time + Duration::from_secs(5));
    assert!(succeed(&train).contains("is done"));
    fs::write(&photograph, workspace.read("set/low/002.png")).unwrap();
    refused(&train, 3, &["view 001 shows other pixels"]);
}

fn modified(path: &Path) -> SystemTime {
    path.metadata().unwrap().modified().unwrap()
}

fn set_modified(path: &Path, time: SystemTime) {
    File::options().write(true).open(path).unwrap().set_modified(time).unwrap();
}
