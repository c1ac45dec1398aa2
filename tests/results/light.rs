//! Light out of a run: the photographs' light, linear files, another size, exposures that vary.

use nightsplat::splats::model::Model;

use crate::common::command::{json, says, unwrapped};
use crate::common::prelude::*;
use crate::common::{copy, paths};

/// The arguments for training with the default curve into `run`.
fn training(options: &str) -> String {
    format!("train @set --out @run --sh-degree 1 --plan none {options}")
}

#[test]
fn renders_are_written_and_scored_in_the_light_of_the_photographs() {
    let workspace = Workspace::new();
    workspace.succeed(&training("--steps 60 --set antialiasing.compensation=true"));
    let scored = json(workspace.succeed("eval @run --photographs --align --json"));
    let dark = &scored["as_photographs"]["mean"];
    // Sixty steps: the light is about right, and so are dark values.
    assert!(dark["psnr"].as_f64().unwrap() > 25.0, "{dark}");
    assert!(dark["stops"].as_f64().unwrap().abs() < 1.0, "{dark}");
    // A twentieth of the light takes a law that multiplies differences.
    let slope = dark["slope"].as_f64().unwrap();
    assert!(slope > 3.0, "{dark}");
    let aligned = scored["aligned_with_reference"]["mean"]["psnr"].as_f64().unwrap();
    assert!(aligned >= scored["mean"]["psnr"].as_f64().unwrap() - 0.01);
    let half = json(workspace.succeed("eval @run --downscale 1.5 --json"));
    assert_ne!(half["mean"]["psnr"], scored["mean"]["psnr"]);
    let table = unwrapped(&workspace.succeed("eval @run --photographs --align"));
    let raised = format!("by {slope:.2}: {:.2} dB of PSNR, dark", 20.0 * slope.log10());
    says(&table, &["PSNR, aligned", "PSNR, dark", "stops", &raised]);
    workspace.refused("eval @run --downscale 0.5", 2, &["is 0.5", "at least 1"]);

    let render = |out: &str, options: &str| {
        workspace.succeed(&format!("render @run --split test --out @{out} {options}"));
        let file = paths(&workspace.path(out)).remove(0);
        (fs::read(&file).unwrap(), Image::load(&file).unwrap())
    };
    let mean = |image: &Image| image.data.iter().sum::<f32>() / image.data.len() as f32;
    let (_, target) = render("target", "");
    let (_, photograph) = render("photograph", "--as photograph");
    let (bytes, linear) = render("linear", "--as linear --format exr");
    assert!(mean(&target) > 3.0 * mean(&photograph), "the photograph is dark");
    assert!((mean(&linear) / mean(&photograph) - 1.0).abs() < 0.3, "one exposure");
    let is_in = |name: &[u8]| bytes.windows(name.len()).any(|window| window == name);
    assert!(is_in(b"nightsplatStops"), "the header states the exposure");
    let split = "render @run --split test --out @no";
    let as_linear = format!("{split} --as linear");
    workspace.refused(&as_linear, 2, &["--as linear", "--format exr"]);
    workspace.refused(&format!("{split} --as photograph --layer depth"), 2, &["--layer"]);
}

#[test]
fn a_model_in_linear_light_states_it_and_has_other_colours() {
    let workspace = Workspace::new();
    workspace.succeed(&training("--steps 40 --antialiasing on"));
    let export =
        |format: &str, out: &str| format!("export @run --linear --format {format} --out @{out}");
    workspace.succeed(&export("ply", "linear.ply"));
    let [encoded, linear] =
        ["run/model.ply", "linear.ply"].map(|name| ply::load(workspace.path(name)).unwrap());
    assert_eq!(encoded.means(), linear.means());
    assert_eq!(encoded.raw_opacities(), linear.raw_opacities());
    assert!(encoded.dc() != linear.dc() && linear.dc().iter().all(|dc| dc.is_finite()));
    let header = String::from_utf8_lossy(&workspace.read("linear.ply")[..2000]).into_owned();
    says(&header, &["nightsplat linear ", "nightsplat antialiased true"]);
    workspace.succeed(&export("glb", "linear.glb"));
    let text = String::from_utf8_lossy(&workspace.read("linear.glb")).into_owned();
    assert!(text.contains("lin_rec709_display"));
    workspace.refused(
        &export("spz", "linear.spz"),
        2,
        &["--linear needs floats", "ply, glb or usda"],
    );
    let of_file = "export @linear.ply --linear --format glb";
    workspace.refused(of_file, 2, &["is a model file", "pass the run directory"]);
    let (_, warned) = workspace.run("export @linear.ply --format glb", 0);
    assert!(warned.contains("its colours are linear light, raised by"), "{warned}");
}

