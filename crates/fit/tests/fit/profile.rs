//! Camera profiles: the true profile is recovered for any exposure, and bad pairs are named.

use std::fs;
use std::path::Path;

use nightsplat_core::random::Stream;
use nightsplat_fit::{
    ColourPair, ColourScene, cross_validate_profile, fit_profile, profile_scores,
};
use nightsplat_photographs::image::{Image, ImageFile as _};
use nightsplat_photographs::tone::Profile;

use crate::pairs::dark;

/// Mixes channels, and bends each differently.
fn truth() -> Profile {
    let bent = |power: f64| (0..=16).map(move |i| 0.05 + 0.9 * (f64::from(i) / 16.0).powf(power));
    Profile {
        reference: "truth".to_owned(),
        pairs: 1,
        matrix: [[0.85, 0.2, -0.05], [0.1, 0.8, 0.1], [-0.1, 0.2, 0.9]],
        gain: [1.1, 1.0, 1.2],
        bias: [-0.03, 0.0, -0.05],
        segments: [0.7, 1.0, 1.3].map(|power| bent(power).collect()),
    }
}

/// A scene of pairs on disk: dark colours, each photograph with one of `exposures` relative to the first, and the true
/// profile of the colours at the gain of the first, with noise.
fn scene(folder: &Path, exposures: &[f64], noise: f64) {
    for name in ["low", "high"] {
        fs::create_dir_all(folder.join(name)).unwrap();
    }
    let (first, stream) = (dark(120, 0.04, 0.0, 5), Stream::new(5, 9));
    // The gain at which the rule gives the first photograph, by itself, its brightness.
    let luminance = nightsplat_photographs::tone::LuminanceHistogram::new(&first.data);
    let gain = nightsplat_photographs::tone::Exposure::measure([&luminance], None).unwrap().gain;
    for (index, exposure) in exposures.iter().enumerate() {
        let scaled = first.data.iter().map(|x| (f64::from(*x) * exposure) as f32);
        let low = Image { data: scaled.collect(), ..first };
        low.save_png16(folder.join(format!("low/{index}.png"))).unwrap();
        let n = first.pixel_count();
        let mut high = first.clone();
        for i in 0..n {
            let t = [0, 1, 2].map(|channel| gain * f64::from(first.data[channel * n + i]));
            let y = truth().value(t);
            for (channel, y) in y.into_iter().enumerate() {
                let error = noise * stream.normal((channel * n + i) as u64);
                high.data[channel * n + i] = (y + error).clamp(0.0, 1.0) as f32;
            }
        }
        high.save_png16(folder.join(format!("high/{index}.png"))).unwrap();
    }
}

fn load(folder: &Path) -> ColourScene {
    ColourScene::load(folder, None).unwrap()
}

fn fitted(scene: &ColourScene) -> Profile {
    let pairs: Vec<&ColourPair> = scene.pairs.iter().collect();
    fit_profile(&[(&scene.name, pairs)], 1.345).unwrap()
}

#[test]
fn a_profile_recovers_the_references_for_any_exposure() {
    let dir = tempfile::tempdir().unwrap();
    scene(&dir.path().join("a"), &[1.0], 0.0);
    scene(&dir.path().join("b"), &[0.5, 1.0, 2.0], 0.02);
    let (a, b) = (load(&dir.path().join("a")), load(&dir.path().join("b")));
    let profile = fitted(&a);
    profile.check().unwrap();
    assert_eq!((profile.reference.as_str(), profile.pairs), ("a", 1));
    let scores = profile_scores(&profile, &a.pairs.iter().collect::<Vec<_>>());
    assert!(scores.profile > 38.0 && scores.auto < scores.profile - 10.0, "{scores:?}");
    // Noise of 0.02 gives 34 dB; the other exposures are the same after the rule.
    let scores = profile_scores(&profile, &b.pairs.iter().collect::<Vec<_>>());
    assert!((32.5..34.2).contains(&scores.profile), "{scores:?}");
    for (row, truth) in profile.matrix.iter().zip(truth().matrix) {
        for (weight, truth) in row.iter().zip(truth) {
            assert!((weight - truth).abs() < 0.05, "{row:?}");
        }
    }
    // The same fit gives the same file twice.
    assert_eq!(fitted(&a), profile);
    let folds = cross_validate_profile(&[a, b], 5, 1.345).unwrap();
    assert_eq!(folds.iter().map(|fold| fold.name.as_str()).collect::<Vec<_>>(), ["a", "b"]);
    assert!(folds.iter().all(|fold| fold.scores.profile > 32.0), "{folds:?}");
}

#[test]
fn outliers_do_not_affect_a_profile() {
    let dir = tempfile::tempdir().unwrap();
    scene(dir.path(), &[1.0], 0.005);
    let clean = load(dir.path());
    let mut spoilt = clean.clone();
    // A twentieth of the colours is different.
    for (index, [_, light]) in spoilt.pairs[0].colours.iter_mut().enumerate() {
        if index % 20 == 0 {
            *light = [1.0, 0.0, 1.0];
        }
    }
    let pairs: Vec<&ColourPair> = clean.pairs.iter().collect();
    let robust = profile_scores(&fitted(&spoilt), &pairs).profile;
    assert!(robust > profile_scores(&fitted(&clean), &pairs).profile - 3.0, "{robust}");
}

#[test]
fn pairs_that_determine_no_profile_are_refused() {
    assert!(fit_profile(&[], 1.345).unwrap_err().to_string().contains("at least one"));
    let dir = tempfile::tempdir().unwrap();
    scene(dir.path(), &[1.0], 0.0);
    let mut grey = load(dir.path());
    assert!(fit_profile(&[("a", grey.pairs.iter().collect())], f64::NAN).is_err());
    let problem = cross_validate_profile(&[grey.clone()], 5, 1.345).unwrap_err().to_string();
    assert!(problem.contains("two pairs"), "{problem}");
    grey.pairs[0].colours.iter_mut().for_each(|[dark, _]| *dark = [0.5; 3]);
    let problem =
        fit_profile(&[("a", grey.pairs.iter().collect())], 1.345).unwrap_err().to_string();
    assert!(problem.contains("a single colour"), "{problem}");
    for name in ["low/0.png", "high/0.png"] {
        Image::filled(40, 40, [0.0; 3]).save_png8(dir.path().join(name)).unwrap();
    }
    let problem = ColourScene::load(dir.path(), None).unwrap_err().to_string();
    assert!(problem.contains("almost black"), "{problem}");
}
