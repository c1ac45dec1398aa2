//! Output of COLMAP and other tools: several models, photographs without a pose, rigs, byte-order marks, real lenses.

use nightsplat_core::camera::Camera;

use super::*;

#[test]
fn of_several_models_the_one_with_the_most_photographs_is_used_and_named() {
    let root = &Folder::empty();
    photographs(root, "images", 0..9, 1.0);
    model(2).write_binary(&root.join("sparse/0"));
    model(9).write_binary(&root.join("sparse/1"));
    // More poses, of missing photographs.
    let mut absent = model(20);
    absent.images.iter_mut().for_each(|image| image.3 = format!("absent/{}", image.3));
    absent.write_text(&root.join("sparse/2"));
    let message = warnings(|| {
        let dataset = load(root);
        assert_eq!(dataset.views.len(), 9);
        assert_eq!(dataset.points.len(), 20);
        assert!(dataset.points[0].views.len() > 2);
    });
    says(&message, &["3 models, of 2, 9, 0 photographs; sparse/1, the largest"]);
}

#[test]
fn photographs_without_a_pose_and_files_that_are_not_read_are_counted() {
    let root = &Folder::empty();
    photographs(root, "images", 0..9, 1.0);
    model(3).write_text(&root.join("sparse/0"));
    fs::write(root.join("images/IMG_1.HEIC"), "").unwrap();
    fs::write(root.join("images/clip.mp4"), "").unwrap();
    fs::write(root.join("images/notes.txt"), "").unwrap();
    let message = warnings(|| drop(load(root)));
    let parts = [
        "6 of 9 photographs have no pose",
        "v03.png the first",
        "`nightsplat pose`",
        "1 .heic, 1 .mp4",
        "heif-convert",
    ];
    assert!(
        parts.iter().all(|part| message.contains(part)) && !message.contains("txt"),
        "{message}"
    );
    // If all have one, there is no remark.
    model(9).write_text(&root.join("sparse/0"));
    fs::remove_file(root.join("images/IMG_1.HEIC")).unwrap();
    fs::remove_file(root.join("images/clip.mp4")).unwrap();
    assert_eq!(warnings(|| drop(load(root))), "");
}

#[test]
fn the_cameras_of_a_rig_may_have_equal_file_names() {
    let root = &Folder::empty();
    let mut rig = model(8);
    for (index, image) in rig.images.iter_mut().rev().enumerate() {
        image.3 = format!("{}/{:03}.png", ["a", "b"][index % 2], index / 2);
        photograph(&root.join("images").join(&image.3), SIZE, dark(index));
    }
    rig.write_binary(&root.join("sparse/0"));
    fs::write(root.join("test.txt"), "a/001.png\nb_003\n").unwrap();
    let dataset = load(root);
    let all: Vec<&str> = dataset.views.iter().map(|view| view.name.as_str()).collect();
    assert_eq!(all, ["a_000", "a_001", "a_002", "a_003", "b_000", "b_001", "b_002", "b_003"]);
    assert_eq!(names(&dataset, Split::Test), ["a_001", "b_003"]);
    let level = |name: &str| level(view(&dataset, name).image.as_ref()).unwrap();
    assert_eq!([level("a_000"), level("b_000"), level("a_001")], [10.0, 11.0, 12.0]);
    assert!(dataset.points.iter().any(|point| point.views.len() > 2));
    // The same names in one listing of a transforms file.
    fs::remove_dir_all(root.join("sparse")).unwrap();
    let listed = |index: usize| format!("images/{}/{:03}", ["a", "b"][index % 2], index / 2);
    let frames = (0..8).map(|index| frame(index, &listed(index))).collect();
    write_json(root.join("transforms.json"), &transforms(frames));
    assert_eq!(load(root).views[5].name, "b_001");
}

#[test]
fn a_byte_order_mark_changes_nothing() {
    let root = &Folder::with_text_model(&model(9));
    fs::write(root.join("test.txt"), "v03\n").unwrap();
    let plain = load(root);
    let files =
        ["sparse/0/cameras.txt", "sparse/0/images.txt", "sparse/0/points3D.txt", "test.txt"];
    let texts = files.map(|file| fs::read_to_string(root.join(file)).unwrap());
    let utf8 = |text: &str| [b"\xEF\xBB\xBF", text.as_bytes()].concat();
    let little = |text: &str| {
        format!("\u{feff}{text}").encode_utf16().flat_map(u16::to_le_bytes).collect::<Vec<u8>>()
    };
    let big = |text: &str| {
        format!("\u{feff}{text}").encode_utf16().flat_map(u16::to_be_bytes).collect::<Vec<u8>>()
    };
    for encode in [&utf8 as &dyn Fn(&str) -> Vec<u8>, &little, &big] {
        for (file, text) in files.iter().zip(&texts) {
            fs::write(root.join(file), encode(text)).unwrap();
        }
        let marked = load(root);
        assert_eq!(names(&marked, Split::Test), ["v03"]);
        assert_eq!(marked.points, plain.points);
        assert!(marked.views.iter().zip(&plain.views).all(|(a, b)| a.camera == b.camera));
    }
}

