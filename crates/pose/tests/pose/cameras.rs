//! Photographs that share a camera, photographs left out, and what is burnt in.

use std::collections::BTreeSet;
use std::fs;
use std::path::Path;

use nightsplat_photographs::dataset::Dataset;
use nightsplat_photographs::image::{Image, ImageFile as _};
use nightsplat_pose::{PoseOptions, describe};
use nightsplat_synth::SyntheticOptions;

use crate::common::{Folder, paths, says};
use crate::stub::{MODELS, is_installed, photographed, stub};
use crate::synthetic::{Model, SIZE, load, model, photograph, view};
use crate::{estimated, finds_cameras, pose, refused};

/// Copies a photograph and sets its equivalent focal length in Exif.
fn taken_at(path: &Path, focal: u8) {
    let exif = [
        &b"MM\0*\0\0\0\x08\0\x01\x87\x69\0\x04\0\0\0\x01\0\0\0\x1a\0\0\0\0\0\x01\xa4\x05\0\x03\0\0\0\x01\0"[..],
        &[focal],
        b"\0\0\0\0\0\0",
    ]
    .concat();
    let jpeg = fs::read(crate::common::fixture("jpeg/444.jpg")).unwrap();
    let length = (exif.len() as u16 + 8).to_be_bytes();
    let segment = [&[0xFF, 0xE1][..], &length, b"Exif\0\0", &exif].concat();
    fs::write(path, [&jpeg[..2], &segment, &jpeg[2..]].concat()).unwrap();
}

#[test]
fn photographs_of_one_size_lens_and_focal_length_share_a_camera() {
    let root = &Folder::empty();
    let photos = root.join("photos");
    fs::create_dir_all(&photos).unwrap();
    for index in 0..6 {
        let focal = if index % 2 == 0 { 37 } else { 75 };
        taken_at(&photos.join(format!("{index}.jpg")), focal);
    }
    photograph(&photos.join("other.png"), SIZE, 0.05);
    photograph(&photos.join("another.png"), (32, 20), 0.05);
    stub(root, "feature_extractor) { tr '\\n' ' ' < $list; echo; } >> $root/lists;;");
    let told = refused(&pose(root), 3, &["no cameras for these 8 photographs"]);
    says(&told, &["3 groups of photographs by size, lens and focal length"]);
    let lists = root.text("lists");
    let lists: BTreeSet<&str> = lists.lines().map(str::trim).collect();
    let expected = ["0.jpg 2.jpg 4.jpg", "1.jpg 3.jpg 5.jpg", "another.png other.png"];
    assert_eq!(lists, BTreeSet::from(expected));
}

#[test]
fn a_photograph_that_does_not_decode_is_left_out_and_hidden_files_are_ignored() {
    let root = &Folder::empty();
    let photos = photographed(root);
    root.write("photos/broken.jpg", "no photograph");
    root.write("photos/._v00.png", "Mac OS X");
    photograph(&photos.join("dynamic_mask_v01.png"), SIZE, 1.0);
    model(9).write_binary(&root.join("models/0"));
    stub(root, MODELS);
    let told = finds_cameras(&pose(root), 9, 9);
    says(&told, &["left out: ", "broken.jpg"]);
    assert!(!told.contains("._v00"), "{told}");
    let dataset = load(&root.join("scene"));
    let masked: Vec<bool> = dataset.views.iter().map(|view| view.mask.is_some()).collect();
    // All of it is masked, so nothing is left to train on.
    assert_eq!((dataset.views.len(), masked.contains(&true)), (8, false));
}

