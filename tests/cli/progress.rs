//! Progress output of `train`, for people, logs and schedulers.

use serde_json::Value;

use crate::common::command::{Folder, json, says};

/// Standard output and error of a short run of six steps that is also scored after the third.
fn trained(more: &str) -> (String, String) {
    let folder = Folder::empty();
    folder.succeed("synth @set --views 9 --width 32 --height 24");
    folder.run(&format!("train @set --out @run --steps 6 --sh-degree 0 --eval-every 3 {more}"), 0)
}

#[test]
fn without_a_terminal_intermediate_scores_are_lines() {
    for form in ["", "--progress plain"] {
        let (stdout, stderr) = trained(form);
        says(&stderr, &["step 3: ", "PSNR"]);
        assert!(stdout.contains("6 steps"), "{stdout}");
    }
    let (stdout, stderr) = trained("--progress none");
    assert!(!stderr.contains("step ") && !stderr.contains("memory"), "{stderr}");
    assert!(stdout.contains("6 steps") && !stdout.contains("views of"), "{stdout}");
    says(&stdout, &["wrote ", "next: nightsplat export "]);
}

#[test]
fn json_is_a_line_for_each_event_and_nothing_else() {
    let (stdout, _) = trained("--progress json --checkpoint-every 3");
    let lines: Vec<Value> = stdout.lines().map(json).collect();
    let events: Vec<&str> = lines.iter().map(|line| line["event"].as_str().unwrap()).collect();
    assert_eq!((events[0], events[events.len() - 1]), ("started", "finished"));
    let named = ["step", "checkpointed", "evaluated"];
    assert!(named.iter().all(|event| events.contains(event)), "{events:?}");
    let of = |event: &str| lines.iter().rfind(|line| line["event"] == event).unwrap();
    assert_eq!((&of("step")["step"], &of("step")["steps"]), (&6.into(), &6.into()));
    assert_eq!(of("step")["seconds_left"], 0.0);
    assert!(of("finished")["mean"]["psnr"].as_f64().unwrap() > 5.0, "{stdout}");
    assert!(of("finished")["gaussians"].as_u64().unwrap() > 0);
}

#[test]
fn more_logging_names_the_seconds_of_each_phase_once() {
    let (stdout, stderr) = trained("--progress json -v");
    let told: Vec<&str> =
        stderr.lines().filter_map(|line| line.split_once("seconds: ")).map(|told| told.1).collect();
    let [told] = told[..] else { panic!("{stderr}") };
    let finished = json(stdout.lines().next_back().unwrap());
    let phases = finished["phases"].as_object().unwrap();
    let seconds = |name: &str| phases[name].as_f64().unwrap();
    for name in ["device", "decoding", "plan", "upload", "pipelines", "steps", "scoring", "files"] {
        assert!(seconds(name) > 0.0 && told.contains(&format!("{name} ")), "{name}: {told}");
    }
    let sum: f64 = phases.keys().filter(|name| *name != "all").map(|name| seconds(name)).sum();
    assert!((sum - seconds("all")).abs() < 1e-6, "{told}");
    assert!(seconds("other") < 0.5 * seconds("all"), "{told}");
    let (stdout, stderr) = trained("--progress json");
    assert!(!stdout.contains("phases") && !stderr.contains("seconds: "), "{stdout}{stderr}");
}
