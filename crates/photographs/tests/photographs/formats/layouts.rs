//! Folders as left by tools, and listings from another machine.

use super::*;

/// Nine views, each with its photograph and camera, and the points of the model.
fn assert_whole(dataset: &Dataset, what: &str) {
    assert_eq!(dataset.views.len(), 9, "{what}: {:?}", dataset.skipped);
    assert!(dataset.skipped.is_empty(), "{what}: {:?}", dataset.skipped);
    for (index, view) in dataset.views.iter().enumerate() {
        assert_camera_is_view(view, index);
        assert_eq!(level(view.image.as_ref()), Some(10.0 + index as f32), "{what}");
    }
    assert_eq!(dataset.points.len(), 20, "{what}");
    assert_eq!(dataset.points[1].views, [2, 5, 8], "{what}");
}

#[test]
fn a_model_and_its_photographs_are_found_in_the_folders_of_tools() {
    for (images, model_folder) in [
        ("images", ""),
        ("", ""),
        ("", "sparse/0"),
        ("input", "sparse/0"),
        ("input", "distorted/sparse/0"),
        ("images", "model"),
        ("rgb", "colmap/sparse"),
        ("data/photos", "sparse"),
    ] {
        let folder = Folder::empty();
        photographs(&folder, images, 0..9, 1.0);
        model(9).write_binary(&folder.join(model_folder));
        assert_whole(&load(&folder), &format!("{images}, {model_folder}"));
    }
}

#[test]
fn the_files_of_a_model_are_found_in_any_case() {
    let folder = Folder::with_text_model(&model(9));
    let sparse = folder.join("sparse/0");
    for (from, to) in [("cameras", "Cameras"), ("images", "IMAGES"), ("points3D", "points3d")] {
        fs::rename(sparse.join(from).with_extension("txt"), sparse.join(to).with_extension("TXT"))
            .unwrap();
    }
    assert_whole(&load(&folder), "in other case");
    // What has the exact name comes first.
    fs::write(sparse.join("cameras.txt"), "3 PINHOLE 40 30 1 2 3\n").unwrap();
    refuses(&folder, &["cameras.txt"]);
}

#[test]
fn every_eighth_photograph_that_is_there_is_held_out_and_none_of_seven() {
    let folder = Folder::with_model(&model(9));
    assert_eq!(names(&load(&folder), Split::Test), ["v00", "v08"]);
    fs::remove_file(folder.join("images/v00.png")).unwrap();
    let dataset = load(&folder);
    assert_eq!(names(&dataset, Split::Test), ["v01"]);
    assert_eq!(dataset.skipped, ["images/v00.png: the file is absent"]);
    fs::remove_file(folder.join("images/v08.png")).unwrap();
    let dataset = load(&folder);
    assert_eq!((dataset.views.len(), names(&dataset, Split::Test).len()), (7, 0));
    let dataset = load_with(&folder, LoadOptions { test_every: Some(3), ..Default::default() });
    assert_eq!(names(&dataset, Split::Test), ["v01", "v04", "v07"]);
}

#[test]
fn masks_of_labels_are_told_and_black_ones_named() {
    let folder = Folder::with_model(&model(9));
    fs::create_dir_all(folder.join("masks")).unwrap();
    let save = |index: usize, white: f32| {
        let image = Image::from_fn(SIZE.0, SIZE.1, |x, _| [if x < 20 { white } else { 0.0 }; 3]);
        image.save_png8(folder.join(format!("masks/{}.png", name(index)))).unwrap();
    };
    (0..9).for_each(|index| save(index, 1.0 / 255.0));
    let lines = warnings(|| {
        for view in &load(&folder).views {
            assert_eq!(view.mask.as_ref().unwrap().weights[18..22], [1.0, 1.0, 0.0, 0.0]);
        }
    });
    says(&lines, &["they are labels, of which 1 shows"]);
    (0..9).for_each(|index| save(index, f32::from(index != 3)));
    let dataset = load(&folder);
    assert_eq!(dataset.skipped.len(), 1);
    let black = "masks/v03.png: the mask is black everywhere";
    assert!(dataset.skipped[0].contains(black), "{:?}", dataset.skipped);
}

