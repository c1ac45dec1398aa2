//! Keys of a listing other than names and poses: points, masks, depth, splits, bad frames; and matrices as written by
//! exporters.

use nightsplat_photographs::dataset::DepthOptions;
use serde::Serialize;

use super::*;

const POINTS: [[f32; 3]; 4] =
    [[0.5, 0.0, 0.25], [-0.5, 0.25, 0.0], [0.0, 0.5, -0.25], [0.125, 0.0, 0.5]];

fn write_points(path: &Path, points: &[[f32; 3]]) {
    let mut text = format!(
        "ply\nformat ascii 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\nend_header\n",
        points.len()
    );
    points.iter().for_each(|[x, y, z]| text += &format!("{x} {y} {z}\n"));
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    fs::write(path, text).unwrap();
}

fn positions(dataset: &Dataset) -> Vec<DVec3> {
    dataset.points.iter().map(|point| point.position).collect()
}

fn expected() -> Vec<DVec3> {
    POINTS.map(|point| point.map(f64::from).into()).to_vec()
}

#[test]
fn points_of_a_ply_are_read_from_the_listed_or_usual_place() {
    for (file, key) in [
        ("clouds/mine.ply", Some("./clouds/mine.ply")),
        ("mine.ply", Some("C:\\scan\\mine.ply")),
        ("points3d.ply", None),
        ("sparse_pc.ply", None),
    ] {
        let folder = Folder::with_listing(9, |listing| {
            if let Some(key) = key {
                listing["ply_file_path"] = json!(key);
            }
        });
        write_points(&folder.join(file), &POINTS);
        assert_eq!(positions(&load(&folder)), expected(), "{file}");
    }
    let folder = Folder::with_text_model(&model(9));
    fs::remove_file(folder.join("sparse/0/points3D.txt")).unwrap();
    write_points(&folder.join("sparse/0/points3D.ply"), &POINTS);
    assert_eq!(positions(&load(&folder)), expected());
}

#[test]
fn the_applied_transform_of_a_listing_is_applied_to_points_that_lack_it() {
    let away = [[100.0, 0.0, 0.0], [101.0, 0.25, 0.0], [100.5, 0.5, 0.0], [100.0, 0.0, 0.5]];
    let applied = json!([[1.0, 0.0, 0.0, -100.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]]);
    for (points, shift) in [(away, -100.0), (POINTS, 0.0)] {
        let folder = Folder::with_listing(9, |listing| {
            listing["ply_file_path"] = json!("sparse_pc.ply");
            listing["applied_transform"] = applied.clone();
        });
        write_points(&folder.join("sparse_pc.ply"), &points);
        let expected = points.map(|[x, y, z]| DVec3::new(f64::from(x) + shift, y.into(), z.into()));
        assert_eq!(positions(&load(&folder)), expected);
    }
}

#[test]
fn an_unsupported_file_of_points_is_named() {
    let folder = Folder::with_listing(9, |listing| listing["ply_file_path"] = json!("absent.ply"));
    fs::write(folder.join("scan.las"), "LASF").unwrap();
    fs::write(folder.join("points3d.ply"), "no ply").unwrap();
    let lines = warnings(|| drop(load(&folder)));
    says(
        &lines,
        &[
            "absent.ply, its ply_file_path, is absent",
            "points3d.ply: is not a PLY file",
            "points3d.ply: is not read",
        ],
    );
}

/// A mask that keeps the left half.
fn left_half(path: &Path, is_inverted: bool) {
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    let shown = |x: u32| if (x < SIZE.0 / 2) == is_inverted { 0.0 } else { 1.0 };
    Image::from_fn(SIZE.0, SIZE.1, |x, _| [shown(x); 3]).save_png8(path).unwrap();
}

