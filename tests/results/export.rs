//! `nightsplat export` as a shell runs it. The formats are tested next to their encoders.

use nightsplat::glam::Vec3;
use nightsplat_models::export::streamed::INDEX;
use nightsplat_models::levels::level;

use crate::common::clouds::cloud;
use crate::common::command::{Folder, json, says};
use crate::common::prelude::*;

/// A folder with a short run on a small synthetic dataset.
fn trained() -> Folder {
    let folder = Folder::empty();
    folder.succeed("synth @set --views 9 --width 40 --height 32");
    folder.succeed("train @set --out @run --plan none --curve ase --steps 12 --progress none");
    folder
}

#[test]
fn every_format_is_one_file_of_the_run_with_its_expected_beginning() {
    let folder = trained();
    for (format, magic) in [
        ("spz", &b"NGSP"[..]),
        ("glb", b"glTF"),
        ("sog", b"PK\x03\x04"),
        ("html", b"<!DOCTYPE html>"),
    ] {
        says(&folder.succeed(&format!("export @run --format {format}")), &["Gaussians in"]);
        assert!(folder.read(&format!("run/model.{format}")).starts_with(magic), "{format}");
    }
    let parts =
        ["curve: ase", "dataset: set", "\"label\":\"photograph\"", "\"label\":\"reference\""];
    says(&folder.text("run/model.html"), &parts);

    // Without reference images the targets are what the model is compared with.
    fs::remove_dir_all(folder.path("set/high")).unwrap();
    folder.succeed("export @run --format html");
    let html = folder.text("run/model.html");
    let labels = ["photograph", "target", "reference"]
        .map(|label| html.matches(&format!("\"label\":\"{label}\"")).count());
    assert!(labels[0] > 0 && labels == [labels[0], labels[0], 0], "{labels:?}");

    folder.succeed("export @run --format ply --out @copy.ply");
    let header = String::from_utf8_lossy(&folder.read("copy.ply")[..3000]).into_owned();
    // Padded to degree 3, for viewers that expect that layout.
    says(&header, &["comment curve: ase", "property float f_rest_44"]);
    let model = ply::load(folder.path("run/model.ply")).unwrap();
    assert_eq!(ply::load(folder.path("copy.ply")).unwrap(), model.with_sh_degree(3));

    folder.succeed("export @run --format spz --spz 3 --out @v3.spz");
    assert!(folder.read("v3.spz").starts_with(&[0x1f, 0x8b]));
}

#[test]
fn a_page_of_limited_size_rounds_coefficients_before_it_leaves_them_out() {
    let folder = trained();
    let stream = Stream::new(3, 0);
    let gaussians = ply::load(folder.path("run/model.ply")).unwrap();
    let mut gaussians = Gaussians::concatenated(&[&gaussians; 10]).with_sh_degree(3);
    for (i, rest) in gaussians.rest_mut().iter_mut().enumerate() {
        *rest = Vec3::splat(0.05 * stream.uniform(i as u64) as f32);
    }
    ply::save(&gaussians, folder.path("run/model.ply")).unwrap();
    let mut sizes = vec![];
    let mut exported = |most: u64| {
        let line =
            folder.succeed(&format!("export @run --format html --views 1 --max-size {most}B"));
        sizes.push(fs::metadata(folder.path("run/model.html")).unwrap().len());
        (line, *sizes.last().unwrap())
    };
    let (line, whole) = exported(1 << 30);
    says(&line, &["SH degree 3 of 3, level 0"]);
    let (line, rounded) = exported(whole - 1);
    says(&line, &["SH degree 3 of 3 in multiples of 1/256, level 0"]);
    let (line, coarse) = exported(rounded - 1);
    says(&line, &["SH degree 3 of 3 in multiples of 1/64, level 0"]);
    let (line, _) = exported(coarse - 1);
    says(&line, &["SH degree 2 of 3", "level 0"]);
    assert!(sizes.is_sorted_by(|one, next| next < one), "{sizes:?}");
}

/// Positions in a GLB, which come first.
fn positions_of_glb(path: &Path) -> Vec<[f32; 3]> {
    let file = fs::read(path).unwrap();
    let word = |at: usize| u32::from_le_bytes(file[at..at + 4].try_into().unwrap()) as usize;
    let text = word(12);
    let json = json(&file[20..20 + text]);
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
    let folder = trained();
    let message = folder.succeed("export @run --format glb");
    says(&message, &["(0.000, 0.000, 1.000) of the dataset is +Y, up"]);
    let model = ply::load(folder.path("run/model.ply")).unwrap();
    let positions = positions_of_glb(&folder.path("run/model.glb"));
    assert_eq!(positions.len(), model.count);
    for ([x, y, z], mean) in positions.into_iter().zip(model.means()) {
        assert!((y - mean.z).abs() < 1e-4, "{y} for {mean}");
        let away = mean.x.hypot(mean.y);
        assert!((x.hypot(z) - away).abs() < 1e-4, "{x}, {z} for {mean}");
    }
    says(&folder.succeed("export @run --format spz"), &["is +Y, up"]);
}

#[test]
fn a_failed_export_is_one_line_and_leaves_no_file() {
    let folder = trained();
    folder.refuses_all(
        "
        3 | export @ --format glb | config.toml
        1 | export @run --format ply | is the model itself & --out
        2 | export @run --format html --out @x.spz | x.spz is a file of --format spz, not of --format html
        1 | export @run --format glb --out @run/model.ply/a.glb | a.glb & cannot be written",
    );
    // A full disk, if there is a device that simulates one.
    if Path::new("/dev/full").exists() {
        std::os::unix::fs::symlink("/dev/full", folder.path("full.glb")).unwrap();
        folder.refused("export @run --format glb --out @full.glb", 1, &["full.glb", "disk"]);
        assert!(!folder.path("full.glb.partial").exists());
    }
    fs::remove_file(folder.path("run/model.ply")).unwrap();
    folder.refused("export @run --format spz", 3, &["no model.ply"]);
}

#[test]
fn streamed_sog_has_levels_and_its_options_are_refused_for_other_formats() {
    let folder = Folder::empty();
    let mut model = cloud(300, 1, 3);
    model.origin = DVec3::new(1000.0, -5.0, 0.0);
    ply::save(&model, folder.path("a.ply")).unwrap();
    let line = folder.succeed("export @a.ply --format streamed-sog --levels 2 --chunk 160");
    says(&line, &["2 levels of 300, 152 Gaussians in 3 chunks"]);
    assert_eq!(
        folder.json(&format!("a.streamed-sog/{INDEX}"))["counts"],
        serde_json::json!([300, 152])
    );

    folder.succeed("export @a.ply --format ply --level 1 --chunk 160 --out @b.ply");
    let half = ply::load(folder.path("b.ply")).unwrap();
    assert_eq!(half, level(&model, &[model.count], 40, 1).with_sh_degree(3));
    folder.refuses_all(
        "2 | export @a.ply --format sog --levels 2 | --level
         2 | export @a.ply --format streamed-sog --level 1 | --levels
         2 | export @a.ply --format streamed-sog --levels 0 | --levels 0
         2 | export @a.ply --format sog --level 16 | --level 16
         2 | export @a.ply --format sog --chunk 0 | --chunk 0
         2 | export @a.ply --format streamed-sog --out a.sog | --format sog",
    );
}
