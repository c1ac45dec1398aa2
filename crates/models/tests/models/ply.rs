//! PLY files of Gaussians: every bit is kept, and what is wrong is named.

use std::fs;

use glam::Vec3;
use nightsplat_models::gaussians::{Features, Gaussians, Shape, ply};

use crate::common::{Folder, says};
use crate::scene::distinct;

/// The error of loading these bytes.
fn problem(bytes: &[u8]) -> String {
    let dir = Folder::empty();
    dir.write("model.ply", bytes);
    ply::load(dir.join("model.ply")).unwrap_err().to_string()
}

fn bytes(gaussians: &Gaussians) -> Vec<u8> {
    let dir = Folder::empty();
    ply::save(gaussians, dir.join("model.ply")).unwrap();
    dir.read("model.ply")
}

#[test]
fn features_follow_the_harmonics() {
    let header = bytes(&distinct(1, Shape { sh_degree: 0, features: Features::ALL }));
    let header = String::from_utf8_lossy(&header).into_owned();
    let names = "f_dc_2 f_depth_0 f_prior_0 f_noise_0 f_noise_1 f_noise_2 f_illu_0 f_illu_1 f_illu_2 opacity";
    let lines = names.replace(' ', "\nproperty float ");
    assert!(header.contains(&lines), "{header}");
}

/// The file with the text of its header changed.
fn with_header(bytes: &[u8], from: &str, to: &str) -> Vec<u8> {
    let body = bytes.windows(11).position(|window| window == b"end_header\n").unwrap() + 11;
    let header = std::str::from_utf8(&bytes[..body]).unwrap();
    assert!(header.contains(from));
    [header.replacen(from, to, 1).as_bytes(), &bytes[body..]].concat()
}

#[test]
fn saving_and_loading_preserves_every_bit() {
    let dir = Folder::empty();
    let path = dir.join("model.ply");
    let noise = Features { noise: true, ..Features::NONE };
    for features in [Features::NONE, noise, Features::ALL] {
        for (sh_degree, count) in (0..=3).flat_map(|degree| [0, 1, 37].map(|n| (degree, n))) {
            let gaussians = distinct(count, Shape { sh_degree, features });
            ply::save(&gaussians, &path).unwrap();
            assert_eq!(ply::load(&path).unwrap(), gaussians, "degree {sh_degree}, {count}");
        }
    }
    assert_eq!(fs::read_dir(&dir).unwrap().count(), 1, "a temporary file is left");
}

#[test]
fn the_layout_is_that_of_the_inria_viewer() {
    let gaussians = distinct(2, 1);
    let bytes = bytes(&gaussians);
    let names: Vec<_> = "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 f_rest_0 f_rest_1 f_rest_2 f_rest_3 f_rest_4 f_rest_5 \
        f_rest_6 f_rest_7 f_rest_8 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3"
        .split_whitespace()
        .collect();
    let properties: String = names.iter().map(|name| format!("property float {name}\n")).collect();
    let header =
        format!("ply\nformat binary_little_endian 1.0\nelement vertex 2\n{properties}end_header\n");
    assert!(bytes.starts_with(header.as_bytes()), "{}", String::from_utf8_lossy(&bytes));
    let values: Vec<f32> = bytemuck::pod_collect_to_vec(&bytes[header.len()..]);
    assert_eq!(values.len(), 2 * names.len());
    let second =
        |name: &str| values[names.len() + names.iter().position(|other| *other == name).unwrap()];
    assert_eq!(Vec3::new(second("x"), second("y"), second("z")), gaussians.means()[1]);
    assert_eq!(Vec3::new(second("nx"), second("ny"), second("nz")), Vec3::ZERO);
    // Channel-major: green starts after the three red coefficients.
    let coefficient = gaussians.rest()[3 + 2];
    assert_eq!(Vec3::new(second("f_rest_2"), second("f_rest_5"), second("f_rest_8")), coefficient);
    assert_eq!(second("opacity"), gaussians.raw_opacities()[1]);
    assert_eq!(second("rot_0"), gaussians.quats()[1][0]);
}