#[test]
fn listed_masks_are_applied_and_dynamic_masks_inverted() {
    let hidden = |dataset: &Dataset, name: &str| {
        view(dataset, name).mask.as_ref().map(|mask| (mask.weights[0], mask.weights[39]))
    };
    let root = &Folder::with_listing(9, |listing| {
        listing["frames"][1]["mask_path"] = json!("segmentation\\one.png");
        listing["frames"][2]["mask_path"] = json!("/home/user/scan/masks_2/two.png");
        listing["frames"][3]["mask_path"] = json!("absent.png");
    });
    left_half(&root.join("segmentation/one.png"), false);
    left_half(&root.join("masks_2/two.png"), false);
    left_half(&root.join("images/dynamic_mask_v04.png"), true);
    let lines = warnings(|| {
        let dataset = load(root);
        for name in ["v01", "v02", "v04"] {
            assert_eq!(hidden(&dataset, name), Some((1.0, 0.0)), "{name}");
        }
        assert_eq!(hidden(&dataset, "v03"), None);
        assert_eq!(dataset.views.len(), 9);
        let options = LoadOptions { invert_masks: true, ..Default::default() };
        assert_eq!(hidden(&load_with(root, options), "v04"), Some((0.0, 1.0)));
    });
    says(&lines, &["1 mask files that it names are absent, absent.png the first"]);
}

#[test]
fn listed_depth_maps_belong_to_their_views() {
    for key in ["depth_file_path", "depth_path"] {
        let folder =
            Folder::with_listing(9, |listing| listing["frames"][1][key] = json!("range/d1.png"));
        let path = folder.join("range/d1.png");
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        Image::from_fn(SIZE.0, SIZE.1, |x, _| [0.01 * x as f32; 3]).save_png8(path).unwrap();
        let depth = DepthOptions { load: true, ..DepthOptions::default() };
        let dataset = load_with(&folder, LoadOptions { depth, ..Default::default() });
        let depth = view(&dataset, "v01").depth.as_ref().unwrap();
        assert!(depth[0] < depth[39] && view(&dataset, "v02").depth.is_none());
    }
}

#[test]
fn stated_splits_are_kept_and_bad_or_unlisted_frames_left_out() {
    let names_of = |views: std::ops::Range<usize>| -> Vec<String> {
        views.map(|index| format!("./images/{}.png", name(index))).collect()
    };
    let folder = Folder::with_listing(9, |listing| {
        listing["train_filenames"] = json!(names_of(0..5));
        listing["val_filenames"] = json!(names_of(5..6));
        listing["test_filenames"] = json!(names_of(6..8));
    });
    let dataset = load(&folder);
    assert_eq!(names(&dataset, Split::Train), ["v00", "v01", "v02", "v03", "v04"]);
    assert_eq!(names(&dataset, Split::Test), ["v06", "v07"]);
    let lines = warnings(|| drop(load(&folder)));
    says(&lines, &["2 frames are in none of its lists"]);

    let folder = Folder::with_listing(9, |listing| {
        let all = listing["frames"].as_array().unwrap().clone();
        listing["frames"] = json!(all[..6]);
        listing["test_frames"] = json!(all[6..]);
        listing["frames"][2]["is_bad"] = json!(true);
        listing["frames"][3]["is_bad"] = json!(false);
        listing["test_frames"][0]["is_bad"] = json!(1);
    });
    let dataset = load(&folder);
    assert_eq!(names(&dataset, Split::Train), ["v00", "v01", "v03", "v04", "v05"]);
    assert_eq!(names(&dataset, Split::Test), ["v07", "v08"]);
    let lines = warnings(|| drop(load(&folder)));
    says(&lines, &["2 frames are marked bad"]);

    let folder = Folder::with_listing(9, |listing| {
        for (index, split) in ["train", "test", "val"].into_iter().enumerate() {
            listing["frames"][index]["split"] = json!(split);
        }
    });
    let dataset = load(&folder);
    assert!(names(&dataset, Split::Test).starts_with(&["v01", "v02"]));
    assert!(names(&dataset, Split::Train).contains(&"v00"));
}