#[test]
fn a_trained_model_states_the_law_whose_inverse_is_the_linear_light() {
    let workspace = Workspace::new();
    workspace.succeed(&training("--steps 40"));
    let export = |options: &str, out: &str| format!("export @run {options} --out @{out}");
    workspace.succeed(&export("--format ply --linear", "linear.ply"));
    let header = String::from_utf8_lossy(&workspace.read("linear.ply")[..2000]).into_owned();
    let stated = header.lines().find_map(|line| line.strip_prefix("comment nightsplat linear "));
    let stops: f32 = stated.unwrap().parse().unwrap();
    for format in ["ply", "spz", "sog"] {
        let out = format!("law.{format}");
        workspace.succeed(&export(&format!("--format {format}"), &out));
    }
    for model in ["run/model.ply", "run", "law.ply", "law.spz", "law.sog"] {
        let law = Model::load(workspace.path(model)).unwrap().law.expect(model);
        assert!((law.stops() - stops).abs() < 1e-4, "{model}: {law:?}, {stops}");
    }
    assert_eq!(Model::load(workspace.path("linear.ply")).unwrap().law, None);
    // Colours of another law are not made of these photographs.
    let other = "train @set --out @other --curve ase --steps 40 --sh-degree 1 --plan none";
    workspace.succeed(other);
    workspace.succeed("edit @run --merge @law.ply --out @both.ply");
    workspace.succeed("edit @run --merge @other/model.ply --out @mixed.ply");
    assert!(Model::load(workspace.path("both.ply")).unwrap().law.is_some());
    assert_eq!(Model::load(workspace.path("mixed.ply")).unwrap().law, None);
}

#[test]
fn a_set_of_varying_exposure_has_its_clean_references_and_the_same_bytes_for_a_seed() {
    let workspace = Workspace::new();
    // The set has dark photographs and, in `high`, those in normal light.
    let vary = |out: &str, options: &str| {
        workspace.run(&format!("vary @set --out @{out} --gamma 0.8,1.25 {options}"), 0).1
    };
    assert!(!vary("a", "--seed 3").contains("are dark"));
    vary("b", "--seed 3");
    vary("c", "--seed 4");
    let bytes = |set: &str| {
        ["low/001.png", "images/001.png", "varied.csv", "test.txt", "sparse/0/points3D.txt"]
            .map(|file| workspace.read(&format!("{set}/{file}")))
    };
    assert!(bytes("a") == bytes("b") && bytes("a") != bytes("c"));
    let [varied, clean] = ["a/low/001.png", "a/images/001.png"]
        .map(|file| Image::load(workspace.path(file)).unwrap());
    assert_ne!(varied.data, clean.data);
    workspace.succeed("train @a --out @run --steps 5 --plan none");
    let scored = json(workspace.succeed("eval @run --json"));
    assert!(scored.get("against").is_none(), "scored against the clean photographs: {scored}");
    assert!(scored.get("at_own_exposure").is_none(), "no exposure is known");
    // Told that test view 000 is two stops brighter than the others, the render is, too.
    let known: String =
        (0..9).map(|i| format!("{i:03},{}\n", if i == 0 { 2 } else { 0 })).collect();
    workspace.write("a/exposures.csv", format!("name,ev\n{known}"));
    let told = json(workspace.succeed("eval @run --json"));
    let psnr = |scores: &Value, view: &str| scores["views"][view]["psnr"].as_f64().unwrap();
    assert_ne!(psnr(&told["at_own_exposure"], "000"), psnr(&told, "000"));
    assert_eq!(psnr(&told["at_own_exposure"], "008"), psnr(&told, "008"));
    says(&workspace.succeed("eval @run"), &["PSNR, own exposure"]);
    workspace.refuses_all(
        "
        2 | vary @set --out @d --gamma 2,1 | a gamma of 2,1 & the lower first
        1 | vary @set --out @a | is not empty & --overwrite",
    );
}

#[test]
fn varied_exposures_of_a_dark_set_are_warned_of() {
    let workspace = Workspace::new();
    copy(&workspace.path("set/low"), &workspace.path("set/high"));
    says(&workspace.run("vary @set --out @out", 0).1, &["photographs are dark"]);
}
