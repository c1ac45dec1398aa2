//! Dark corners and bands of rows: measured, told apart, and evened out in what is loaded.

use std::path::Path;

use nightsplat_diagnose::Diagnosis;
use nightsplat_photographs::dataset::{Dataset, LoadOptions, RowBands, View};
use nightsplat_photographs::image::{Image, linear_from_srgb};

use crate::common::{Folder, shared};
use crate::sets::{band, banded, changed, off, vignetted};

fn plain() -> Folder {
    changed(|_, _, light| light)
}

fn diagnosed(folder: &Path) -> (Dataset, Diagnosis) {
    Diagnosis::load(folder, &LoadOptions::default()).unwrap()
}

#[test]
fn a_plain_set_has_no_finding_and_keeps_its_bits() {
    let folder = plain();
    let (dataset, found) = diagnosed(&folder);
    // The synthetic room has views of few edges.
    let mut remarks = found.remarks.iter().filter(|remark| !remark.contains("more blurred"));
    assert_eq!(remarks.next(), None);
    let falloff = found.scene.falloff.unwrap();
    assert!(!falloff.is_found() && !falloff.is_corrected && falloff.corner > 0.8, "{falloff:?}");
    let plain = LoadOptions { mask_overlays: false, falloff: Some([0.0; 2]), ..Default::default() };
    let as_stored = Dataset::load(&folder, &plain).unwrap();
    for (view, stored) in dataset.views.iter().zip(&as_stored.views) {
        assert!(view.image == stored.image && view.mask.is_none(), "{}", view.name);
    }
}

#[test]
fn dark_corners_are_measured_and_evened_out_in_memory_and_when_read_again() {
    let (even, folder) = (plain(), vignetted());
    let falloff = diagnosed(&folder).1.scene.falloff.unwrap();
    assert!(falloff.is_found() && falloff.is_corrected, "{falloff:?}");
    assert!((falloff.corner - 0.25).abs() < 0.06 && falloff.error < 0.1, "{falloff:?}");
    let uncorrected = LoadOptions { falloff: Some([0.0; 2]), ..LoadOptions::default() };
    let (_, left) = Diagnosis::load(&folder, &uncorrected).unwrap();
    assert!(!left.scene.falloff.unwrap().is_corrected);
    let light = |folder: &Path, options: &LoadOptions| -> Vec<f64> {
        let dataset = Dataset::load(folder, options).unwrap();
        let images = dataset.train_views().map(|view| view.loaded().unwrap().unwrap().into_owned());
        let outer = |image: Image| -> f64 {
            let pixels = (0..image.height).flat_map(|y| (0..image.width).map(move |x| [x, y]));
            let light = |[x, y]: [u32; 2]| f64::from(linear_from_srgb(image.pixel(x, y)[1]));
            pixels.filter(|&at| off(at) > 0.8).map(light).sum()
        };
        images.map(outer).collect()
    };
    let evened = LoadOptions { falloff: Some(falloff.falloff), ..LoadOptions::default() };
    let truth = light(&even, &LoadOptions::default());
    let dark = light(&folder, &LoadOptions::default());
    let kept = light(&folder, &evened);
    for ((evened, dark), truth) in kept.iter().zip(dark).zip(truth) {
        assert!(dark < 0.45 * truth && (evened / truth).log2().abs() < 0.3, "{evened} for {truth}");
    }
    let read_again = LoadOptions { keep: Some(0), ..evened };
    assert_eq!(light(&folder, &read_again), kept);
}

/// The linear light of each row of each training photograph.
fn light_of_rows(folder: &Path, options: &LoadOptions) -> Vec<Vec<f64>> {
    let dataset = Dataset::load(folder, options).unwrap();
    let rows = |view: &View| -> Vec<f64> {
        let image = view.loaded().unwrap().unwrap();
        let light = |x, y| f64::from(linear_from_srgb(image.pixel(x, y)[1]));
        (0..image.height).map(|y| (0..image.width).map(|x| light(x, y)).sum()).collect()
    };
    dataset.train_views().map(rows).collect()
}

#[test]
fn bands_of_rows_are_measured_and_evened_out_in_memory_and_when_read_again() {
    let (even, folder) = (plain(), banded());
    let found = diagnosed(&folder).1.scene.bands.unwrap();
    assert!(found.is_found() && found.is_corrected, "{found:?}");
    // log2(1.35 / 0.65) is 1.05.
    assert!((found.stops - 1.05).abs() < 0.1, "{}", found.stops);
    assert!((found.rows.count - 2.5).abs() < 0.07, "{}", found.rows.count);
    let heights = found.rows.waves.values().map(|[c, s]| c.hypot(*s));
    assert!(heights.clone().count() > 10 && heights.clone().all(|m| (m - 0.35).abs() < 0.08));
    let left = LoadOptions { bands: Some(RowBands::default()), ..LoadOptions::default() };
    let (_, kept) = Diagnosis::load(&folder, &left).unwrap();
    assert!(!kept.scene.bands.unwrap().is_corrected);
    let evened = LoadOptions { bands: Some(found.rows), ..LoadOptions::default() };
    let truth = light_of_rows(&even, &LoadOptions::default());
    let [banded, kept] = [&left, &evened].map(|options| light_of_rows(&folder, options));
    // The largest difference of a row, stops.
    let worst = |set: &[Vec<f64>]| -> f64 {
        let rows = set.iter().flatten().zip(truth.iter().flatten());
        rows.map(|(one, truth)| (one / truth).log2().abs()).fold(0.0, f64::max)
    };
    assert!(worst(&banded) > 0.55 && worst(&kept) < 0.2, "{} {}", worst(&banded), worst(&kept));
    let read_again = LoadOptions { keep: Some(0), ..evened };
    assert_eq!(light_of_rows(&folder, &read_again), kept);
}

#[test]
fn bands_and_dark_corners_are_told_apart() {
    let folder = changed(|index, [x, y], light| {
        light * band(index, f64::from(y) + 0.5) / (1.0 + off([x, y]).powi(2)).powi(2)
    });
    let scene = diagnosed(&folder).1.scene;
    let (bands, falloff) = (scene.bands.unwrap(), scene.falloff.unwrap());
    assert!(bands.is_corrected && (bands.stops - 1.05).abs() < 0.15, "{bands:?}");
    assert!(falloff.is_corrected && (falloff.corner - 0.25).abs() < 0.08, "{falloff:?}");
}

#[test]
fn weak_bands_and_clean_sets_are_left_as_they_are() {
    // A fifth of them.
    let weak = changed(|index, [_, y], light| light * band(index, f64::from(y) + 0.5).powf(0.2));
    let even = plain();
    let mut sets = vec![even.to_path_buf(), weak.to_path_buf()];
    let captures = ["data/lom/chair", "data/lom/sofa", "data/lom/shrub", "data/fox"];
    sets.extend(captures.iter().filter_map(|set| shared(set)));
    for set in sets {
        let bands = diagnosed(&set).1.scene.bands.unwrap();
        println!("{}: {:.2} {:.2}", set.display(), bands.share, bands.stops);
        assert!(!bands.is_found() && !bands.is_corrected, "{}: {bands:?}", set.display());
    }
}