#[test]
fn keys_that_are_not_supported_are_named_in_one_line() {
    let folder = Folder::with_listing(9, |listing| {
        listing["semantics_file"] = json!("classes.json");
        listing["k5"] = json!(0.0);
        listing["rolling_shutter"] = json!([0.0, 0.1]);
        for index in 0..9 {
            listing["frames"][index]["normal_path"] = json!(format!("normals/{index}.png"));
            listing["frames"][index]["colmap_im_id"] = json!(index);
        }
    });
    let lines = warnings(|| drop(load(&folder)));
    assert_eq!(lines.lines().count(), 1, "{lines}");
    says(
        &lines,
        &[
            "normal_path (9 times, normals/0.png the first), rolling_shutter ([0.0,0.1]), semantics_file \
             (classes.json)",
        ],
    );
}

/// Changes the matrix of every frame.
fn with_matrices<T: Serialize>(change: impl Fn([[f64; 4]; 4]) -> T) -> Folder {
    Folder::with_listing(9, |listing| {
        for frame in listing["frames"].as_array_mut().unwrap() {
            let matrix = serde_json::from_value(frame["transform_matrix"].clone()).unwrap();
            frame["transform_matrix"] = json!(change(matrix));
        }
    })
}

#[test]
fn scaled_rounded_and_transposed_matrices_are_read_with_a_remark() {
    // The values of a matrix may be a flat list.
    let dataset = load(&with_matrices(|rows| rows.concat()));
    (0..9).for_each(|index| assert_camera_is_view(&dataset.views[index], index));

    type Change = fn([[f64; 4]; 4]) -> [[f64; 4]; 4];
    let cases: [(&str, Change); 2] = [
        ("hold a scale (9 of them, 0.2500 the last)", |mut matrix| {
            let rotated = matrix[..3].iter_mut().flat_map(|row| &mut row[..3]);
            rotated.for_each(|entry| *entry *= 0.25);
            matrix
        }),
        ("are transposed", |matrix| std::array::from_fn(|row| matrix.map(|other| other[row]))),
    ];
    for (expected, change) in cases {
        let folder = with_matrices(change);
        let lines = warnings(|| {
            let dataset = load(&folder);
            (0..9).for_each(|index| assert_camera_is_view(&dataset.views[index], index));
        });
        assert!(lines.contains(expected), "{lines}");
    }
    let folder = with_matrices(|matrix| {
        matrix.map(|row| row.map(|entry| (entry * 1000.0).round() / 1000.0))
    });
    let dataset = load(&folder);
    assert_eq!(dataset.views.len(), 9);
    for (index, view) in dataset.views.iter().enumerate() {
        let view_from_world = view.camera.view_from_world;
        assert!(view_from_world.abs_diff_eq(pose(index), 5e-3));
        let rotation = view_from_world.matrix3.transpose() * view_from_world.matrix3;
        assert!(rotation.abs_diff_eq(DMat3::IDENTITY, 1e-9));
    }
}

#[test]
fn left_handed_matrices_are_refused_by_that_name() {
    let folder = with_matrices(|mut matrix| {
        matrix[0] = matrix[0].map(|entry| -entry);
        matrix
    });
    refuses(&folder, &["v00.png: its transform_matrix is left-handed"]);
}

#[test]
fn a_frames_own_camera_model_overrides() {
    let folder = Folder::with_listing(9, |listing| {
        listing["frames"][1]["camera_model"] = json!("OPENCV_FISHEYE");
        listing["frames"][1]["k1"] = json!(0.01);
        listing["frames"][2]["fl_x"] = json!(50.0);
    });
    let dataset = load(&folder);
    let model = |name: &str| view(&dataset, name).camera.model;
    assert!(model("v01") != model("v00") && model("v02") == model("v00"));
    assert_eq!(view(&dataset, "v02").camera.focal.x, 50.0);
}
