//! `nightsplat pose --with`: dark photographs posed through bright ones of the same scene.

use super::pose::{is_installed, mean, photographed, pose, stub};
use super::synthetic::*;
use crate::common::command::says;
use crate::common::prelude::*;

/// Bright photographs `day/v00.png` to `day/v03.png`: names of dark photographs, too.
fn bright(root: &Path) -> PathBuf {
    let day = root.join("day");
    fs::create_dir_all(&day).unwrap();
    for index in 0..4 {
        let picture = Image::from_fn(SIZE.0, SIZE.1, |x, y| {
            [0.3 + 0.5 * f32::from((x / 4 + y / 3 + index).is_multiple_of(2)); 3]
        });
        picture.save_png8(day.join(name(index as usize)).with_extension("png")).unwrap();
    }
    day
}

/// A model of the first eight dark photographs, three of which are called bright ones.
fn mixed() -> Model {
    let mut model = model(8);
    for (_, _, _, name) in &mut model.images[..3] {
        *name = format!("bright/v{:02}.png", name[1..3].parse::<usize>().unwrap() - 5);
    }
    model
}

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
    let (stdout, stderr) = root.run(&pose("--with @day"), 0);
    says(&stdout, &["5 of 9 photographs and 3 of 4 bright ones"]);
    let unplaced =
        "4 photographs have no camera and are left out: v05.png, v06.png, v07.png, v08.png";
    says(&stderr, &["4 bright photographs beside them", unplaced]);
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
fn a_folder_that_cannot_pose_the_dark_photographs_is_refused() {
    let root = &Folder::empty();
    photographed(root);
    bright(root);
    stub(root, "mapper) exit 0;;");
    let itself = ["photos", "is the folder of the dark photographs itself"];
    root.refused(&pose("--with @photos"), 3, &itself);
    root.refused(&pose("--with @none"), 3, &["none"]);
    let sequential = pose("--with @day --matcher sequential");
    root.refused(&sequential, 2, &["--matcher sequential", "take exhaustive"]);
    says(&root.run(&pose("--with @day"), 3).1, &["found no cameras for these 9 photographs"]);
}

#[test]
fn colmap_poses_dark_photographs_through_bright_ones_of_other_views() {
    if !is_installed("colmap") {
        return;
    }
    let root = &Folder::empty();
    let options = small_set(24, [200, 150], 3);
    nightsplat_synth::write(root.join("set"), &options).unwrap();
    // Every sixth view is dark.
    for index in 0..options.views {
        let (from, to) = if index % 6 == 0 { ("low", "night") } else { ("high", "day") };
        fs::create_dir_all(root.join(to)).unwrap();
        let file = format!("{index:03}.png");
        fs::copy(root.join("set").join(from).join(&file), root.join(to).join(&file)).unwrap();
    }
    root.succeed("pose @night --with @day --out @scene");
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
