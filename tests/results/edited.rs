//! An edited or exported model is scored as its run is, edits say what they cost, and nothing bright is scored against
//! dark photographs.

use crate::common::command::{json, says};
use crate::common::prelude::*;

fn psnr(scores: &Value) -> f64 {
    scores["mean"]["psnr"].as_f64().unwrap()
}

/// A set without reference images.
fn dark() -> Workspace {
    let workspace = Workspace::new();
    fs::remove_dir_all(workspace.path("set/high")).unwrap();
    workspace
}

#[test]
fn a_model_file_has_the_targets_of_its_run_in_every_format() {
    let workspace = dark();
    // Other views, another size and another curve than the defaults.
    workspace.trained(
        "run",
        "--steps 40 --downscale 1.25 --test-every 3 --set tone.curve=ase --set tone.theta=0.4",
    );
    let of_run = json(workspace.succeed("eval @run --json"));
    workspace.succeed("edit @run --opacity-min 0.0001 --out @clean.ply");
    for (file, most) in [("clean.ply", 1e-3), ("clean.spz", 1.0), ("clean.sog", 1.0)] {
        if !file.ends_with("ply") {
            let format = file.rsplit('.').next().unwrap();
            workspace
                .succeed(&format!("export @clean.ply --format {format} --out @{file} --up none"));
        }
        let scores = json(workspace.succeed(&format!("eval @{file} --dataset @set --json")));
        assert!((psnr(&scores) - psnr(&of_run)).abs() < most, "{file}: {scores} {of_run}");
        assert_eq!(scores["against"], of_run["against"], "{file}");
        let [views, views_of_run] = [&scores, &of_run]
            .map(|scores| scores["views"].as_object().unwrap().keys().cloned().collect::<Vec<_>>());
        assert_eq!(views, views_of_run, "{file}");
    }
    let compared = json(workspace.succeed("compare @run @clean.ply --json"));
    assert!((psnr(&compared["runs"][0]) - psnr(&compared["runs"][1])).abs() < 1e-3, "{compared}");
    // A file that states nothing is loaded as the run, and scored against its targets.
    let mut bare = ply::load(workspace.path("clean.ply")).unwrap();
    bare.dc_mut().iter_mut().for_each(|dc| *dc *= 0.8);
    ply::save(&bare, workspace.path("bare.ply")).unwrap();
    let compared = workspace.succeed("compare @run @bare.ply --dataset @set --json");
    assert!(psnr(&json(&compared)["runs"][1]) > 10.0, "{compared}");
    // The page has targets to compare with.
    workspace.succeed("export @clean.ply --format html --dataset @set");
    assert!(workspace.text("clean.html").contains("\"target\""));
}

#[test]
fn a_bright_model_of_unknown_targets_is_not_scored_against_dark_photographs() {
    let workspace = dark();
    workspace.trained("run", "--steps 40");
    let trained = ply::load(workspace.path("run/model.ply")).unwrap();
    ply::save(&trained, workspace.path("bare.ply")).unwrap();
    let known = ["bare.ply", "as bright as the photographs", "--photographs"];
    refused_after_warnings(&workspace, "eval @bare.ply --dataset @set", &known);
    refused_after_warnings(&workspace, "compare @bare.ply @run --dataset @set", &known);
    for command in ["eval", "compare @bare.ply"] {
        workspace.succeed(&format!("{command} @bare.ply --dataset @set --photographs"));
    }
    // A model as dark as the photographs is scored against them.
    let mut night = trained.with_sh_degree(0);
    let color = 0.282_095;
    night.dc_mut().iter_mut().for_each(|dc| *dc = ((*dc * color + 0.5) * 0.1 - 0.5) / color);
    ply::save(&night, workspace.path("night.ply")).unwrap();
    workspace.succeed("eval @night.ply --dataset @set");
    workspace.write("page.html", "<!DOCTYPE html>");
    workspace.refused("export @page.html --format html", 3, &["is a page, not a model"]);
}

