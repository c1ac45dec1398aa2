//! COLMAP models written by scripts and newer versions.

use std::fs;

use nightsplat::camera::{CameraModel, KannalaBrandt};
use nightsplat::photographs::dataset::{Dataset, LoadOptions};
use serde_json::json;

use super::load;
use super::synthetic::*;

#[test]
fn images_with_one_line_each_are_all_read() {
    let folder = tempfile::tempdir().unwrap();
    photographs(folder.path(), "images", 0..9, 1.0);
    let place = folder.path().join("sparse/0");
    let mut written = model(9);
    written.images.iter_mut().for_each(|(.., name)| *name = name.replace(".png", " b.png"));
    (0..9).for_each(|index| {
        let images = folder.path().join("images");
        let name = name(index);
        fs::rename(images.join(format!("{name}.png")), images.join(format!("{name} b.png")))
            .unwrap();
    });
    written.write_text(&place);
    let text = fs::read_to_string(place.join("images.txt")).unwrap();
    for skip in ["1.5 2.5 -1", ""] {
        let lines: Vec<&str> =
            text.lines().filter(|line| *line != skip && !line.is_empty()).collect();
        fs::write(place.join("images.txt"), lines.join("\n")).unwrap();
        assert_eq!(load(folder.path()).views.len(), 9, "without `{skip}`");
    }
}

#[test]
fn sizes_may_be_written_as_floats_and_must_be_whole() {
    let folder = tempfile::tempdir().unwrap();
    photographs(folder.path(), "images", 0..9, 1.0);
    let place = folder.path().join("sparse/0");
    model(9).write_text(&place);
    let text = fs::read_to_string(place.join("cameras.txt")).unwrap();
    fs::write(place.join("cameras.txt"), text.replace(" 40 30 ", " 40.0 3e1 ")).unwrap();
    assert_eq!(load(folder.path()).views.len(), 9);
    for width in ["40.5", "-40", "NaN", "wide"] {
        fs::write(place.join("cameras.txt"), text.replace(" 40 ", &format!(" {width} "))).unwrap();
        let error = Dataset::load(folder.path(), &LoadOptions::default()).unwrap_err().to_string();
        assert!(error.contains("line 2 has no readable width"), "{error}");
    }
}

#[test]
fn fisheyes_without_distortion_stay_fisheyes() {
    let zeros = CameraModel::Fisheye(KannalaBrandt { coefficients: [0.0; 4] });
    for (name, number, parameters) in [
        ("SIMPLE_FISHEYE", 14, vec![35.0, 18.0, 16.0]),
        ("FISHEYE", 15, vec![35.0, 36.0, 18.0, 16.0]),
    ] {
        let folder = tempfile::tempdir().unwrap();
        photographs(folder.path(), "images", 0..9, 1.0);
        let written = Model { cameras: vec![(3, name, number, parameters)], ..model(9) };
        written.write_binary(&folder.path().join("sparse/0"));
        // Additional files of newer versions are not needed.
        fs::write(folder.path().join("sparse/0/rigs.bin"), [0; 8]).unwrap();
        fs::write(folder.path().join("sparse/0/frames.bin"), [0; 8]).unwrap();
        assert_eq!(load(folder.path()).views[0].camera.model, zeros, "{name}");
        fs::remove_dir_all(folder.path().join("sparse/0")).unwrap();
        written.write_text(&folder.path().join("sparse/0"));
        assert_eq!(load(folder.path()).views[0].camera.model, zeros, "{name}");
    }
}

#[test]
fn models_that_are_not_supported_are_named_with_their_remedy() {
    for (name, number, count, remedy) in [
        ("FOV", 7, 5, "image_undistorter"),
        ("THIN_PRISM_FISHEYE", 10, 12, "image_undistorter"),
        ("RAD_TAN_THIN_PRISM_FISHEYE", 11, 16, "image_undistorter"),
        ("SIMPLE_DIVISION", 12, 4, "image_undistorter"),
        ("DIVISION", 13, 5, "image_undistorter"),
        ("EUCM", 16, 6, "image_undistorter"),
        ("EQUIRECTANGULAR", 17, 2, "faces of a cube"),
    ] {
        let folder = tempfile::tempdir().unwrap();
        photographs(folder.path(), "images", 0..9, 1.0);
        let written = Model { cameras: vec![(3, name, number, vec![0.5; count])], ..model(9) };
        let place = folder.path().join("sparse/0");
        written.write_binary(&place);
        for is_text in [false, true] {
            if is_text {
                fs::remove_dir_all(&place).unwrap();
                written.write_text(&place);
            }
            let error = Dataset::load(folder.path(), &LoadOptions::default()).unwrap_err();
            let error = error.to_string();
            assert!(error.contains(name) && error.contains(remedy), "{error}");
        }
    }
    let folder = tempfile::tempdir().unwrap();
    photographs(folder.path(), "images", 0..3, 1.0);
    let frames = (0..3).map(|index| frame(index, &format!("images/{}", name(index)))).collect();
    let mut listing = transforms(frames);
    listing["camera_model"] = json!("EQUIRECTANGULAR");
    write_json(folder.path().join("transforms.json"), &listing);
    let error = Dataset::load(folder.path(), &LoadOptions::default()).unwrap_err().to_string();
    assert!(error.contains("EQUIRECTANGULAR") && error.contains("faces of a cube"), "{error}");
}
