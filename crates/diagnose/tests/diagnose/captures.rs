//! The diagnosis finds the defects injected into a capture.

use std::fs;
use std::path::Path;

use nightsplat_core::random::Stream;
use nightsplat_diagnose::Diagnosis;
use nightsplat_photographs::dataset::{Dataset, DepthOptions, LoadOptions};
use nightsplat_photographs::image::{Image, ImageFile as _, linear_from_srgb, srgb_from_linear};
use nightsplat_synth::Capture;

use crate::common::Folder;
use crate::sets::{captured, repaint, small_set};

const VIEWS: usize = 12;
const SIZE: [u32; 2] = [96, 72];

fn taken_by(capture: &Capture) -> Folder {
    captured(&small_set(VIEWS, SIZE, 3), capture)
}

fn diagnosis_of(folder: &Path) -> Diagnosis {
    let depth = DepthOptions { load: true, ..DepthOptions::default() };
    let options = LoadOptions { depth, ..LoadOptions::default() };
    Diagnosis::new(&Dataset::load(folder, &options).unwrap(), &options).unwrap()
}

fn diagnosis(capture: &Capture) -> Diagnosis {
    diagnosis_of(&taken_by(capture))
}

fn close(found: f64, injected: f64, what: &str) {
    assert!((found / injected - 1.0).abs() < 0.1, "{what}: {found}, injected {injected}");
}

/// A photograph at four times the size, a third of the light, and with noise: surfaces are wider than the few pixels in
/// which the noise is measured.
fn taken(image: &Image, gain: f64, read: f64, index: usize) -> Image {
    const TIMES: u32 = 4;
    let noise = Stream::new(7, index as u64);
    let (width, height) = (TIMES * image.width, TIMES * image.height);
    let linear = |x: f32, y: f32| -> [f32; 3] {
        let (x0, y0) = (x.floor(), y.floor());
        let at = |dx: u32, dy: u32| {
            let pixel = image.pixel(
                (x0 as u32 + dx).min(image.width - 1),
                (y0 as u32 + dy).min(image.height - 1),
            );
            pixel.map(|value| linear_from_srgb(value) / 3.0)
        };
        let (tx, ty) = (x - x0, y - y0);
        let [a, b, c, d] = [at(0, 0), at(1, 0), at(0, 1), at(1, 1)];
        std::array::from_fn(|i| {
            (1.0 - ty) * ((1.0 - tx) * a[i] + tx * b[i]) + ty * ((1.0 - tx) * c[i] + tx * d[i])
        })
    };
    Image::from_fn(width, height, |x, y| {
        let signal = linear(x as f32 / TIMES as f32, y as f32 / TIMES as f32);
        std::array::from_fn(|channel| {
            let signal = f64::from(signal[channel]);
            let draw = noise.normal(u64::from(3 * (y * width + x)) + channel as u64);
            let noisy = signal + (gain * signal + read * read).sqrt() * draw;
            srgb_from_linear(noisy as f32).clamp(0.0, 1.0)
        })
    })
}

#[test]
fn injected_noise_is_found_within_a_tenth() {
    let set = taken_by(&Capture::clean());
    let clean: Vec<Image> = (0..VIEWS)
        .map(|view| Image::load(set.join(format!("low/{view:03}.png"))).unwrap())
        .collect();
    for (gain, read) in [(5e-4, 6e-3), (1.5e-3, 1e-2)] {
        repaint(&set, |index, _| taken(&clean[index], gain, read, index));
        let noise = diagnosis_of(&set).scene.noise.unwrap();
        close(noise.gain, gain, "gain");
        close(noise.read, read, "read noise");
    }
}

#[test]
fn injected_darkening_is_found_within_a_tenth() {
    let light = diagnosis(&Capture::clean()).scene;
    for darkening in [4.0, 25.0] {
        let dark = diagnosis(&Capture { darkening, ..Capture::clean() }).scene;
        close(dark.darkening / light.darkening, darkening, "darkening");
        assert!(dark.brightening > light.brightening && dark.code_values < light.code_values);
    }
    let noisy = diagnosis(&Capture::default()).scene;
    close(noisy.darkening / light.darkening, Capture::default().darkening, "darkening with noise");
}

#[test]
fn an_injected_spread_of_exposures_is_found_within_a_tenth_view_by_view() {
    let stops = vec![0.0, -1.0, -2.0, 1.0, 0.5];
    let capture = Capture { darkening: 8.0, stops: stops.clone(), ..Capture::default() };
    let found = diagnosis(&capture);
    let injected: Vec<f64> = (found.views.iter())
        .map(|view| stops[view.name.parse::<usize>().unwrap() % stops.len()])
        .collect();
    let mean = injected.iter().sum::<f64>() / injected.len() as f64;
    let variance = injected.iter().map(|stops| (stops - mean).powi(2)).sum::<f64>();
    close(found.scene.exposure_spread, (variance / injected.len() as f64).sqrt(), "spread");
    for (view, injected) in found.views.iter().zip(&injected) {
        let exposure = view.exposure.unwrap();
        assert!((exposure - (injected - mean)).abs() < 0.1, "{}: {exposure}", view.name);
    }
    assert!(diagnosis(&Capture::default()).scene.exposure_spread < 0.1);
}

#[test]
fn a_blurred_photograph_and_one_without_a_pose_are_named() {
    let set = taken_by(&Capture::clean());
    // Moved by a few pixels during the exposure, along both axes.
    let moved = |image: &Image, [dx, dy]: [u32; 2]| {
        Image::from_fn(SIZE[0], SIZE[1], |x, y| {
            let [right, bottom] = SIZE.map(|side| side - 1);
            let steps = 0..9;
            let pixels = steps
                .map(|step| image.pixel((x + dx * step).min(right), (y + dy * step).min(bottom)));
            pixels.fold([0.0; 3], |sum, rgb| std::array::from_fn(|c| sum[c] + rgb[c] / 9.0))
        })
    };
    repaint(&set, |index, image| match index {
        3 => moved(&moved(image, [1, 0]), [0, 1]),
        _ => image.clone(),
    });
    fs::copy(set.join("low/001.png"), set.join("low/stray.png")).unwrap();
    let found = diagnosis_of(&set);
    assert_eq!(found.without_pose, ["stray"]);
    for remark in ["more blurred than the others: 003", "without a pose, not used: stray"] {
        assert!(found.remarks.iter().any(|text| text.contains(remark)), "{:?}", found.remarks);
    }
    let view = |name: &str| found.views.iter().find(|view| view.name == name).unwrap();
    assert!(view("003").blur > view("002").blur);
    assert!(view("002").points > 100 && view("002").overlap > 0.5);
}
