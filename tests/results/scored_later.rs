//! Scores that are asked for after a training: references found later, LPIPS of a sweep.

use nightsplat::networks::lpips::Network;

use crate::common::command::json;
use crate::common::prelude::*;
use crate::common::{lpips, paths};

#[test]
fn references_that_are_found_later_give_the_scores_of_a_dataset_that_had_them() {
    let workspace = Workspace::new();
    workspace.trained("known", "--steps 20");
    let known = json(workspace.succeed("eval @known --json"));
    // The same dataset, before anyone had photographed it in normal light.
    fs::rename(workspace.path("set/high"), workspace.path("found")).unwrap();
    workspace.trained("run", "--steps 20");
    assert!(workspace.model("run") == workspace.model("known"), "references changed the model");
    let scores_of_targets = json(workspace.succeed("eval @run --json"));
    assert_ne!(scores_of_targets["mean"]["psnr"], known["mean"]["psnr"]);
    let eval = "eval @run --reference @found";
    let later = json(workspace.succeed(&format!("{eval} --json")));
    assert_eq!((&later["mean"], &later["views"]), (&known["mean"], &known["views"]));

    // A model file alone is scored likewise, with the images and the page that are asked for.
    fs::copy(workspace.path("run/model.ply"), workspace.path("model.ply")).unwrap();
    let more = "--save-images --report @page.html";
    let eval = "eval @model.ply --dataset @set ";
    let reference = "--reference @found";
    let of_file = json(workspace.succeed(&format!("{eval} {reference} {more} --json")));
    let psnr = |scores: &Value| scores["mean"]["psnr"].as_f64().unwrap();
    assert!((psnr(&of_file) - psnr(&known)).abs() < 1e-9, "{of_file}");
    assert!(workspace.text("page.html").contains("reference image<"));
    assert!(fs::read_dir(workspace.path("model.eval")).unwrap().count() > 0);

    fs::remove_file(workspace.path("page.html")).unwrap();
    let nowhere = format!("{eval} --reference @nowhere {more}");
    workspace.refused(&nowhere, 3, &["nowhere"]);
    assert!(!workspace.path("page.html").exists());
}

#[test]
fn a_sweep_adds_lpips_to_its_tables_and_scores_no_run_again() {
    let workspace = Workspace::new();
    let weights = workspace.path("weights.safetensors");
    // The network has no output for smaller images.
    workspace.succeed("synth @large --views 9 --width 48 --height 36");
    lpips::write(Network::Alex, &weights, |_, _, _| {});
    let sweep = "sweep @large --out @sweep --curves ap3,ase --steps 2 --sh-degree 0";
    let stdout = workspace.succeed(sweep);
    assert!(!stdout.contains("LPIPS"), "{stdout}");
    let with = format!("{sweep} --lpips @weights.safetensors");
    let (stdout, message) = workspace.run(&with, 0);
    assert!(stdout.contains("LPIPS") && !message.contains("finished"), "{stdout}\n{message}");
    let mut found = paths(&workspace.path("sweep"));
    found.retain(|path| path.join("model.ply").exists());
    assert_eq!(found.len(), 2);
    for folder in &found {
        let eval = format!("eval {} --lpips @weights.safetensors --json", folder.display());
        let lpips_of_run = json(workspace.succeed(&eval))["mean"]["lpips"].as_f64().unwrap();
        assert!(stdout.contains(&format!("{lpips_of_run:.3}")), "{lpips_of_run}: {stdout}");
    }
    let (again, _) = workspace.run(&with, 0);
    assert_eq!(stdout, again);

    fs::write(&weights, "no weights").unwrap();
    workspace.write("other.safetensors", "no weights");
    let other = format!("{sweep} --lpips @other.safetensors");
    workspace.refused(&other, 3, &["other.safetensors"]);
    workspace.refused(&format!("{sweep} --lpips-range unit"), 2, &["--lpips <WEIGHTS>"]);
}
