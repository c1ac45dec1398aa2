//! Camera RAW: targets of its light, and training on it.

use nightsplat_photographs::scene_tone::SceneTone;
use nightsplat_photographs::tone::{InverseTone, MeasuredPhotograph};

use super::dng::{BLACK, NEUTRAL, WHITE, counted, dng, dng_of};
use crate::common::paths;
use crate::common::prelude::*;

/// A signal of a part of the noise, in a set of views: its mean, over all pixels, in standard deviations of the noise.
/// Cut at black, it would be .40 for no light, and .08 too much for light of one standard deviation.
#[test]
fn noise_at_black_keeps_its_mean_through_loading_and_the_target() {
    const VIEWS: usize = 30;
    const SIGMA: f32 = 16.0;
    let (folder, gpu) = (Folder::empty(), gpu());
    let path = folder.join("a.dng");
    let mut random = Random::new(3);
    let none = ToneSettings::new(ToneCurve::None);
    let auto = ToneSettings::default();
    let curves = [&none, &auto].map(|settings| PseudoGt::new(&gpu, settings).unwrap());
    let lit = [MeasuredPhotograph::measure(&[0.1; 300])];
    let law = SceneTone::from_photographs(&auto, &lit).unwrap().curve_of(&lit[0]);
    let plain = SceneTone::new(&none).curve_of(&lit[0]);
    let sigma = SIGMA / f32::from(WHITE - BLACK);
    for is_mosaic in [false, true] {
        for signal in [0.0, 0.25, 0.5, 1.0, 2.0] {
            let (mut loaded, mut targets, mut bright) = ([0.0; 3], [0.0; 3], [0.0; 3]);
            for _ in 0..VIEWS {
                let noisy = |_, _| {
                    let noise: [f64; 3] = random.normals();
                    noise.map(|noise| {
                        (f32::from(BLACK) + SIGMA * (signal + noise as f32)).round() as u16
                    })
                };
                fs::write(&path, dng_of(16, 16, is_mosaic, noisy)).unwrap();
                let image = Image::load(&path).unwrap();
                let target = curves[0].tone_mapped(&image, &plain).unwrap();
                let brightened = curves[1].tone_mapped(&image, &law).unwrap();
                let black = law.offset;
                for channel in 0..3 {
                    let mean = |values: &[f32], value: fn(f32) -> f32| {
                        let values = &values[256 * channel..][..256];
                        values.iter().map(|&x| f64::from(value(x))).sum::<f64>() / 256.0
                    };
                    let unit = f64::from(sigma / NEUTRAL[channel]) * VIEWS as f64;
                    loaded[channel] += mean(&image.data, linear_from_srgb) / unit;
                    targets[channel] += mean(&target.data, linear_from_srgb) / unit;
                    bright[channel] += mean(&brightened.data, |x| x) - f64::from(black);
                }
            }
            // Demosaicing repeats a sample up to four times, in both directions.
            let repeats = if is_mosaic { 4.0 } else { 1.0 };
            let error = 4.0 * repeats / (VIEWS as f64 * 256.0).sqrt();
            println!(
                "mosaic {is_mosaic}, signal {signal}: {loaded:.3?} {targets:.3?} {bright:.4?}"
            );
            for found in loaded.into_iter().chain(targets) {
                assert!((found - f64::from(signal)).abs() < error, "{signal}: {found}");
            }
            // By the slope at black, which the curve has on both sides.
            let slope = 12.92 * (1.0 - 0.075) / law.white;
            for (channel, found) in bright.into_iter().enumerate() {
                let one = f64::from(slope * sigma / NEUTRAL[channel]);
                let found = found / VIEWS as f64 / one;
                assert!(signal > 0.0 || found.abs() < error, "{channel}: {found}");
            }
        }
    }
}

/// Writes a synthetic set whose photographs are RAW, and returns their number.
fn raw_set(set: &Path, options: &SyntheticOptions) -> usize {
    nightsplat_synth::write(set, options).unwrap();
    let photographs = paths(&set.join("low"));
    for path in &photographs {
        let image = Image::load(path).unwrap();
        let light = |x: u16, y: u16| image.pixel(x.into(), y.into()).map(linear_from_srgb);
        let (width, height) = (image.width as u16, image.height as u16);
        fs::write(path.with_extension("dng"), dng(width, height, |x, y| counted(light(x, y))))
            .unwrap();
        fs::remove_file(path).unwrap();
    }
    photographs.len()
}