#[test]
fn cameras_of_a_network_s_input_are_scaled_for_each_axis() {
    // 500x375, as VGGT resizes it: a width of 518, and a height rounded to patches of 14.
    let of_input = |height: f64| {
        let lens = json!({ "w": 518.0, "h": height, "fl_x": 518.0, "fl_y": 392.0 });
        let folder = Folder::with_listing(9, |listing| extend(listing, &lens));
        photographs_of_size(&folder, "images", 0..9, (500, 375), 1.0);
        folder
    };
    let lines = warnings(|| {
        let camera = load(&of_input(392.0)).views[0].camera;
        assert_eq!((camera.width, camera.height), (500, 375));
        assert!((camera.focal - DVec2::new(500.0, 375.0)).length() < 1e-9, "{camera:?}");
    });
    says(&lines, &["9 cameras are of a network's input"]);
    refuses(&of_input(518.0), &["its camera is 518x518", "padded or cropped"]);
}

#[test]
fn a_path_of_a_model_or_listing_names_its_dataset() {
    let folder = Folder::empty();
    photographs(&folder, "images", 0..9, 1.0);
    for folder_of_model in ["sparse/0", "sparse/1"] {
        model(9).write_binary(&folder.join(folder_of_model));
    }
    // One camera of the other model is elsewhere.
    let mut other = model(9);
    other.points.truncate(7);
    other.write_text(&folder.join("sparse/1"));
    for file in ["cameras.bin", "images.bin", "points3D.bin"] {
        fs::remove_file(folder.join("sparse/1").join(file)).unwrap();
    }
    assert_whole(&load(&folder.join("sparse/0")), "sparse/0");
    assert_eq!(load(&folder.join("sparse/1")).points.len(), 7);

    let folder = Folder::empty();
    lom(&folder, 9, &[2]);
    let dataset = load(&folder.join("transforms_train.json"));
    assert_eq!(names(&dataset, Split::Test), ["v02"]);
}

#[test]
fn downscaled_copies_scale_the_camera_and_the_largest_is_used() {
    let folder = Folder::empty();
    for (name, size) in [("images_4", (24, 18)), ("images_2", (32, 24))] {
        photographs_of_size(&folder, name, 0..9, size, 1.0);
    }
    model(9).write_binary(&folder.join("sparse/0"));
    let lines = warnings(|| {
        let dataset = load(&folder);
        let camera = view(&dataset, "v01").camera;
        assert_eq!((camera.width, camera.height), (32, 24));
        assert!((camera.focal.x - 0.8 * FOCAL.x).abs() < 1e-9);
    });
    assert_eq!(lines.lines().count(), 1, "{lines}");
    says(&lines, &["those of the same names in images_2 are taken"]);

    let images = Some(folder.join("images_4"));
    let dataset = load_with(&folder, LoadOptions { images, ..Default::default() });
    assert_eq!(view(&dataset, "v01").camera.width, 24, "where it is named, that is read");
}

#[test]
fn the_photographs_are_read_from_a_given_folder() {
    let folder = Folder::empty();
    let root = folder.join("set");
    photographs(&root, "images", 0..9, 4.0);
    photographs(&folder, "mine", 0..9, 1.0);
    model(9).write_binary(&root.join("sparse/0"));
    let images = Some(folder.join("mine"));
    let options = LoadOptions { images, ..Default::default() };
    assert_whole(&load_with(&root, options), "--images");
    let images = Some(folder.join("absent"));
    let options = LoadOptions { images, ..Default::default() };
    assert!(Dataset::load(&root, &options).unwrap_err().to_string().contains("absent"));
}

#[test]
fn of_two_folders_with_the_names_none_is_guessed() {
    let folder = Folder::empty();
    photographs(&folder, "monday", 0..9, 1.0);
    photographs(&folder, "tuesday", 0..9, 1.0);
    model(9).write_binary(&folder.join("sparse/0"));
    refuses(&folder, &["monday and tuesday hold files of their names", "--images"]);
}

