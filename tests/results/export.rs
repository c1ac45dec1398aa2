//! `nightsplat export` as a shell runs it. The formats are tested next to their encoders.

use std::path::Path;

use nightsplat::splats::scene::ply;

use crate::common::command::{refused, succeed};

/// A short run on a small synthetic dataset.
fn trained(folder: &Path) -> String {
    let root = folder.display();
    succeed(&format!("synth {root}/set --views 9 --width 40 --height 32"));
    succeed(&format!(
        "train {root}/set --out {root}/run --plan none --curve ase --steps 12 --progress none"
    ));
    format!("{root}/run")
}

#[test]
fn every_format_is_one_file_of_the_run_with_its_expected_beginning() {
    let folder = tempfile::tempdir().unwrap();
    let run = trained(folder.path());
    for (format, magic) in [
        ("spz", &b"NGSP"[..]),
        ("glb", b"glTF"),
        ("sog", b"PK\x03\x04"),
        ("html", b"<!DOCTYPE html>"),
    ] {
        let message = succeed(&format!("export {run} --format {format}"));
        let path = Path::new(&run).join(format!("model.{format}"));
        assert!(message.contains("Gaussians in"), "{message}");
        assert!(std::fs::read(&path).unwrap().starts_with(magic), "{format}");
    }
    let html = std::fs::read_to_string(Path::new(&run).join("model.html")).unwrap();
    for part in
        ["curve: ase", "dataset: set", "\"label\":\"photograph\"", "\"label\":\"reference\""]
    {
        assert!(html.contains(part), "{part}");
    }

    // Without reference images the targets are what the model is compared with.
    std::fs::remove_dir_all(folder.path().join("set/high")).unwrap();
    succeed(&format!("export {run} --format html"));
    let html = std::fs::read_to_string(Path::new(&run).join("model.html")).unwrap();
    let labels = ["photograph", "target", "reference"]
        .map(|label| html.matches(&format!("\"label\":\"{label}\"")).count());
    assert!(labels[0] > 0 && labels == [labels[0], labels[0], 0], "{labels:?}");

    let copy = folder.path().join("copy.ply");
    succeed(&format!("export {run} --format ply --out {}", copy.display()));
    let header = String::from_utf8_lossy(&std::fs::read(&copy).unwrap()[..300]).into_owned();
    assert!(header.contains("comment curve: ase"), "{header}");
    // Padded to degree 3, for viewers that expect that layout.
    let model = ply::load(Path::new(&run).join("model.ply")).unwrap();
    assert_eq!(ply::load(&copy).unwrap(), model.with_sh_degree(3));
    let header = String::from_utf8_lossy(&std::fs::read(&copy).unwrap()[..3000]).into_owned();
    assert!(header.contains("property float f_rest_44"), "{header}");

    let v3 = folder.path().join("v3.spz");
    succeed(&format!("export {run} --format spz --spz 3 --out {}", v3.display()));
    assert!(std::fs::read(v3).unwrap().starts_with(&[0x1f, 0x8b]));
}

/// Positions in a GLB, which come first.
fn positions_of_glb(path: &Path) -> Vec<[f32; 3]> {
    let file = std::fs::read(path).unwrap();
    let word = |at: usize| u32::from_le_bytes(file[at..at + 4].try_into().unwrap()) as usize;
    let text = word(12);
    let json: serde_json::Value = serde_json::from_slice(&file[20..20 + text]).unwrap();
    let attributes = &json["meshes"][0]["primitives"][0]["attributes"];
    let accessor = &json["accessors"][attributes["POSITION"].as_u64().unwrap() as usize];
    let view = &json["bufferViews"][accessor["bufferView"].as_u64().unwrap() as usize];
    let begin = 28 + text + view["byteOffset"].as_u64().unwrap_or(0) as usize;
    let count = accessor["count"].as_u64().unwrap() as usize;
    let number = |at: usize| f32::from_le_bytes(file[at..at + 4].try_into().unwrap());
    (0..count).map(|index| [0, 4, 8].map(|at| number(begin + 12 * index + at))).collect()
}

#[test]
fn what_is_up_in_a_listing_of_z_up_is_plus_y_of_a_glb() {
    let folder = tempfile::tempdir().unwrap();
    let run = trained(folder.path());
    let message = succeed(&format!("export {run} --format glb"));
    assert!(message.contains("(0.000, 0.000, 1.000) of the dataset is +Y, up"), "{message}");
    let model = ply::load(Path::new(&run).join("model.ply")).unwrap();
    let positions = positions_of_glb(&Path::new(&run).join("model.glb"));
    assert_eq!(positions.len(), model.count);
    for ([x, y, z], mean) in positions.into_iter().zip(model.means()) {
        assert!((y - mean.z).abs() < 1e-4, "{y} for {mean}");
        let away = mean.x.hypot(mean.y);
        assert!((x.hypot(z) - away).abs() < 1e-4, "{x}, {z} for {mean}");
    }
    let message = succeed(&format!("export {run} --format spz"));
    assert!(message.contains("is +Y, up"), "{message}");
}

#[test]
fn a_failed_export_is_one_line_and_leaves_no_file() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path().display();
    refused(&format!("export {root} --format glb"), 3, &["config.toml"]);
    let run = trained(folder.path());
    refused(&format!("export {run} --format ply"), 1, &["is the model itself", "--out"]);
    refused(
        &format!("export {run} --format html --out {root}/x.spz"),
        2,
        &["x.spz is a file of --format spz, not of --format html"],
    );
    refused(
        &format!("export {run} --format glb --out {run}/model.ply/a.glb"),
        1,
        &["a.glb", "cannot be written"],
    );
    // A full disk, if there is a device that simulates one.
    if Path::new("/dev/full").exists() {
        std::os::unix::fs::symlink("/dev/full", folder.path().join("full.glb")).unwrap();
        refused(
            &format!("export {run} --format glb --out {root}/full.glb"),
            1,
            &["full.glb", "disk"],
        );
        assert!(!folder.path().join("full.glb.partial").exists());
    }
    std::fs::remove_file(Path::new(&run).join("model.ply")).unwrap();
    refused(&format!("export {run} --format spz"), 3, &["no model.ply"]);
}
