//! Model files: as initial models, and rendered, scored and exported without a run.

use nightsplat::results::run::load_config;
use nightsplat::splats::model::Model;

use crate::common::command::{json, refused};
use crate::common::prelude::*;

#[test]
fn a_run_starts_from_a_model_and_its_highest_sh_degree() {
    let workspace = Workspace::new();
    workspace.trained("first", "--steps 30");
    workspace.trained("second", "--steps 1 --init @first/model.ply");
    let [first, second] =
        ["first", "second"].map(|run| ply::load(workspace.path(run).join("model.ply")).unwrap());
    // The first run has not reached a higher degree; the second uses it from its first step.
    assert_eq!([&first, &second].map(|model| model.shape.sh_degree), [0, 1]);
    assert_eq!(first.count, second.count);
    let moved = first.means().iter().zip(second.means()).map(|(a, b)| a.distance(*b));
    assert!(moved.fold(0.0, f32::max) < 0.05, "they began elsewhere");
    says(&workspace.text("second/config.toml"), &["first/model.ply"]);

    // From another program: without our features, with additional properties, of a lower degree.
    workspace.write("foreign.ply", with_property(&workspace.model("first")));
    workspace.trained("third", "--steps 1 --init @foreign.ply");
}

/// A binary PLY with an additional float in every vertex.
fn with_property(bytes: &[u8]) -> Vec<u8> {
    let end = b"end_header\n";
    let at = bytes.windows(end.len()).position(|window| window == end).unwrap();
    let header = String::from_utf8(bytes[..at].to_vec()).unwrap();
    let stride = 4 * header.matches("property float").count();
    let mut other = format!("{header}property float confidence\nend_header\n").into_bytes();
    for vertex in bytes[at + end.len()..].chunks_exact(stride) {
        other.extend(vertex);
        other.extend(0.5f32.to_le_bytes());
    }
    other
}

#[test]
fn an_unsuitable_initial_model_is_refused_in_one_line_with_file_and_rule() {
    let workspace = Workspace::new();
    // All zeros; the file is text.
    ply::save(&Gaussians::zeros(2, 2), workspace.path("degree.ply")).unwrap();
    let whole = String::from_utf8(workspace.read("degree.ply")).unwrap();
    let (opacity, alpha) = ("property float opacity\n", "property float alpha\n");
    let origin = "comment world = position + 1 2\nelement";
    let big = "of format binary_big_endian; save it as binary_little_endian";
    for (from, to, rule) in [
        ("", "", "has SH degree 2, more than sh_degree, which is 1"),
        ("binary_little_endian", "ascii", "is truncated: 2 vertices need a line each"),
        ("binary_little_endian", "binary_big_endian", big),
        (opacity, alpha, "has no property `opacity`"),
        ("element", origin, "names the origin `1 2`, which is not three finite numbers"),
    ] {
        workspace.write("changed.ply", whole.replacen(from, to, 1));
        let train = workspace.train("run", "--steps 1 --init @changed.ply");
        refused(&train, 3, &["changed.ply", rule]);
    }
    refused(&workspace.train("run", "--steps 1 --init @none.ply"), 3, &["none.ply"]);
}

#[test]
fn a_run_too_short_for_the_degree_of_its_initial_model_keeps_it() {
    let workspace = Workspace::new();
    ply::save(&Gaussians::zeros(2, 2), workspace.path("degree.ply")).unwrap();
    workspace.succeed("train @set --out @run --steps 2 --init @degree.ply");
    let plan = String::from_utf8(workspace.read("run/plan.toml")).unwrap();
    assert!(plan.contains("that of the given model"), "{plan}");
    let trained = ply::load(workspace.path("run/model.ply")).unwrap();
    assert_eq!(trained.shape.sh_degree, 2);
}

#[test]
fn a_model_file_is_scored_rendered_and_exported_without_its_run() {
    let workspace = Workspace::new();
    workspace.trained("run", "--steps 40");
    workspace.write("copy.ply", workspace.model("run"));
    let (scores, message) = workspace.run("eval @copy.ply --dataset @set --json", 0);
    assert!(!message.contains("near plane"), "{message}");
    let psnr = |scores: &str| json(scores)["mean"]["psnr"].as_f64().unwrap();
    let of_run = workspace.succeed("eval @run --json");
    assert!((psnr(&scores) - psnr(&of_run)).abs() < 1e-6, "{scores} {of_run}");
    workspace.refused("eval @copy.ply", 3, &["copy.ply", "--dataset"]);

    workspace.succeed("render @copy.ply --dataset @set --split test --out @pictures");
    assert!(fs::read_dir(workspace.path("pictures")).unwrap().count() > 0);

    for to in ["spz", "glb", "sog"] {
        workspace.succeed(&format!("export @copy.ply --format {to} --up none"));
        assert!(workspace.path(&format!("copy.{to}")).is_file(), "{to}");
    }
    for file in ["copy.spz", "copy.sog"] {
        let shown = workspace.succeed(&format!("eval @{file} --dataset @set --json"));
        assert!((psnr(&shown) - psnr(&of_run)).abs() < 0.5, "{file}: {shown} {of_run}");
    }
    workspace.succeed("export @copy.ply --format html --dataset @set");
    workspace.refused("export @copy.ply --format html", 3, &["copy.ply", "--dataset"]);
}