#[test]
fn paths_of_another_machine_are_resolved_by_name_with_one_remark() {
    for before in [
        "/home/user/scan/images/",
        "C:\\Users\\user\\scan\\images\\",
        "./..\\datasets\\scan\\images/",
        "../elsewhere/",
        "input/",
        "scan/deep/er/",
    ] {
        for is_json in [true, false] {
            let folder = Folder::empty();
            photographs(&folder, "images", 0..9, 1.0);
            let path = |index: usize| format!("{before}{}.png", name(index));
            let mut written = model(9);
            if is_json {
                let frames = (0..9).map(|index| frame(index, &path(index)));
                write_json(folder.join("transforms.json"), &transforms(frames.collect()));
                written.write_binary(&folder.join("colmap/sparse/0"));
            } else {
                written.images.iter_mut().for_each(|(.., name)| *name = format!("{before}{name}"));
                written.write_text(&folder.join("sparse/0"));
            }
            let lines = warnings(|| assert_whole(&load(&folder), before));
            assert_eq!(lines.lines().count(), 1, "{before}: {lines}");
            says(&lines, &["9 of its photographs are not where it lists them"]);
        }
    }
}

#[test]
fn paths_of_a_rig_on_another_machine_keep_their_folders() {
    let folder = Folder::empty();
    for camera in ["left", "right"] {
        photographs(&folder, &format!("images/{camera}"), 0..4, 1.0);
    }
    let path = |camera: &str, index: usize| format!("D:\\rig\\{camera}\\{}.png", name(index));
    let frames = (0..4).map(|index| frame(index, &path("left", index)));
    let frames = frames.chain((0..4).map(|index| frame(index + 4, &path("right", index))));
    write_json(folder.join("transforms.json"), &transforms(frames.collect()));
    let dataset = load(&folder);
    assert_eq!(dataset.views.len(), 8);
    assert_camera_is_view(view(&dataset, "right_v01"), 5);
}

#[test]
fn withheld_test_photographs_are_not_searched_elsewhere() {
    let folder = Folder::empty();
    photographs(&folder, "train", 0..8, 1.0);
    photographs(&folder, "elsewhere", 0..8, 1.0);
    write_json(folder.join("transforms_train.json"), &listed("train", 0..6, ""));
    write_json(folder.join("transforms_test.json"), &listed("test", 6..8, ""));
    let dataset = load(&folder);
    assert!(dataset.test_views().all(|view| view.image.is_none() && view.reference.is_none()));
}

#[test]
fn splits_may_contain_equal_names() {
    let root = &Folder::empty();
    for (split, views) in [("train", 0..5), ("val", 5..7), ("test", 7..9)] {
        let frames = views.clone().enumerate().map(|(k, index)| {
            photograph(&root.join(split).join(format!("r_{k}.png")), SIZE, dark(index));
            frame(index, &format!("./{split}/r_{k}"))
        });
        let listing = json!({ "camera_angle_x": 1.0, "frames": frames.collect::<Vec<_>>() });
        write_json(root.join(format!("transforms_{split}.json")), &listing);
    }
    let dataset = load(root);
    assert_eq!(names(&dataset, Split::Test), ["test_r_0", "test_r_1"]);
    assert_eq!(names(&dataset, Split::Train).len(), 5);
    assert!(names(&dataset, Split::Train).contains(&"train_r_1"));
}

#[test]
fn names_are_compared_in_normalised_unicode() {
    let (composed, decomposed) = ("K\u{fc}che", "Ku\u{308}che");
    for (on_disk, listed) in [(composed, decomposed), (decomposed, composed)] {
        let folder = Folder::empty();
        let path = |name: &str, index: usize| format!("{name} {index}.png");
        for index in 0..9 {
            let file = folder.join("images").join(path(on_disk, index));
            photograph(&file, SIZE, dark(index));
        }
        let mut written = model(9);
        for (.., name) in &mut written.images {
            let index: usize = name[1..3].parse().unwrap();
            *name = path(listed, index);
        }
        written.write_binary(&folder.join("sparse/0"));
        fs::write(folder.join("test.txt"), path(on_disk, 3)).unwrap();
        let dataset = load(&folder);
        assert_whole(&dataset, on_disk);
        assert_eq!(names(&dataset, Split::Test), [format!("{composed} 3")]);
    }
}

