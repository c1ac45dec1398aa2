//! Model files: as initial models, and rendered, scored and exported without a run.

use nightsplat::Error;
use nightsplat::results::run::load_config;
use nightsplat::splats::model::Model;

use crate::common::command::{Folder, json, refused, run, succeed};
use crate::common::prelude::*;

#[test]
fn a_run_starts_from_a_model_and_its_highest_sh_degree() {
    let workspace = Workspace::new();
    workspace.trained("first", "--steps 30");
    let model = workspace.path("first/model.ply");
    workspace.trained("second", &format!("--steps 1 --init {}", model.display()));
    let [first, second] =
        ["first", "second"].map(|run| ply::load(workspace.path(run).join("model.ply")).unwrap());
    // The first run has not reached a higher degree; the second uses it from its first step.
    assert_eq!([&first, &second].map(|model| model.shape.sh_degree), [0, 1]);
    assert_eq!(first.count, second.count);
    let moved = first.means().iter().zip(second.means()).map(|(a, b)| a.distance(*b));
    assert!(moved.fold(0.0, f32::max) < 0.05, "they began elsewhere");
    let config = workspace.text("second/config.toml");
    assert!(config.contains("first/model.ply"), "{config}");

    // From another program: without our features, with additional properties, of a lower degree.
    let bytes = with_property(&fs::read(&model).unwrap());
    workspace.write("foreign.ply", bytes);
    let foreign = workspace.path("foreign.ply");
    workspace.trained("third", &format!("--steps 1 --init {}", foreign.display()));
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
    let file = |name: &str, bytes: &[u8]| {
        workspace.write(name, bytes);
    };
    // All zeros; the file is text.
    ply::save(&Gaussians::zeros(2, 2), workspace.path("degree.ply")).unwrap();
    let whole = String::from_utf8(workspace.read("degree.ply")).unwrap();
    let header = |from: &str, to: &str| whole.replacen(from, to, 1).into_bytes();
    file("ascii.ply", &header("binary_little_endian", "ascii"));
    file("big.ply", &header("binary_little_endian", "binary_big_endian"));
    file("points.ply", &header("property float opacity\n", "property float alpha\n"));
    file("origin.ply", &header("element", "comment world = position + 1 2\nelement"));
    for (name, rule) in [
        ("degree.ply", "has SH degree 2, more than sh_degree, which is 1"),
        ("ascii.ply", "is truncated: 2 vertices need a line each"),
        ("big.ply", "of format binary_big_endian; save it as binary_little_endian"),
        ("points.ply", "has no property `opacity`"),
        ("origin.ply", "names the origin `1 2`, which is not three finite numbers"),
        ("none.ply", "none.ply"),
    ] {
        let options = format!("--steps 1 --init @{name}");
        refused(&workspace.train("run", &options), 3, &[name, rule]);
    }
}

#[test]
fn a_model_file_is_scored_rendered_and_exported_without_its_run() {
    let workspace = Workspace::new();
    workspace.trained("run", "--steps 40");
    let (model, set) = (workspace.path("copy.ply"), workspace.path("set"));
    fs::copy(workspace.path("run/model.ply"), &model).unwrap();
    let (model, set) = (model.display(), set.display());

    let (scores, message) = workspace.run(&format!("eval {model} --dataset {set} --json"), 0);
    assert!(!message.contains("near plane"), "{message}");
    let psnr = |scores: &str| json(scores)["mean"]["psnr"].as_f64().unwrap();
    let of_run = workspace.succeed("eval @run --json");
    assert!((psnr(&scores) - psnr(&of_run)).abs() < 1e-6, "{scores} {of_run}");
    workspace.refused(&format!("eval {model}"), 3, &["copy.ply", "--dataset"]);

    let pictures = workspace.path("pictures");
    workspace.succeed(&format!(
        "render {model} --dataset {set} --split test --out {}",
        pictures.display()
    ));
    assert!(fs::read_dir(pictures).unwrap().count() > 0);

    for to in ["spz", "glb", "sog"] {
        workspace.succeed(&format!("export {model} --format {to} --up none"));
        assert!(workspace.path(&format!("copy.{to}")).is_file(), "{to}");
    }
    for (file, loss) in [("copy.spz", 0.5), ("copy.sog", 0.5)] {
        let packed = workspace.path(file);
        let shown = workspace.succeed(&format!("eval {} --dataset {set} --json", packed.display()));
        assert!((psnr(&shown) - psnr(&of_run)).abs() < loss, "{file}: {shown} {of_run}");
    }
    workspace.succeed(&format!("export {model} --format html --dataset {set}"));
    workspace.refused(&format!("export {model} --format html"), 3, &["copy.ply", "--dataset"]);
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
                let out = path.display();
                succeed(&format!(
                    "export {} --format {format} --out {out} --up none",
                    run_folder.display()
                ));
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
    let set = workspace.path("set");
    let silent = format!("eval {} --dataset {}", file.display(), set.display());
    let (_, message) = run(&silent, 0);
    assert!(message.contains("model.ply: does not state its near plane"), "{message}");
}