/// Removes the facts that the file states.
fn without_facts(path: &Path) {
    let bytes = fs::read(path).unwrap();
    let mut rest = &bytes[..];
    let mut kept = vec![];
    while let Some(end) = rest.iter().position(|&byte| byte == b'\n') {
        let (line, after) = rest.split_at(end + 1);
        if !line.starts_with(b"comment nightsplat ") {
            kept.extend(line);
        }
        rest = after;
        if line == b"end_header\n" {
            break;
        }
    }
    kept.extend(rest);
    fs::write(path, kept).unwrap();
}

#[test]
fn a_model_is_loaded_with_the_facts_of_its_run_or_file_and_otherwise_with_the_defaults() {
    let workspace = Workspace::new();
    workspace.trained("run", "--steps 5 --near 0.05 --raw-colors on");
    let run_folder = workspace.path("run");
    let scale = load_config(&run_folder).unwrap().frame.unwrap_or_default().scale;
    let model = Model::load(&run_folder).unwrap();
    assert!((f64::from(model.near) * scale - 0.1).abs() < 1e-6, "{}", model.near);
    assert_eq!((model.max_alpha, model.raw_colors), (0.99, true));
    let settings = model.render_settings();
    assert_eq!((settings.near, settings.shape), (model.near, model.gaussians.shape));

    // The file alone and the exports state the same facts.
    let file = run_folder.join("model.ply");
    let header = String::from_utf8_lossy(&fs::read(&file).unwrap()[..300]).into_owned();
    for line in ["max_alpha 0.99", "raw_colors true"] {
        assert!(header.contains(&format!("comment nightsplat {line}\n")), "{header}");
    }
    assert_eq!(Model::load(&file).unwrap(), model);
    for name in ["a.ply", "a.spz", "a.sog", "saved.ply", "saved.spz", "saved.sog"] {
        let path = workspace.path(name);
        match name.strip_prefix("a.") {
            Some(format) => {
                let to = format!("--format {format} --out @{name} --up none");
                workspace.succeed(&format!("export @run {to}"));
            }
            None => model.save(&path).unwrap(),
        }
        let back = Model::load(&path).unwrap();
        let facts = |model: &Model| (model.near, model.max_alpha, model.raw_colors, model.law);
        assert_eq!(facts(&back), facts(&model), "{name}");
        assert_eq!(back.gaussians.count, model.gaussians.count, "{name}");
    }
    let glb = workspace.path("saved.glb");
    model.save(&glb).unwrap();
    let glb = fs::read(glb).unwrap();
    let length = u32::from_le_bytes(glb[12..16].try_into().unwrap()) as usize;
    let stated = &json(&glb[20..20 + length])["asset"]["extras"]["nightsplat"];
    assert_eq!(stated["near"].to_string(), model.near.to_string());
    assert_eq!(stated["raw_colors"], true);

    // A run of a version whose files stated no facts uses its configuration, which has no law.
    let shown = Gaussians::open(&file).unwrap();
    without_facts(&file);
    assert_eq!(Model::load(&run_folder).unwrap(), Model { law: None, ..model });
    assert_eq!(Model::load(&file).unwrap(), Model::from(shown));
    let (_, message) = workspace.run("eval @run/model.ply --dataset @set", 0);
    says(&message, &["model.ply: does not state its near plane"]);
}

#[test]
fn an_export_keeps_the_origin_and_the_page_the_near_plane() {
    let workspace = Workspace::new();
    workspace.trained("run", "--steps 5 --near 0.5");
    let path = workspace.path("run/model.ply");
    let mut gaussians = ply::load(&path).unwrap();
    gaussians.origin = DVec3::new(4_499_999.6, 519_997.7, 10_001.8);
    ply::save(&gaussians, &path).unwrap();
    let message = workspace.succeed("export @run --format ply --out @out.ply");
    says(&message, &["world = position + 4499999.6 519997.7 10001.8"]);
    assert_eq!(ply::load(workspace.path("out.ply")).unwrap(), gaussians.with_sh_degree(3));
    let line = "comment world = position + 4499999.6 519997.7 10001.8";
    says(&String::from_utf8_lossy(&workspace.read("out.ply")), &[line]);

    workspace.succeed("export @run --format html");
    let html = workspace.text("run/model.html");
    let (_, after) = html.split_once("\"near\":").unwrap();
    let near: f64 = after.split([',', '}']).next().unwrap().parse().unwrap();
    let config = load_config(&workspace.path("run")).unwrap();
    let scale = config.frame.unwrap_or_default().scale;
    assert!((near - 1.0 / scale).abs() < 1e-6, "{near} at a scale of {scale}");
}

#[test]
fn training_far_from_the_origin_of_the_world_says_what_positions_are_relative_to() {
    let workspace = Workspace::new();
    let near = workspace.trained("near", "--steps 2");
    assert!(!near.contains("relative"), "{near}");
    for listing in ["transforms_train.json", "transforms_test.json"] {
        let listing = format!("set/{listing}");
        let mut listed = workspace.json(&listing);
        for frame in listed["frames"].as_array_mut().unwrap() {
            let x = &mut frame["transform_matrix"][0][3];
            *x = (x.as_f64().unwrap() + 448_262.5).into();
        }
        workspace.write(&listing, listed.to_string());
    }
    let far = workspace.trained("far", "--steps 2");
    assert!(far.contains("model.ply: positions are relative"), "{far}");
    let header = workspace.read("far/model.ply");
    let header = String::from_utf8_lossy(&header[..400]).into_owned();
    let origin = header.lines().find(|line| line.contains("world = position + ")).unwrap();
    assert!(far.contains(origin.trim_start_matches("comment ")), "{origin}: {far}");
}
