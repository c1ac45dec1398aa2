//! `nightsplat PHOTOS`: stopped and killed in each stage, and gone on with by the same command, with a program that
//! stands in for COLMAP.

use std::fs;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use super::pose::{line, models, photographed, stub};
use super::synthetic::*;
use crate::common::command::{command, refused, run, says, succeed};

/// Options of a training of seconds.
const TRAINED: &str = "--curve ap3 --model plain --sh-degree 0 --no-open";

fn started(arguments: &str) -> Child {
    command(arguments).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap()
}

fn kill(signal: &str, process: &str) {
    assert!(Command::new("kill").args([signal, process]).status().unwrap().success());
}

/// Exit code and the text of both outputs.
fn ended(child: Child) -> (Option<i32>, String) {
    let output = child.wait_with_output().unwrap();
    let text = [output.stdout, output.stderr].concat();
    (output.status.code(), String::from_utf8(text).unwrap())
}

#[track_caller]
fn wait_for(path: &Path) {
    let begin = Instant::now();
    while fs::metadata(path).map_or(true, |file| file.len() == 0) {
        assert!(begin.elapsed() < Duration::from_secs(120), "{} does not come", path.display());
        std::thread::sleep(Duration::from_millis(10));
    }
}

/// A stub whose matcher waits until there is a file `go`, and has then found nine cameras.
fn waiting(root: &Path) -> std::path::PathBuf {
    model(9).write_binary(&root.join("models/0"));
    let wait = format!(
        "exhaustive_matcher) echo $$ >{0}/waits; [ -e {0}/go ] || exec sleep 100;;",
        root.display()
    );
    stub(root, &format!("{wait}\n{}", models(root)))
}

/// How often a command of COLMAP was run.
fn runs(log: &Path, command: &str) -> usize {
    let log = fs::read_to_string(log).unwrap();
    log.lines().filter(|line| line.starts_with("$ ") && line.contains(command)).count()
}

#[test]
fn a_folder_becomes_a_page_by_one_command_that_goes_on_in_every_stage() {
    let root = &Folder::empty();
    let (photos, colmap) = (photographed(root), waiting(root));
    let made = root.join("photos-splat");
    let line = format!("{} --colmap {} --steps 2000 {TRAINED}", photos.display(), colmap.display());

    // Stopped while COLMAP matches.
    let child = started(&line);
    wait_for(&root.join("waits"));
    kill("-INT", &child.id().to_string());
    let (code, text) = ended(child);
    assert_eq!(code, Some(130), "{text}");
    says(
        &text,
        &[
            "in all, a coarse estimate: cameras about ",
            "1 of 3 cameras: ",
            "stopped at exhaustive_matcher (interrupted), kept; go on with the same command",
        ],
    );
    assert!(!text.contains("error"), "{text}");

    // Killed there: COLMAP outlives it, and no other process may use its folder.
    fs::remove_file(root.join("waits")).unwrap();
    let mut child = started(&line);
    wait_for(&root.join("waits"));
    child.kill().unwrap();
    child.wait().unwrap();
    let orphan = fs::read_to_string(root.join("waits")).unwrap();
    let (_, text) = run(&line, 1);
    let refused = format!("process {} works in it", orphan.trim());
    assert!(text.lines().last().unwrap().contains(&refused), "{text}");
    kill("-KILL", orphan.trim());

    // Stopped while it trains.
    fs::write(root.join("go"), "").unwrap();
    let child = started(&line);
    wait_for(&made.join("run/train.csv"));
    kill("-TERM", &child.id().to_string());
    let (code, text) = ended(child);
    assert_eq!(code, Some(143), "{text}");
    let again = format!("go on with `nightsplat {}", photos.display());
    for part in ["2 of 3 training", "stopped after step ", &again, " --no-open --finish`"] {
        assert!(text.contains(part), "no `{part}` in: {text}");
    }
    let log = made.join("dataset/colmap.log");
    assert_eq!((runs(&log, "feature_extractor"), runs(&log, "exhaustive_matcher")), (1, 3));
    assert!(!made.join("dataset/.lock").exists() && !made.join("dataset.partial").exists());

    // Finished.
    let text = succeed(&format!("{line} --finish"));
    let page = made.join("photos.html");
    for part in ["its end was requested", "3 of 3 page: wrote ", page.to_str().unwrap()] {
        assert!(text.contains(part), "no `{part}` in: {text}");
    }
    assert!(fs::read_to_string(&page).unwrap().contains("<title>photos</title>"));
    // Done: only the page is written again.
    fs::remove_file(&page).unwrap();
    let text = succeed(&line);
    assert!(text.contains("is done") && page.is_file(), "{text}");
    assert_eq!(runs(&log, "mapper"), 1);

    // With other photographs, nothing is mixed.
    fs::copy(photos.join("v08.png"), photos.join("v09.png")).unwrap();
    let (_, text) = run(&line, 1);
    assert!(text.contains("cameras of other photographs or options; begin anew with --overwrite"));
    succeed(&format!("{line} --overwrite --steps 3").replace("--steps 2000", ""));
    assert_eq!(load(&made.join("dataset")).views.len(), 9);
}