#[test]
fn unknown_properties_and_later_elements_are_skipped() {
    let gaussians = distinct(3, 0);
    let plain = bytes(&gaussians);
    let body = plain.windows(11).position(|window| window == b"end_header\n").unwrap() + 11;
    let header = std::str::from_utf8(&plain[..body]).unwrap();
    let header = header
        .replace(
            "property float opacity",
            "property uchar tag\nproperty double weight\nproperty float opacity",
        )
        .replace(
            "end_header",
            "comment by hand\nelement face 1\nproperty list uchar int vertex_indices\nend_header",
        );
    let mut extended = header.into_bytes();
    for vertex in plain[body..].chunks_exact(17 * 4) {
        extended.extend([&vertex[..9 * 4], &[9; 9], &vertex[9 * 4..]].concat());
    }
    extended.extend([3, 0, 0, 0, 0]);
    let dir = Folder::empty();
    dir.write("model.ply", extended);
    assert_eq!(ply::load(dir.join("model.ply")).unwrap(), gaussians);
}

#[test]
fn what_is_no_ply_or_of_another_format_is_refused_by_name() {
    for bytes in [&b"\x89PNG and so on end_header\n"[..], b""] {
        assert!(problem(bytes).contains("not a PLY"));
    }
    let plain = bytes(&distinct(2, 1));
    for length in [2, 3, 40, 300, plain.len() - 100, plain.len() - 1] {
        let problem = problem(&plain[..length]);
        assert!(problem.contains("model.ply"), "{length}: {problem}");
    }
    assert!(problem(&plain[..plain.len() - 1]).contains("truncated"));
}

#[test]
fn headers_that_disagree_with_the_file_or_name_other_properties_are_refused() {
    let plain = bytes(&distinct(2, 1));
    let huge = format!("vertex {}", usize::MAX);
    for (from, to, words) in [
        ("binary_little_endian", "ascii", ["ascii", "no text"]),
        ("binary_little_endian", "binary_big_endian", ["big_endian", "binary_little_endian"]),
        ("format binary_little_endian 1.0\n", "", ["format", ""]),
        ("vertex 2", "vertex 1", ["more than", ""]),
        ("vertex 2", "vertex 3", ["truncated", ""]),
        ("vertex 2", "vertex -1", ["vertex count", ""]),
        ("vertex 2", "vertex many", ["vertex count", ""]),
        ("vertex 2", &huge, ["absurd", ""]),
        ("vertex 2", "face 2", ["face", ""]),
        ("float opacity", "float opaqueness", ["opacity", ""]),
        ("float opacity", "int opacity", ["int", ""]),
        ("float opacity", "quad opacity", ["quad", ""]),
        ("float opacity", "float x", ["twice", ""]),
        ("float f_rest_8", "float other", ["8 f_rest", ""]),
        ("property float opacity", "property list uchar int opacity", ["list", ""]),
    ] {
        let problem = problem(&with_header(&plain, from, to));
        assert!(words.iter().all(|word| problem.contains(word)), "{to}: {problem}");
    }
}

#[test]
fn a_value_that_is_not_finite_is_refused_with_its_position() {
    let mut gaussians = distinct(4, 0);
    gaussians.log_scales_mut()[2].y = f32::NAN;
    let problem = problem(&bytes(&gaussians));
    says(&problem, &["vertex 2", "scale_1"]);
}

#[test]
fn a_missing_folder_is_named_and_no_file_is_left() {
    let dir = Folder::empty();
    let path = |name: &str| dir.join(name);
    let problem = ply::save(&distinct(1, 0), path("missing/model.ply")).unwrap_err();
    assert!(problem.to_string().contains("missing"), "{problem}");
    let problem = ply::load(path("model.ply")).unwrap_err();
    assert!(problem.to_string().contains("model.ply"), "{problem}");
    fs::create_dir(path("taken")).unwrap();
    assert!(ply::save(&distinct(1, 0), path("taken")).is_err());
    assert_eq!(fs::read_dir(&dir).unwrap().count(), 1, "a temporary file is left");
}