#[test]
fn hidden_files_are_not_photographs() {
    let folder = Folder::with_model(&model(9));
    for index in 0..9 {
        let name = format!("images/._{}.png", name(index));
        folder.write(&name, b"\0\x05\x16\x07Mac OS X");
    }
    folder.write("images/._a.heic", "x");
    let lines = warnings(|| assert_whole(&load(&folder), "dot files"));
    assert_eq!(lines, "");
}

#[test]
fn an_archive_is_read_in_place() {
    let (folder, set) = (Folder::empty(), Folder::with_model(&model(9)));
    let (root, zip) = (&*set, folder.join("set.zip"));
    for prefix in ["", "scan/"] {
        pack(root, &zip, prefix);
        assert_whole(&load(&zip), prefix);
    }
    // Also photographs that are read again.
    let dataset = load_with(&zip, LoadOptions { keep: Some(0), ..Default::default() });
    let image = dataset.views[3].loaded().unwrap();
    assert_eq!(level(image.as_deref()), Some(13.0));
    assert_eq!(fs::read_dir(&folder).unwrap().count(), 1, "something was unpacked");
    // Listed files outside the archive are not read.
    let outside = folder.join("outside.png");
    Image::filled(SIZE.0, SIZE.1, [0.1; 3]).save_png8(&outside).unwrap();
    let listing = transforms(vec![
        frame(0, outside.to_str().unwrap()),
        frame(1, "../outside.png"),
        frame(2, "images/v02.png"),
    ]);
    write_json(root.join("transforms.json"), &listing);
    pack(root, &zip, "");
    let dataset = load_with(&zip, LoadOptions { test_every: Some(0), ..Default::default() });
    assert_eq!(names(&dataset, Split::Train), ["v02"]);

    fs::write(&zip, "no archive").unwrap();
    refuses(&zip, &["set.zip: cannot be read"]);
}

#[test]
fn a_dataset_below_or_above_is_named() {
    let folder = Folder::empty();
    let root = folder.join("a/scan");
    photographs(&root, "images", 0..9, 1.0);
    model(9).write_binary(&root.join("sparse/0"));
    for (given, named) in [(folder.to_owned(), "a/scan does"), (root.join("images"), "scan does")] {
        refuses(&given, &[named, "name that"]);
    }
}

#[test]
fn black_borders_of_undistorted_photographs_are_masked_but_not_those_of_a_dark_scene() {
    let folder = Folder::empty();
    model(9).write_binary(&folder.join("sparse/0"));
    circles(&folder, 20.0);
    let lines = warnings(|| {
        for view in &load(&folder).views {
            let mask = view.mask.as_ref().unwrap();
            assert_eq!((mask.weights[0], mask.weights[15 * 40 + 20]), (0.0, 1.0), "{}", view.name);
        }
    });
    says(&lines, &["black in the same place at the border", "masked"]);
    let options = LoadOptions { mask_borders: false, ..Default::default() };
    assert!(load_with(&folder, options).views.iter().all(|view| view.mask.is_none()));
    circles(&folder, 100.0);
    assert!(load(&folder).views.iter().all(|view| view.mask.is_none()));
}

#[test]
fn references_as_dark_as_the_photographs_are_not_references() {
    let root = &Folder::empty();
    for (split, views) in [("train", 0..7), ("test", 7..9)] {
        photographs(root, split, views.clone(), if split == "test" { 0.8 } else { 1.0 });
        write_json(root.join(format!("transforms_{split}.json")), &listed(split, views, ".png"));
    }
    let lines = warnings(|| {
        let dataset = load(root);
        for view in dataset.test_views() {
            assert!(view.image.is_some() && view.reference.is_none(), "{}", view.name);
        }
        let dataset =
            load_with(root, LoadOptions { keep: Some(0), downscale: 1.5, ..Default::default() });
        assert!(dataset.test_views().all(|view| view.loaded().unwrap().is_some()));
    });
    says(&lines, &["2 reference images are as dark as the photographs"]);
    // Bright ones are references, and so are those of bright photographs.
    photographs(root, "test", 7..9, 4.0);
    assert!(load(root).test_views().all(|view| view.reference.is_some()));
    photographs(root, "test", 7..9, 12.0);
    photographs(root, "train", 0..7, 12.0);
    assert!(load(root).test_views().all(|view| view.reference.is_some()));
}