/// Exit code 3, with all parts in the error.
fn refused_after_warnings(workspace: &Workspace, command: &str, parts: &[&str]) {
    let (_, message) = workspace.run(command, 3);
    let error = message.lines().last().unwrap();
    assert!(error.starts_with("error: "), "{message}");
    says(error, parts);
}

/// The numbers before ` dB before` and ` dB after`.
fn before_and_after(stdout: &str) -> [f64; 2] {
    let line = stdout.lines().find(|line| line.starts_with("test views against")).unwrap();
    [" dB before", " dB after"].map(|after| {
        let (before, _) = line.split_once(after).unwrap();
        before.rsplit(' ').next().unwrap().parse().unwrap()
    })
}

#[test]
fn an_edit_of_a_run_says_what_it_costs_and_warns_of_a_loss() {
    let workspace = dark();
    workspace.trained("run", "--steps 60");
    let of_run = json(workspace.succeed("eval @run --json"));
    let edit = |options: &str| workspace.run(&format!("edit @run {options} --out @out.ply"), 0);
    let (stdout, message) = edit("--rotate y:90 --opacity-min 0.0001");
    let [before, after] = before_and_after(&stdout);
    assert!((before - psnr(&of_run)).abs() < 0.02 && (after - before).abs() < 0.1, "{stdout}");
    assert!(stdout.contains("test views against their pseudo-GT: "), "{stdout}");
    assert!(!message.contains("loses"), "{message}");
    says(&stdout, &[&workspace.named("out.ply --dataset @set --format html")]);
    // Half of the model.
    let (stdout, message) = edit("--crop -100,-100,-100,0,100,100");
    let [before, after] = before_and_after(&stdout);
    assert!(before - after > 0.3 && message.contains("the edit loses "), "{stdout}{message}");
    // What only turns the world costs nothing, and renders nothing.
    let (stdout, _) = edit("--rotate y:90");
    assert!(!stdout.contains(" dB "), "{stdout}");
    // Without the photographs, an edit that needs none goes on.
    fs::rename(workspace.path("set"), workspace.path("elsewhere")).unwrap();
    let (_, message) = edit("--opacity-min 0.01");
    assert!(message.contains("the edit is not scored: "), "{message}");
}

#[test]
fn a_crop_to_the_cameras_spares_what_training_views_show() {
    let workspace = dark();
    workspace.trained("run", "--steps 200");
    // As many again where no camera looks.
    let trained = ply::load(workspace.path("run/model.ply")).unwrap();
    let mut unseen: Gaussians = trained.clone();
    unseen.means_mut().iter_mut().for_each(|mean| *mean += Vec3::new(0.0, 500.0, 0.0));
    ply::save(&unseen, workspace.path("unseen.ply")).unwrap();
    let crop = "edit @run --merge @unseen.ply --crop cameras";
    let stdout = workspace.succeed(&format!("{crop} --out @near.ply --save-edits @edits.json"));
    let near = ply::load(workspace.path("near.ply")).unwrap();
    // All but some that are large enough to reach into a view.
    let far = near.means().iter().filter(|mean| mean.y >= 250.0).count();
    assert!(far <= trained.count / 100, "{far}: {stdout}");
    let [before, after] = before_and_after(&stdout);
    assert!((after - before).abs() < 0.01, "{stdout}");
    assert!(stdout.contains("crop to the sphere at [") && !stdout.contains("00000000"), "{stdout}");
    // The list has numbers, and repeats the edit without the photographs' cameras.
    workspace.succeed("edit @run --edits @edits.json --out @again.ply");
    assert!(near == ply::load(workspace.path("again.ply")).unwrap());
    // Walls that a crop by numbers takes are what the test views show.
    let sphere = stdout.split_once("sphere at [").unwrap().1.split_once(", and what").unwrap().0;
    let numbers = sphere.replace("] of radius", ",").replace(' ', "");
    let (by_numbers, _) = workspace.run(&format!("edit @run --crop {numbers} --out @ball.ply"), 0);
    let ball = ply::load(workspace.path("ball.ply")).unwrap();
    assert!(ball.count <= near.count, "{by_numbers}");
}