#[test]
fn a_rational_lens_is_undistorted_on_load_and_a_fisheye_on_request() {
    let center = [20.0, 15.0];
    let lenses = [
        ("FULL_OPENCV", 6, vec![0.1, 0.01, 0.001, 0.0, 0.003, 0.02, 0.0, 0.0]),
        ("OPENCV_FISHEYE", 5, vec![0.03, -0.01, 0.002, 0.0]),
        ("SIMPLE_RADIAL_FISHEYE", 8, vec![0.02]),
        ("RADIAL_FISHEYE", 9, vec![0.02, -0.01]),
    ];
    for (name, number, coefficients) in lenses {
        let focal = if name.contains("OPENCV") { vec![22.0, 22.0] } else { vec![22.0] };
        let parameters = [focal, center.to_vec(), coefficients.clone()].concat();
        let lens = Model { cameras: vec![(3, name, number, parameters)], ..model(9) };
        let [binary, text] = Folder::with_either_model(&lens).map(|folder| undistorted(&folder));
        let camera = binary.views[0].camera;
        assert_eq!(camera.model, CameraModel::Pinhole, "{name}");
        assert!(camera.focal.is_finite() && camera.focal.x != 22.0, "{name}: {camera:?}");
        // No blank pixel: every photograph has a single colour.
        assert_eq!(level(view(&binary, "v04").image.as_ref()), Some(14.0), "{name}");
        assert_eq!(text.views[0].camera, camera, "{name}");
    }
}

fn undistorted(root: &Path) -> Dataset {
    load_with(root, LoadOptions { undistort: true, ..Default::default() })
}

#[test]
fn a_fisheye_is_loaded_natively_from_every_listing_and_masked_outside_its_circle() {
    let [fx, fy, cx, cy, k1, k2, k3, k4] = [15.0, 15.5, 21.0, 14.0, 0.03, -0.01, 0.002, -0.0005];
    let coefficients = [k1, k2, k3, k4];
    let parameters = vec![fx, fy, cx, cy, k1, k2, k3, k4];
    let model = Model { cameras: vec![(3, "OPENCV_FISHEYE", 5, parameters)], ..model(9) };
    let [binary, text] = Folder::with_either_model(&model).map(|folder| load(&folder));
    let lens = json!({
        "camera_model": "OPENCV_FISHEYE", "fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy,
        "k1": k1, "k2": k2, "k3": k3, "k4": k4,
    });
    let root = &Folder::with_listing(9, |listing| extend(listing, &lens));
    let lens = KannalaBrandt { coefficients };
    let reach = lens.radius(lens.largest_angle());
    for dataset in [binary, text, load(root)] {
        let view = view(&dataset, "v04");
        let Camera { focal, principal_point, model, .. } = view.camera;
        assert_eq!(model, CameraModel::Fisheye(lens));
        assert_eq!((focal, principal_point), (DVec2::new(fx, fy), DVec2::new(cx, cy)));
        let mask = view.mask.as_ref().unwrap();
        for (at, &weight) in mask.weights.iter().enumerate() {
            let corner = DVec2::new((at % 40) as f64, (at / 40) as f64);
            let corners = [DVec2::ZERO, DVec2::X, DVec2::Y, DVec2::ONE].map(|by| corner + by);
            let is_seen =
                corners.iter().all(|at| ((at - principal_point) / focal).length() < reach);
            assert_eq!(weight, f32::from(is_seen), "pixel {corner}");
        }
    }
    // For resized photographs, the mask is that of the resized pixels.
    let shrunk = LoadOptions { downscale: 1.25, ..Default::default() };
    let shrunk = load_with(root, shrunk);
    let (camera, mask) = (shrunk.views[0].camera, shrunk.views[0].mask.as_ref().unwrap());
    assert_eq!((camera.focal.x, mask.width, mask.height), (0.8 * fx, 32, 24));
    assert_eq!(mask.hidden(), camera.unseen());
    // A polynomial that falls from 5 degrees on is not a lens.
    let keys = json!({ "camera_model": "OPENCV_FISHEYE", "k1": -40.0 });
    refuses_listing(|listing| extend(listing, &keys), &["describe no lens"]);
}

#[test]
fn the_part_of_a_fisheye_beyond_a_pinhole_is_cropped_with_a_remark() {
    let lens = json!({
        "camera_model": "OPENCV_FISHEYE", "fl_x": 16.0, "fl_y": 16.0, "cx": 20.0, "cy": 15.0, "k1": 0.01,
    });
    let root = &Folder::with_listing(9, |listing| extend(listing, &lens));
    let mut camera = None;
    let message = warnings(|| camera = Some(undistorted(root).views[0].camera));
    let camera = camera.unwrap();
    let corner = (DVec2::new(0.5, 0.5) - camera.principal_point) / camera.focal;
    assert!((corner.length().atan().to_degrees() - 60.0).abs() < 0.01, "{camera:?}");
    says(&message, &["fisheye", "60 degrees"]);
}