#[test]
fn photographs_in_raw_train_as_the_same_light_in_another_format() {
    let folder = Folder::empty();
    let options =
        SyntheticOptions { views: 9, width: 48, height: 36, ..SyntheticOptions::default() };
    nightsplat_synth::write(folder.join("encoded"), &options).unwrap();
    assert!(raw_set(&folder.join("raw"), &options) >= 8);
    // After a few steps.
    let [encoded, raw] = ["encoded", "raw"].map(|name| {
        let options = "--steps 60 --sh-degree 0 --model plain --curve auto --progress none";
        folder.succeed(&format!("train @{name} --out @{name}.run {options}"));
        folder.json(&format!("{name}.run/metrics.json"))["mean"]["psnr"].as_f64().unwrap()
    });
    assert!((encoded - raw).abs() < 0.1, "{encoded} dB of PNG, {raw} dB of RAW");
}

/// Sensor, target, inverse, EXR: what `render --as linear` writes of a model that fits its targets.
#[test]
fn light_on_the_sensor_comes_back_in_an_exr_through_target_and_inverse() {
    let folder = Folder::empty();
    let [raw, exr] = ["a.dng", "a.exr"].map(|name| folder.join(name));
    // Seven stops, in colours.
    let light = |x: u16, y: u16| {
        let red = 0.03 / f32::from(1_u16 << (x / 4));
        [red, 0.7 * red, if y < 4 { 0.4 * red } else { red }]
    };
    fs::write(&raw, dng(28, 8, |x, y| counted(light(x, y)))).unwrap();
    let photograph = Image::load(&raw).unwrap();
    let settings = ToneSettings::default();
    let measured = MeasuredPhotograph::measure(&photograph.data);
    let scene = SceneTone::from_photographs(&settings, std::slice::from_ref(&measured)).unwrap();
    let curve = scene.curve_of(&measured);
    let pseudo_gt = PseudoGt::new(&gpu(), &settings).unwrap();
    let target = pseudo_gt.tone_mapped(&photograph, &curve).unwrap();
    assert!(target.pixel(9, 2)[0] > 2.0 * photograph.pixel(9, 2)[0], "the target is brighter");
    let inverse = InverseTone::new(&settings, &curve).unwrap();
    let back = Image::from_fn(28, 8, |x, y| {
        let target = target.pixel(x, y).map(f64::from);
        assert!(!inverse.is_clipped(target), "{x} {y}");
        inverse.invert(target).map(|x| x as f32)
    });
    back.save_exr(&exr).unwrap();
    let read = Image::load(&exr).unwrap();
    let mut most = 0.0_f32;
    for (x, y) in (0..28).flat_map(|x| (0..8).map(move |y| (x, y))) {
        let planted = light(x, y);
        let found = read.pixel(x.into(), y.into()).map(linear_from_srgb);
        for (found, planted) in found.into_iter().zip(planted) {
            // A code of the sensor in red, the weakest, beyond which 2e-3 of the light may differ.
            let code = 1.0 / f32::from(WHITE - BLACK) / NEUTRAL[0];
            most = most.max(((found - planted).abs() - code).max(0.0) / planted);
        }
    }
    println!("light comes back to {most:e}, beyond a code of the sensor");
    assert!(most < 2e-3, "{most:e}");
}

/// The light of a trained model in `render --as linear`, against that on the sensor, in bins of a stop.
#[test]
fn a_raw_set_stays_linear_to_the_exr_of_its_renders() {
    let folder = Folder::empty();
    let options =
        SyntheticOptions { views: 12, width: 64, height: 48, ..SyntheticOptions::default() };
    let photographs = raw_set(&folder.join("set"), &options);
    folder.succeed("train @set --out @run --steps 500 --plan none --progress none");
    folder.succeed("render @run --split train --as linear --format exr --out @out");
    // Sums of the light of sensor and render by the sensor's light, a stop a bin.
    let mut bins = BTreeMap::<i32, [f64; 3]>::new();
    let renders = paths(&folder.join("out"));
    for path in &renders {
        let name = path.file_stem().unwrap().to_string_lossy().into_owned();
        let sensor = Image::load(folder.join(format!("set/low/{name}.dng"))).unwrap();
        let render = Image::load(path).unwrap();
        for (sensor, render) in sensor.data.iter().zip(&render.data) {
            let [sensor, render] = [sensor, render].map(|&x| f64::from(linear_from_srgb(x)));
            let sums = bins.entry(sensor.max(1e-9).log2().floor() as i32).or_default();
            *sums = [sums[0] + sensor, sums[1] + render, sums[2] + 1.0];
        }
    }
    assert!(renders.len() >= photographs - 3, "{} of {photographs}", renders.len());
    let total: f64 = bins.values().map(|sums| sums[2]).sum();
    let stops: Vec<(i32, f64)> = bins
        .iter()
        .filter(|(_, sums)| sums[2] > 0.05 * total)
        .map(|(bin, sums)| (*bin, (sums[1] / sums[0]).log2()))
        .collect();
    println!("by stops of the sensor's light, stops of the render above it: {stops:.3?}");
    assert!(stops.len() >= 4, "{stops:?}");
    assert!(stops.iter().all(|(_, off)| off.abs() < 0.15), "{stops:?}");
}
