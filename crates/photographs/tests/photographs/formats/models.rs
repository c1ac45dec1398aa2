//! COLMAP models written by scripts and newer versions.

use super::*;

#[test]
fn images_with_one_line_each_are_all_read() {
    let folder = Folder::with_text_model(&model(9));
    for index in 0..9 {
        let [from, to] = ["", " b"].map(|end| format!("images/{}{end}.png", name(index)));
        fs::rename(folder.join(from), folder.join(to)).unwrap();
    }
    let list = folder.join("sparse/0/images.txt");
    let text = fs::read_to_string(&list).unwrap().replace(".png", " b.png");
    for skip in ["1.5 2.5 -1", ""] {
        let lines = text.lines().filter(|line| *line != skip && !line.is_empty());
        fs::write(&list, lines.collect::<Vec<_>>().join("\n")).unwrap();
        assert_eq!(load(&folder).views.len(), 9, "without `{skip}`");
    }
}

#[test]
fn sizes_may_be_written_as_floats_and_must_be_whole() {
    let folder = Folder::with_text_model(&model(9));
    let cameras = folder.join("sparse/0/cameras.txt");
    let text = fs::read_to_string(&cameras).unwrap();
    fs::write(&cameras, text.replace(" 40 30 ", " 40.0 3e1 ")).unwrap();
    assert_eq!(load(&folder).views.len(), 9);
    for width in ["40.5", "-40", "NaN", "wide"] {
        fs::write(&cameras, text.replace(" 40 ", &format!(" {width} "))).unwrap();
        refuses(&folder, &["line 2 has no readable width"]);
    }
}

#[test]
fn fisheyes_without_distortion_stay_fisheyes() {
    let zeros = CameraModel::Fisheye(KannalaBrandt { coefficients: [0.0; 4] });
    for (name, number, parameters) in [
        ("SIMPLE_FISHEYE", 14, vec![35.0, 18.0, 16.0]),
        ("FISHEYE", 15, vec![35.0, 36.0, 18.0, 16.0]),
    ] {
        let written = Model { cameras: vec![(3, name, number, parameters)], ..model(9) };
        for folder in Folder::with_either_model(&written) {
            // Additional files of newer versions are not needed.
            fs::write(folder.join("sparse/0/rigs.bin"), [0; 8]).unwrap();
            fs::write(folder.join("sparse/0/frames.bin"), [0; 8]).unwrap();
            assert_eq!(load(&folder).views[0].camera.model, zeros, "{name}");
        }
    }
}