#[test]
fn an_implausible_calibration_is_reported() {
    let root = &Folder::empty();
    photographed(root);
    stub(root, MODELS);
    let set = |fy: f64| {
        let cameras = vec![(3, "PINHOLE", 1, vec![35.0, fy, 20.0, 15.0])];
        Model { cameras, ..model(9) }.write_binary(&root.join("models/0"));
    };
    for (fy, is_plausible) in [(36.0, true), (60.0, false)] {
        set(fy);
        let (posed, told) = estimated(&PoseOptions { overwrite: true, ..pose(root) });
        let warned = told.contains("is implausible: its focal lengths are 71 % apart");
        assert_eq!(warned, !is_plausible, "{told}");
        let lenses: Vec<String> = posed.unwrap().lenses.iter().map(describe).collect();
        assert!(
            lenses.len() == 1 && lenses[0].contains("40x30 with focal length 35"),
            "{lenses:?}"
        );
    }
    fs::remove_dir_all(root.join("scene")).unwrap();
    set(93.0);
    let cannot_be = "photos: COLMAP's calibration cannot be, 40x30 with focal length 35 x 93";
    refused(&pose(root), 3, &[cannot_be, "2.7 times", "--camera-model"]);
    assert!(!root.join("scene").exists() && root.join("scene.colmap.log").is_file());

    // The next attempt finds one that can be.
    model(9).write_binary(&root.join("possible/0"));
    stub(
        root,
        "mapper) case $output in */guided) cp -r $root/possible/* $output;; *) cp -r $root/models/* $output;; esac;;",
    );
    let told = finds_cameras(&pose(root), 9, 9);
    says(
        &told,
        &["do not count, 40x30 with focal length 35 x 93", "0 of 9 have a camera: matching again"],
    );
}

#[test]
fn a_camera_that_few_points_hold_is_left_out_and_said() {
    let root = &Folder::empty();
    photographed(root);
    let mut model = model(9);
    for (index, (_, _, seen_by)) in model.points.iter_mut().enumerate() {
        let first = if index < 6 { 7 } else { 8 };
        *seen_by = (first..16).collect();
    }
    model.write_binary(&root.join("models/0"));
    stub(root, MODELS);
    let told = finds_cameras(&pose(root), 8, 9);
    let left_out = "left out: v00.png (6); half of all photographs see 20";
    assert!(told.contains(left_out) && !told.contains("have no camera"), "{told}");
    let dataset = load(&root.join("scene"));
    let names: BTreeSet<&str> = dataset.views.iter().map(|view| view.name.as_str()).collect();
    assert!(names.len() == 8 && !names.contains("v00"), "{names:?}");
}

#[test]
fn what_is_burnt_in_has_no_features_and_is_masked_in_the_dataset() {
    let root = &Folder::empty();
    let (photos, out, seen) = (photographed(root), root.join("scene"), root.join("seen"));
    let is_text = |x: u32, y: u32| (2..22).contains(&x) && (25..29).contains(&y);
    for index in 0..9 {
        let value = |x: u32, y: u32| match is_text(x, y) {
            true => f32::from(u8::from(x % 5 < 2)),
            false => {
                0.1 * ((((x + 7 * index) / 4) * 7 + (y + 5 * index) / 3 * 13) % 11) as f32 / 11.0
            }
        };
        let picture = Image::from_fn(SIZE.0, SIZE.1, |x, y| [value(x, y); 3]);
        picture.save_png8(photos.join(format!("v{index:02}.png"))).unwrap();
    }
    photograph(&photos.join("masks/v03.png"), SIZE, 1.0);
    photograph(&photos.join("masks/v04.png"), SIZE, 0.0);
    model(9).write_binary(&root.join("models/0"));
    stub(root, &format!("feature_extractor) cp -r $masks $root/seen;;\n{MODELS}"));
    says(&finds_cameras(&pose(root), 9, 9), &[" % of the photographs of 40x30 hardly changes"]);
    let shown =
        |mask: &Path, x: u32, y: u32| Image::load(mask).unwrap().data[(40 * y + x) as usize] > 0.0;
    for mask in [seen.join("v03.png.png"), seen.join("v08.png.png"), out.join("masks/v08.png")] {
        let pixels = || (0..SIZE.1).flat_map(|y| (0..SIZE.0).map(move |x| (x, y)));
        assert!(pixels().all(|(x, y)| !is_text(x, y) || !shown(&mask, x, y)), "{mask:?}");
        assert!(pixels().all(|(x, y)| y > 20 || shown(&mask, x, y)), "{mask:?}");
    }
    // Masks of the photographs count for both, and stay as they are in the dataset.
    assert!(!shown(&seen.join("v04.png.png"), 0, 0));
    assert!(shown(&out.join("masks/v03.png"), 5, 25));
    let dataset = load(&out);
    let masked = dataset.views.iter().filter(|view| view.mask.is_some());
    let masked: Vec<&str> = masked.map(|view| view.name.as_str()).collect();
    assert_eq!(masked, ["v00", "v01", "v02", "v05", "v06", "v07", "v08"]);
}

