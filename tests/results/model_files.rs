//! Model files: as initial models, and rendered, scored and exported without a run.

use std::fs;
use std::path::Path;

use glam::DVec3;
use nightsplat::splats::scene::{Gaussians, ply};

use crate::common::command::{refused, run, succeed};
use crate::common::place::Place;

#[test]
fn a_run_starts_from_a_model_and_its_highest_sh_degree() {
    let place = Place::new();
    succeed(&place.train("first", "--steps 30"));
    let model = place.path("first/model.ply");
    succeed(&place.train("second", &format!("--steps 1 --init {}", model.display())));
    let [first, second] =
        ["first", "second"].map(|run| ply::load(place.path(run).join("model.ply")).unwrap());
    // The first run has not reached a higher degree; the second uses it from its first step.
    assert_eq!([&first, &second].map(|model| model.shape.sh_degree), [0, 1]);
    assert_eq!(first.count, second.count);
    let moved = first.means().iter().zip(second.means()).map(|(a, b)| a.distance(*b));
    assert!(moved.fold(0.0, f32::max) < 0.05, "they began elsewhere");
    let config = fs::read_to_string(place.path("second/config.toml")).unwrap();
    assert!(config.contains("first/model.ply"), "{config}");

    // From another program: without our features, with additional properties, of a lower degree.
    let bytes = with_property(&fs::read(&model).unwrap());
    fs::write(place.path("foreign.ply"), bytes).unwrap();
    let foreign = place.path("foreign.ply");
    succeed(&place.train("third", &format!("--steps 1 --init {}", foreign.display())));
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
    let place = Place::new();
    let file = |name: &str, bytes: &[u8]| {
        fs::write(place.path(name), bytes).unwrap();
    };
    // All zeros; the file is text.
    ply::save(&Gaussians::zeros(2, 2), place.path("degree.ply")).unwrap();
    let whole = String::from_utf8(place.read("degree.ply")).unwrap();
    let header = |from: &str, to: &str| whole.replacen(from, to, 1).into_bytes();
    file("ascii.ply", &header("binary_little_endian", "ascii"));
    file("big.ply", &header("binary_little_endian", "binary_big_endian"));
    file("points.ply", &header("property float opacity\n", "property float alpha\n"));
    file("origin.ply", &header("element", "comment world = position + 1 2\nelement"));
    for (name, rule) in [
        ("degree.ply", "has SH degree 2, more than sh_degree, which is 1"),
        ("ascii.ply", "of format ascii; save it as binary_little_endian"),
        ("big.ply", "of format binary_big_endian; save it as binary_little_endian"),
        ("points.ply", "has no property `opacity`"),
        ("origin.ply", "names the origin `1 2`, which is not three finite numbers"),
        ("none.ply", "none.ply"),
    ] {
        let options = format!("--steps 1 --init {}", place.path(name).display());
        refused(&place.train("run", &options), 3, &[name, rule]);
    }
}

#[test]
fn a_model_file_is_scored_rendered_and_exported_without_its_run() {
    let place = Place::new();
    succeed(&place.train("run", "--steps 40"));
    let (model, set) = (place.path("copy.ply"), place.path("set"));
    fs::copy(place.path("run/model.ply"), &model).unwrap();
    let (model, set) = (model.display(), set.display());

    let (scores, message) = run(&format!("eval {model} --dataset {set} --json"), 0);
    assert!(message.contains("training are unknown"), "{message}");
    let psnr = |json: &str| {
        let json: serde_json::Value = serde_json::from_str(json).unwrap();
        json["mean"]["psnr"].as_f64().unwrap()
    };
    let own = succeed(&format!("eval {} --json", place.path("run").display()));
    assert!((psnr(&scores) - psnr(&own)).abs() < 1e-6, "{scores} {own}");
    refused(&format!("eval {model}"), 3, &["copy.ply", "--dataset"]);

    let pictures = place.path("pictures");
    succeed(&format!("render {model} --dataset {set} --split test --out {}", pictures.display()));
    assert!(fs::read_dir(pictures).unwrap().count() > 0);

    for to in ["spz", "glb", "sog"] {
        succeed(&format!("export {model} --to {to}"));
        assert!(place.path(&format!("copy.{to}")).is_file(), "{to}");
    }
    succeed(&format!("export {model} --to html --dataset {set}"));
    refused(&format!("export {model} --to html"), 3, &["copy.ply", "--dataset"]);
}

#[test]
fn an_export_keeps_the_origin_and_the_page_the_near_plane() {
    let place = Place::new();
    succeed(&place.train("run", "--steps 5 --near 0.5"));
    let path = place.path("run/model.ply");
    let mut gaussians = ply::load(&path).unwrap();
    gaussians.origin = DVec3::new(4_499_999.6, 519_997.7, 10_001.8);
    ply::save(&gaussians, &path).unwrap();
    let (run, out) = (place.path("run"), place.path("out.ply"));
    succeed(&format!("export {} --to ply --out {}", run.display(), out.display()));
    assert_eq!(ply::load(&out).unwrap(), gaussians.with_sh_degree(3));
    let line = "comment world = position + 4499999.6 519997.7 10001.8";
    assert!(String::from_utf8_lossy(&fs::read(&out).unwrap()).contains(line));

    succeed(&format!("export {} --to html", run.display()));
    let html = fs::read_to_string(Path::new(&run).join("model.html")).unwrap();
    let (_, after) = html.split_once("\"near\":").unwrap();
    let near: f64 = after.split([',', '}']).next().unwrap().parse().unwrap();
    let config = nightsplat::results::run::load_config(&run).unwrap();
    let scale = config.frame.unwrap_or_default().scale;
    assert!((near - 1.0 / scale).abs() < 1e-6, "{near} at a scale of {scale}");
}
