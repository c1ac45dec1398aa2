//! Dark photographs posed through bright ones of the same scene.

use std::fs;

use nightsplat_photographs::dataset::Dataset;
use nightsplat_pose::PoseOptions;
use nightsplat_synth::SyntheticOptions;

use crate::common::{Folder, says};
use crate::stub::{bright, is_installed, mean, mixed, photographed, stub};
use crate::synthetic::{load, model, view};
use crate::{estimated, pose, refused};

#[test]
fn the_dark_and_the_bright_photographs_get_a_dataset_each_in_the_same_coordinates() {
    let root = &Folder::empty();
    let (photos, day, out) = (photographed(root), bright(root), root.join("scene"));
    mixed().write_binary(&root.join("models/0"));
    // Of the models, the one with the most dark photographs counts.
    let mut others = model(9);
    others.images.iter_mut().for_each(|(_, _, _, name)| *name = format!("bright/{name}"));
    others.write_binary(&root.join("models/1"));
    stub(root, "mapper) cp -r $root/models/* $output; cp -r $images $root/seen;;");
    let (posed, told) = estimated(&PoseOptions { with: Some(day.clone()), ..pose(root) });
    let posed = posed.unwrap();
    assert_eq!((posed.placed, posed.photographs, posed.bright), (5, 9, Some([3, 4])));
    let unplaced =
        "4 photographs have no camera and are left out: v05.png, v06.png, v07.png, v08.png";
    says(&told, &["4 bright photographs beside them", unplaced]);
    assert!(mean(&root.join("seen/v00.png")) > 4.0 * mean(&photos.join("v00.png")));
    let unchanged = mean(&root.join("seen/bright/v00.png")) / mean(&day.join("v00.png"));
    assert!((unchanged - 1.0).abs() < 0.01, "normal light stays as it is: {unchanged}");

    let whole = model(8);
    for (set, source, count) in [(out.clone(), &photos, 5), (out.join("bright"), &day, 3)] {
        let dataset = load(&set);
        assert_eq!((dataset.views.len(), dataset.points.len()), (count, 20), "{}", set.display());
        assert!(dataset.skipped.is_empty(), "{:?}", dataset.skipped);
        for view in &dataset.views {
            let file = format!("{}.png", view.name);
            let [posed, kept] =
                [source, &set.join("images")].map(|at| fs::read(at.join(&file)).unwrap());
            assert_eq!(posed, kept, "{file}");
            let index = view.name[1..].parse::<usize>().unwrap();
            let id = if count == 3 { index + 5 } else { index } as u32 + 7;
            let pose = whole.images.iter().find(|image| image.0 == id).unwrap().1;
            assert!(view.camera.view_from_world.abs_diff_eq(pose, 1e-9), "{file}");
        }
    }
}

#[test]
fn bright_photographs_that_pose_no_dark_one_are_reported() {
    let root = &Folder::empty();
    photographed(root);
    stub(root, "mapper) exit 0;;");
    let options = PoseOptions { with: Some(bright(root)), ..pose(root) };
    refused(&options, 3, &["found no cameras for these 9 photographs"]);
}

#[test]
fn colmap_poses_dark_photographs_through_bright_ones_of_other_views() {
    if !is_installed("colmap") {
        return;
    }
    let root = &Folder::empty();
    let options =
        SyntheticOptions { views: 24, width: 200, height: 150, seed: 3, ..Default::default() };
    nightsplat_synth::write(root.join("set"), &options).unwrap();
    // Every sixth view is dark.
    for index in 0..options.views {
        let (from, to) = if index % 6 == 0 { ("low", "night") } else { ("high", "day") };
        fs::create_dir_all(root.join(to)).unwrap();
        let file = format!("{index:03}.png");
        fs::copy(root.join("set").join(from).join(&file), root.join(to).join(&file)).unwrap();
    }
    let options = PoseOptions {
        photos: root.join("night"),
        with: Some(root.join("day")),
        colmap: "colmap".into(),
        ..pose(root)
    };
    estimated(&options).0.unwrap();
    let (truth, dark, bright) =
        (load(&root.join("set")), load(&root.join("scene")), load(&root.join("scene/bright")));
    assert!(dark.views.len() >= 3 && bright.views.len() >= 15, "{} dark", dark.views.len());
    // Distances of every dark camera from the bright ones, whose scale is free.
    let center = |set: &Dataset, name: &str| view(set, name).camera.center();
    let mut distances = vec![];
    for dark_view in &dark.views {
        for bright_view in &bright.views {
            let (a, b) = (dark_view.name.as_str(), bright_view.name.as_str());
            let found = center(&dark, a).distance(center(&bright, b));
            distances.push([found, center(&truth, a).distance(center(&truth, b))]);
        }
    }
    let mean =
        |at: usize| distances.iter().map(|pair| pair[at]).sum::<f64>() / distances.len() as f64;
    let (scale, extent) = (mean(0) / mean(1), mean(1));
    let off = distances.iter().map(|[found, truth]| (found / scale - truth).abs() / extent);
    let mut off: Vec<f64> = off.collect();
    off.sort_by(f64::total_cmp);
    // COLMAP's choices differ from run to run: half of the distances are near the truth in all of them.
    assert!(off[off.len() / 2] < 0.1, "{off:?}");
}
