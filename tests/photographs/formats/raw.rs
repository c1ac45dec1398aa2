//! Camera RAW: a minimal file, its linear light, and training on it.

use nightsplat_photographs::image::srgb_from_linear;
use nightsplat_photographs::scene_tone::SceneTone;
use nightsplat_photographs::tone::{InverseTone, MeasuredPhotograph};

use crate::common::paths;
use crate::common::prelude::*;

/// Sensor values without light, and at saturation.
const BLACK: u16 = 256;
const WHITE: u16 = 65_280;
/// Sensor values of white, relative to green.
const NEUTRAL: [f32; 3] = [0.5, 1.0, 2.0 / 3.0];

/// Sensor value of light.
fn counted(light: [f32; 3]) -> [u16; 3] {
    let range = f32::from(WHITE - BLACK);
    std::array::from_fn(|k| BLACK + (range * NEUTRAL[k] * light[k]).round() as u16)
}

/// A minimal linear DNG: 16-bit pixels of three colours in one strip, the camera's neutral, black and white levels.
fn dng(width: u16, height: u16, pixel: impl FnMut(u16, u16) -> [u16; 3]) -> Vec<u8> {
    dng_of(width, height, false, pixel)
}

/// [`dng`], or one of a mosaic: red, green; green, blue.
fn dng_of(
    width: u16,
    height: u16,
    is_mosaic: bool,
    mut pixel: impl FnMut(u16, u16) -> [u16; 3],
) -> Vec<u8> {
    let short = |values: &[u16]| {
        (
            3_u16,
            values.len() as u32,
            values.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>(),
        )
    };
    let rational = |type_: u16, values: &[[i32; 2]]| {
        (
            type_,
            values.len() as u32,
            values.iter().flatten().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>(),
        )
    };
    let text = |text: &str| (2_u16, text.len() as u32 + 1, [text.as_bytes(), &[0]].concat());
    let bytes = |values: &[u8]| (1_u16, values.len() as u32, values.to_vec());
    let long = |value: u32| (4_u16, 1_u32, value.to_le_bytes().to_vec());
    let pixels: Vec<u8> = (0..height)
        .flat_map(|y| (0..width).map(move |x| (x, y)))
        .flat_map(|(x, y)| match is_mosaic {
            true => vec![pixel(x, y)[usize::from(x % 2 + y % 2)]],
            false => pixel(x, y).to_vec(),
        })
        .flat_map(u16::to_le_bytes)
        .collect();
    // From XYZ to the camera's colours, which are sRGB's.
    let matrix = [32405, -15371, -4985, -9693, 18760, 416, 556, -2040, 10572].map(|v| [v, 10_000]);
    let samples = if is_mosaic { 1 } else { 3 };
    let mut entries = vec![
        (254, long(0)),
        (256, long(width.into())),
        (257, long(height.into())),
        (258, short(&[16; 3][..samples])),
        (259, short(&[1])),
        (262, short(&[if is_mosaic { 32803 } else { 34892 }])),
        (271, text("Test")),
        (272, text("Linear")),
        (273, long(8)),
        (274, short(&[1])),
        (277, short(&[samples as u16])),
        (278, long(height.into())),
        (279, long(pixels.len() as u32)),
        (284, short(&[1])),
        (50706, bytes(&[1, 4, 0, 0])),
        (50707, bytes(&[1, 1, 0, 0])),
        (50708, text("Test Linear")),
        (50714, short(&[BLACK; 3][..samples])),
        (50717, short(&[WHITE; 3][..samples])),
        (50721, rational(10, &matrix)),
        (50728, rational(5, &[[1, 2], [1, 1], [2, 3]])),
        (50778, short(&[21])),
    ];
    if is_mosaic {
        entries.extend([(33421, short(&[2, 2])), (33422, bytes(&[0, 1, 1, 2]))]);
    }
    entries.sort_by_key(|(tag, _)| *tag);
    let directory = 8 + pixels.len();
    let mut after = directory + 2 + 12 * entries.len() + 4;
    let mut file = [b"II*\0".as_slice(), &(directory as u32).to_le_bytes(), &pixels].concat();
    file.extend((entries.len() as u16).to_le_bytes());
    let mut values = vec![];
    for (tag, (type_, count, mut value)) in entries {
        file.extend((tag as u16).to_le_bytes());
        file.extend(type_.to_le_bytes());
        file.extend(count.to_le_bytes());
        if value.len() <= 4 {
            value.resize(4, 0);
            file.extend(value);
        } else {
            file.extend((after as u32).to_le_bytes());
            value.resize(value.len().next_multiple_of(2), 0);
            after += value.len();
            values.extend(value);
        }
    }
    file.extend([0; 4]);
    file.extend(values);
    file
}

#[test]
fn a_linear_dng_is_linear_light_with_the_cameras_white() {
    let folder = Folder::empty();
    let path = folder.join("a.dng");
    // Grey of known light, 1/16 to 1/2, by a camera with weaker red and blue.
    let light = |x: u16| 1.0 / f32::from(16_u16 >> (x / 4));
    fs::write(&path, dng(16, 8, |x, _| counted([light(x); 3]))).unwrap();
    let image = Image::load(&path).unwrap();
    assert_eq!((image.width, image.height), (16, 8));
    assert_eq!(Image::size_of(&path).unwrap(), (16, 8));
    for x in [1, 5, 9, 13] {
        let expected = srgb_from_linear(light(x));
        for value in image.pixel(x.into(), 4) {
            assert!((value - expected).abs() < 2e-4, "{x}: {value}, not {expected}");
        }
    }
    // Linear light is processed as in EXR: the same photograph from either file.
    let exr = folder.join("a.exr");
    image.save_exr(&exr).unwrap();
    let other = Image::load(&exr).unwrap();
    let off = image.data.iter().zip(&other.data).map(|(a, b)| (a - b).abs());
    assert!(off.fold(0.0, f32::max) < 1e-5);
}

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

/// Below white, light comes back, also beyond white of another channel; a pixel with a channel at the sensor's white is
/// limited to the smallest white of a channel after white balance.
#[test]
fn highlights_keep_their_light_up_to_the_sensors_white_and_are_white_there() {
    let folder = Folder::empty();
    let path = folder.join("a.dng");
    let cases: [([f32; 3], [f32; 3]); 6] = [
        ([0.9; 3], [0.9; 3]),
        ([1.5, 0.8, 0.3], [1.5, 0.8, 0.3]),
        ([0.2, 0.5, 1.2], [0.2, 0.5, 1.2]),
        ([2.0, 1.0, 1.5], [1.0; 3]),
        ([1.2, 1.0, 1.5], [1.0; 3]),
        ([2.0, 0.4, 0.2], [1.0, 0.4, 0.2]),
    ];
    for (planted, expected) in cases {
        fs::write(&path, dng(16, 8, |_, _| counted(planted))).unwrap();
        let found = Image::load(&path).unwrap().pixel(7, 3).map(linear_from_srgb);
        for (found, expected) in found.into_iter().zip(expected) {
            assert!((found - expected).abs() < 1e-3, "{planted:?}: {found}, not {expected}");
        }
    }
}

#[test]
fn a_damaged_raw_is_named() {
    let folder = Folder::empty();
    let path = folder.join("a.dng");
    let whole = dng(16, 8, |_, _| [1000; 3]);
    for bytes in [&b"no photograph"[..], &whole[..whole.len() / 2], &whole[..100]] {
        fs::write(&path, bytes).unwrap();
        let message = Image::load(&path).unwrap_err().to_string();
        assert!(message.contains("a.dng") && !message.contains('\n'), "{message}");
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