#[test]
fn a_dataset_has_two_stages_and_what_is_made_stays_apart_from_it() {
    let root = &Folder::empty();
    let set = root.join("set");
    nightsplat_synth::write(&set, &crate::common::train::small_set(9, [40, 30], 2)).unwrap();
    for out in ["set", "set/splat", "."] {
        let out = root.join(out);
        let line = format!("make {} --out {} --steps 2", set.display(), out.display());
        refused(&line, 2, &["--out", "where the photographs are; choose another folder"]);
    }
    for out in ["set", "."] {
        let line = format!("train {} --out {} --steps 2", set.display(), root.join(out).display());
        refused(&line, 2, &["--out", "where the photographs are; choose another folder"]);
    }
    let out = root.join("out");
    let line = format!("make {} --out {} --steps 2 {TRAINED}", set.display(), out.display());
    let text = succeed(&format!("{line} --title Attic"));
    says(&text, &["2 of 2 page: wrote ", "next: open "]);
    assert!(fs::read_to_string(out.join("set.html")).unwrap().contains("<title>Attic</title>"));
    // A run is no dataset.
    let run_folder = out.join("run").display().to_string();
    for command in ["", "train", "diagnose"] {
        let out = if command == "train" { "--out elsewhere" } else { "" };
        let line = format!("{command} {run_folder} {out}");
        refused(&line, 3, &["is a run, not a dataset", set.to_str().unwrap()]);
    }
    refused("attics", 2, &["attics"]);
}

/// A stub whose first attempt finds two of nine cameras, and whose later ones never end.
#[test]
fn further_attempts_end_when_their_time_is_up() {
    let root = &Folder::empty();
    let photos = photographed(root);
    model(4).write_binary(&root.join("models/0"));
    let cases = format!(
        "mapper) [ -e {0}/first ] && exec sleep 100; touch {0}/first; cp -r {0}/models/* $output;;",
        root.display()
    );
    let colmap = stub(root, &cases);
    let begin = Instant::now();
    let (stdout, stderr) = run(&line(&photos, &root.join("scene"), &colmap, "--patience 0.1"), 0);
    assert!(stdout.contains("4 of 9 photographs"), "{stdout}");
    let told = "the time for further attempts is up (--patience 0.2 allows more)";
    assert!(stderr.contains(told) && begin.elapsed() < Duration::from_secs(60), "{stderr}");
    fs::remove_file(root.join("first")).unwrap();
    let (_, stderr) = run(&line(&photos, &root.join("none"), &colmap, "--patience 0"), 0);
    assert!(!stderr.contains("matching again"), "{stderr}");
}
