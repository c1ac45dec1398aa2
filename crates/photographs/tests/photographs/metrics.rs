//! The scores agree with independently computed values.

use std::fs;
use std::path::Path;
use std::process::Command;

use nightsplat_photographs::image::{Image, ImageFile as _};
use nightsplat_photographs::metrics::{Scores, psnr, psnr_channel_mean, ssim, ssim_uniform};
use serde_json::Value;

use crate::common::{not_run, says, shared};

fn pattern(width: u32, height: u32) -> (Image, Image) {
    let render = |x: u32, y: u32, c: u32| f64::from((x * 7 + y * 13 + c * 29) % 32) / 31.0;
    let noise = |x: u32, y: u32, c: u32| f64::from((x * 11 + y * 5 + c * 17) % 29) / 28.0 - 0.5;
    let reference = |x, y, c| (render(x, y, c) * 0.8 + 0.1 + 0.25 * noise(x, y, c)).clamp(0.0, 1.0);
    (
        Image::from_fn(width, height, |x, y| [0, 1, 2].map(|c| render(x, y, c) as f32)),
        Image::from_fn(width, height, |x, y| [0, 1, 2].map(|c| reference(x, y, c) as f32)),
    )
}

#[test]
fn scores_equal_those_of_a_plain_two_dimensional_convolution() {
    // From a direct sum over the 11x11 window in double precision, written independently in Python.
    let (render, reference) = pattern(13, 9);
    let scores = Scores::measure(&render, &reference).unwrap();
    assert!((scores.psnr - 20.209_237_797_326_722).abs() < 1e-9, "{scores:?}");
    assert!((scores.psnr_channel_mean - 20.214_985_247_465_577).abs() < 1e-9, "{scores:?}");
    assert!((scores.ssim - 0.959_258_159_401_484).abs() < 1e-9, "{scores:?}");
}

#[test]
fn the_uniform_window_is_that_of_scikit_image() {
    // From `skimage.metrics.structural_similarity(render, reference, data_range=1.0, channel_axis=2)`, version 0.25,
    // and from a direct sum over the 7x7 windows; both agree to the last digit but one.
    let (render, reference) = pattern(13, 9);
    let ssim = ssim_uniform(&render, &reference).unwrap();
    assert!((ssim - 0.943_783_204_921_622_5).abs() < 1e-9, "{ssim}");
    assert!((ssim_uniform(&render, &render).unwrap() - 1.0).abs() < 1e-12);
    let small = Image::filled(20, 6, [0.5; 3]);
    let problem = ssim_uniform(&small, &small).unwrap_err().to_string();
    assert_eq!(problem, "an image of 20x6 has no window of 7x7; leave out --uniform-ssim");
}

#[test]
fn an_image_equals_itself() {
    let (image, _) = pattern(16, 12);
    let scores = Scores::measure(&image, &image).unwrap();
    assert_eq!((scores.psnr, scores.psnr_channel_mean), (f64::INFINITY, f64::INFINITY));
    assert!((scores.ssim - 1.0).abs() < 1e-12);
}

#[test]
fn a_constant_error_has_the_psnr_of_its_square() {
    let (a, b) = (Image::filled(5, 4, [0.5; 3]), Image::filled(5, 4, [0.5, 0.5, 0.6]));
    assert!((psnr(&a, &b).unwrap() - -10.0 * (0.01f64 / 3.0).log10()).abs() < 1e-5);
    assert_eq!(psnr_channel_mean(&a, &b).unwrap(), f64::INFINITY);
}

#[test]
fn images_of_different_sizes_are_refused_with_both_sizes() {
    let (a, b) = (Image::filled(5, 4, [0.5; 3]), Image::filled(4, 5, [0.5; 3]));
    for problem in [psnr(&a, &b), psnr_channel_mean(&a, &b), ssim(&a, &b)] {
        let problem = problem.unwrap_err().to_string();
        says(&problem, &["5x4", "4x5"]);
    }
}

#[test]
fn empty_and_truncated_images_are_refused() {
    let empty = Image { width: 0, height: 0, data: Vec::new() };
    assert!(Scores::measure(&empty, &empty).is_err());
    let short = Image { width: 2, height: 2, data: vec![0.0; 11] };
    assert!(Scores::measure(&short, &short).is_err());
}

#[test]
fn the_mean_of_no_scores_is_none() {
    assert_eq!(Scores::mean(&[]), None);
    let scores = |psnr| Scores { psnr, psnr_channel_mean: psnr + 1.0, ssim: 0.5 };
    assert_eq!(Scores::mean(&[scores(20.0), scores(30.0)]), Some(scores(25.0)));
}

#[test]
fn scores_agree_with_the_scoring_script() {
    let Some(script) = shared("tools/score.py") else { return };
    let python = Command::new("python3").args(["-c", "import numpy, PIL"]).output();
    if !python.is_ok_and(|output| output.status.success()) {
        return not_run("numpy", "there is no python3 with numpy and PIL");
    }
    let dir = tempfile::tempdir().unwrap();
    let (render, reference) = pattern(60, 40);
    let (renders, references) = (dir.path().join("renders"), dir.path().join("references"));
    for (folder, image) in [(&renders, &render), (&references, &reference)] {
        fs::create_dir(folder).unwrap();
        image.save_png8(folder.join("a.png")).unwrap();
    }
    let load = |folder: &Path| Image::load(folder.join("a.png")).unwrap();
    let ours = Scores::measure(&load(&renders), &load(&references)).unwrap();
    let output = Command::new("python3")
        .arg(&script)
        .args([&renders, &references])
        .arg("--json")
        .output()
        .unwrap();
    let theirs: Value = serde_json::from_slice(&output.stdout).unwrap();
    let theirs: Scores = serde_json::from_value(theirs["mean"].clone()).unwrap();
    assert!((ours.psnr - theirs.psnr).abs() < 0.01, "{ours:?} {theirs:?}");
    assert!(
        (ours.psnr_channel_mean - theirs.psnr_channel_mean).abs() < 0.01,
        "{ours:?} {theirs:?}"
    );
    assert!((ours.ssim - theirs.ssim).abs() < 0.001, "{ours:?} {theirs:?}");
}