#[test]
fn a_dim_dashboard_has_no_features() {
    let root = &Folder::empty();
    let (photos, seen) = (photographed(root), root.join("seen"));
    let (width, height) = (320, 240);
    // Instruments of four codes in black, below a scene of thirty.
    let is_lit = |x: u32, y: u32| {
        let (dx, dy) = ((x % 80).abs_diff(40), y.abs_diff(210));
        (250..600).contains(&(dx * dx + dy * dy)) && (x + y) % 5 < 3
    };
    for index in 0..9_u32 {
        let noise = |x: u32, y: u32| ((x * 7919 + y * 104_729 + index * 1_299_709) >> 3) % 3;
        let code = |x: u32, y: u32| match y {
            184.. => {
                if is_lit(x, y) {
                    4
                } else {
                    0
                }
            }
            _ => ((x + 31 * index) / 9 * 7 + (y + 17 * index) / 7 * 13) % 11 * 3,
        };
        let value = |x: u32, y: u32| (code(x, y) + noise(x, y)) as f32 / 255.0;
        let picture = Image::from_fn(width, height, |x, y| [value(x, y); 3]);
        picture.save_png8(photos.join(format!("v{index:02}.png"))).unwrap();
    }
    model(9).write_binary(&root.join("models/0"));
    stub(root, &format!("feature_extractor) cp -r $masks $root/seen;;\n{MODELS}"));
    says(&finds_cameras(&pose(root), 9, 9), &["hardly changes between views that move"]);
    let mask = Image::load(seen.join("v08.png.png")).unwrap();
    let pixels = || (0..height).flat_map(|y| (0..width).map(move |x| (x, y)));
    let is_shown = |x: u32, y: u32| mask.data[(width * y + x) as usize] > 0.0;
    assert!(pixels().all(|(x, y)| y < 184 || !is_lit(x, y) || !is_shown(x, y)), "instruments");
    assert!(pixels().all(|(x, y)| y >= 168 || is_shown(x, y)), "the scene");
}

/// Burns a line of text into the last rows of photographs of 200x150; its end changes.
fn burn_in_text(folder: &Path) {
    for (index, file) in paths(folder).iter().enumerate() {
        let mut picture = Image::load(file).unwrap();
        let (width, pixels) = (picture.width as usize, picture.pixel_count());
        for pixel in 138 * width..pixels {
            let (column, row) = (pixel % width / 4, (pixel / width - 138) / 3);
            let changes = if column >= 40 { 5 * index } else { 0 };
            let is_lit = (7 * column + 13 * row + changes + column * row % 5) % 11 < 4;
            let value = f32::from(u8::from(is_lit && row < 3 && column < 48));
            (0..3).for_each(|channel| picture.data[channel * pixels + pixel] = value);
        }
        picture.save_png8(file).unwrap();
    }
}

#[test]
fn colmap_finds_the_cameras_of_a_dark_set_with_a_date_burnt_into_it() {
    if !is_installed("colmap") {
        return;
    }
    let root = &Folder::empty();
    let options =
        SyntheticOptions { views: 20, width: 200, height: 150, seed: 3, ..Default::default() };
    nightsplat_synth::write(root.join("set"), &options).unwrap();
    burn_in_text(&root.join("set/low"));
    let options =
        PoseOptions { photos: root.join("set/low"), colmap: "colmap".into(), ..pose(root) };
    estimated(&options).0.unwrap();
    let (truth, found) = (load(&root.join("set")), load(&root.join("scene")));
    assert!(found.views.len() >= 15, "{} of 20", found.views.len());
    assert!(found.points.len() > 50, "{} points", found.points.len());
    // Distances between cameras, whose scale is free.
    let center = |name: &str, set: &Dataset| view(set, name).camera.center();
    let names: Vec<&str> = found.views.iter().map(|view| view.name.as_str()).collect();
    let spans = names.windows(3).map(|three| {
        let span = |set| center(three[0], set).distance(center(three[2], set));
        span(&found) / span(&truth)
    });
    let spans: Vec<f64> = spans.collect();
    let mean = spans.iter().sum::<f64>() / spans.len() as f64;
    assert!(spans.iter().all(|span| (span / mean - 1.0).abs() < 0.1), "{spans:?}");
}
