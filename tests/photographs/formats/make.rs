//! `nightsplat PHOTOS`: stopped and killed in each stage, and gone on with by the same command, with a program that
//! stands in for COLMAP.

use super::pose::pose;
use super::stub::{MODELS, photographed, stub};
use super::synthetic::*;
use crate::common::command::{command, run, says, succeed};
use crate::common::prelude::*;
use crate::common::process::{ended, send, spawned, wait_for, wait_until};

/// Options of a training of seconds.
const TRAINED: &str = "--curve ap3 --model plain --sh-degree 0 --no-open";

/// A stub whose matcher waits until there is a file `go`, and has then found nine cameras.
fn waiting(root: &Path) {
    model(9).write_binary(&root.join("models/0"));
    let wait = "echo $$ >$root/waits; [ -e $root/go ] || exec sleep 100";
    stub(root, &format!("exhaustive_matcher) {wait};;\n{MODELS}"));
}

/// How often a command of COLMAP was run.
fn runs(log: &Path, command: &str) -> usize {
    let log = fs::read_to_string(log).unwrap();
    log.lines().filter(|line| line.starts_with("$ ") && line.contains(command)).count()
}

#[test]
fn a_folder_becomes_a_page_by_one_command_that_goes_on_in_every_stage() {
    let root = &Folder::empty();
    let photos = photographed(root);
    waiting(root);
    let made = root.join("photos-splat");
    let lock = made.join("dataset.partial/.lock");
    let line = root.named(&format!("@photos --colmap @colmap-stub --steps 2000 {TRAINED}"));

    // Stopped while COLMAP matches.
    let child = spawned(&mut command(&line));
    wait_for(&root.join("waits"));
    send("-INT", child.id());
    let (code, stdout, stderr) = ended(child);
    let text = stdout + &stderr;
    assert_eq!(code, 130, "{text}");
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
    let mut child = spawned(&mut command(&line));
    wait_for(&root.join("waits"));
    let orphan = root.text("waits");
    // COLMAP can have begun before the lock has its name.
    wait_until("the lock names COLMAP", || {
        fs::read_to_string(&lock).is_ok_and(|name| name == orphan)
    });
    child.kill().unwrap();
    child.wait().unwrap();
    let (_, text) = run(&line, 1);
    let refused = format!("process {} works in it", orphan.trim());
    assert!(text.lines().last().unwrap().contains(&refused), "{text}");
    send("-KILL", orphan.trim());

    // Stopped while it trains.
    fs::write(root.join("go"), "").unwrap();
    let child = spawned(&mut command(&line));
    wait_for(&made.join("run/train.csv"));
    send("-TERM", child.id());
    let (code, stdout, stderr) = ended(child);
    let text = stdout + &stderr;
    assert_eq!(code, 143, "{text}");
    let again = format!("go on with `nightsplat {}", photos.display());
    says(&text, &["2 of 3 training", "stopped after step ", &again, " --no-open --finish`"]);
    let log = made.join("dataset/colmap.log");
    assert_eq!((runs(&log, "feature_extractor"), runs(&log, "exhaustive_matcher")), (1, 3));
    assert!(!made.join("dataset/.lock").exists() && !made.join("dataset.partial").exists());

    // Finished.
    let text = succeed(&format!("{line} --finish"));
    let page = made.join("photos.html");
    says(&text, &["its end was requested", "3 of 3 page: wrote ", page.to_str().unwrap()]);
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
    nightsplat_synth::write(&set, &small_set(9, [40, 30], 2)).unwrap();
    for command in ["make", "train"] {
        for out in ["set", "set/splat", "."] {
            if command == "make" || out != "set/splat" {
                let line = format!("{command} @set --out @{out} --steps 2");
                let parts = ["--out", "where the photographs are; choose another folder"];
                root.refused(&line, 2, &parts);
            }
        }
    }
    let line = format!("make @set --out @out --steps 2 {TRAINED} --title Attic");
    says(&root.succeed(&line), &["2 of 2 page: wrote ", "next: open "]);
    says(&root.text("out/set.html"), &["<title>Attic</title>"]);
    // A run is no dataset.
    for command in ["@out/run", "train @out/run --out elsewhere", "diagnose @out/run"] {
        root.refused(command, 3, &["is a run, not a dataset", set.to_str().unwrap()]);
    }
    root.refused("attics", 2, &["attics"]);
}

/// A stub whose first attempt finds two of nine cameras, and whose later ones never end.
#[test]
fn further_attempts_end_when_their_time_is_up() {
    let root = &Folder::empty();
    photographed(root);
    model(4).write_binary(&root.join("models/0"));
    let once = "[ -e $root/first ] && exec sleep 100; touch $root/first";
    stub(root, &format!("mapper) {once}; cp -r $root/models/* $output;;"));
    let begin = Instant::now();
    let (stdout, stderr) = root.run(&pose("--patience 0.1"), 0);
    says(&stdout, &["4 of 9 photographs"]);
    says(&stderr, &["the time for further attempts is up (--patience 0.2 allows more)"]);
    assert!(begin.elapsed() < Duration::from_secs(60), "{stderr}");
    fs::remove_file(root.join("first")).unwrap();
    let (_, stderr) = root.run(&pose("--patience 0 --overwrite"), 0);
    assert!(!stderr.contains("matching again"), "{stderr}");
}