#[test]
fn an_invalid_fact_in_a_file_is_an_error_of_one_line() {
    let folder = Folder::empty();
    let path = folder.path("model.ply");
    let problem = |comment: &str| {
        Model::from(Gaussians::zeros(2, 0)).save(&path).unwrap();
        // All zeros: the file is text.
        let text = fs::read_to_string(&path).unwrap();
        fs::write(&path, text.replacen("element", &format!("comment {comment}\nelement"), 1))
            .unwrap();
        let error = Model::load(&path).map(|model| model.near).unwrap_err();
        assert!(matches!(error, Error::Input { .. }), "{error:?}");
        let error = error.to_string();
        let (_, problem) = error.split_once("model.ply: ").unwrap();
        let fact = problem.strip_suffix("; export the model again");
        fact.unwrap_or_else(|| panic!("no remedy: {problem}")).to_owned()
    };
    for near in ["x", "-1", "0", "NaN", "inf", ""] {
        let stated = problem(&format!("nightsplat near {near}"));
        let expected = format!("line 7 states near `{near}`, which is not a finite number above 0");
        assert_eq!(stated, expected);
    }
    assert_eq!(
        problem("nightsplat max_alpha 1"),
        "line 7 states max_alpha `1`, which is not a finite number between 0 and 1"
    );
    assert_eq!(
        problem("nightsplat raw_colors on"),
        "line 7 states raw_colors `on`, which is neither true nor false"
    );
    assert_eq!(
        problem("world = position + 1 2"),
        "line 7 names the origin `1 2`, which is not three finite numbers"
    );
    // Facts of later versions are skipped.
    Model::from(Gaussians::zeros(2, 0)).save(&path).unwrap();
    let text = fs::read_to_string(&path).unwrap();
    fs::write(&path, text.replacen("element", "comment nightsplat later 1 2\nelement", 1)).unwrap();
    assert_eq!(Model::load(&path).unwrap().near, 0.2);

    fs::write(&path, "solid cube").unwrap();
    let error = Model::load(&path).unwrap_err().to_string();
    assert!(error.contains("model.ply: is not a model: neither PLY, SPZ nor SOG"), "{error}");
    let error = Model::load(&folder).unwrap_err().to_string();
    assert!(error.contains("no config.toml"), "{error}");
}

#[test]
fn an_export_keeps_the_origin_and_the_page_the_near_plane() {
    let workspace = Workspace::new();
    workspace.trained("run", "--steps 5 --near 0.5");
    let path = workspace.path("run/model.ply");
    let mut gaussians = ply::load(&path).unwrap();
    gaussians.origin = DVec3::new(4_499_999.6, 519_997.7, 10_001.8);
    ply::save(&gaussians, &path).unwrap();
    let (run, out) = (workspace.path("run"), workspace.path("out.ply"));
    let message =
        succeed(&format!("export {} --format ply --out {}", run.display(), out.display()));
    assert!(message.contains("world = position + 4499999.6 519997.7 10001.8"), "{message}");
    assert_eq!(ply::load(&out).unwrap(), gaussians.with_sh_degree(3));
    let line = "comment world = position + 4499999.6 519997.7 10001.8";
    assert!(String::from_utf8_lossy(&fs::read(&out).unwrap()).contains(line));

    succeed(&format!("export {} --format html", run.display()));
    let html = fs::read_to_string(Path::new(&run).join("model.html")).unwrap();
    let (_, after) = html.split_once("\"near\":").unwrap();
    let near: f64 = after.split([',', '}']).next().unwrap().parse().unwrap();
    let config = load_config(&run).unwrap();
    let scale = config.frame.unwrap_or_default().scale;
    assert!((near - 1.0 / scale).abs() < 1e-6, "{near} at a scale of {scale}");
}

#[test]
fn training_far_from_the_origin_of_the_world_says_what_positions_are_relative_to() {
    let workspace = Workspace::new();
    let near = workspace.trained("near", "--steps 2");
    assert!(!near.contains("relative"), "{near}");
    for listing in ["transforms_train.json", "transforms_test.json"] {
        let path = workspace.path("set").join(listing);
        let mut listed: Value = serde_json::from_slice(&fs::read(&path).unwrap()).unwrap();
        for frame in listed["frames"].as_array_mut().unwrap() {
            let x = &mut frame["transform_matrix"][0][3];
            *x = (x.as_f64().unwrap() + 448_262.5).into();
        }
        fs::write(&path, listed.to_string()).unwrap();
    }
    let far = workspace.trained("far", "--steps 2");
    assert!(far.contains("model.ply: positions are relative"), "{far}");
    let header = workspace.read("far/model.ply");
    let header = String::from_utf8_lossy(&header[..400]).into_owned();
    let origin = header.lines().find(|line| line.contains("world = position + ")).unwrap();
    assert!(far.contains(origin.trim_start_matches("comment ")), "{origin}: {far}");
}
