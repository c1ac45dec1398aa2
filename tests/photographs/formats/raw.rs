//! Camera RAW: a minimal file, its linear light, and training on it.

use std::fs;

use nightsplat::photographs::dataset::synthetic::{self, SyntheticOptions};
use nightsplat::photographs::image::{Image, linear_from_srgb, srgb_from_linear};

use crate::common::command::succeed;

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
fn dng(width: u16, height: u16, pixel: impl Fn(u16, u16) -> [u16; 3]) -> Vec<u8> {
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
        .flat_map(|(x, y)| pixel(x, y))
        .flat_map(u16::to_le_bytes)
        .collect();
    // From XYZ to the camera's colours, which are sRGB's.
    let matrix = [32405, -15371, -4985, -9693, 18760, 416, 556, -2040, 10572].map(|v| [v, 10_000]);
    let mut entries = vec![
        (254, long(0)),
        (256, long(width.into())),
        (257, long(height.into())),
        (258, short(&[16; 3])),
        (259, short(&[1])),
        (262, short(&[34892])),
        (271, text("Test")),
        (272, text("Linear")),
        (273, long(8)),
        (274, short(&[1])),
        (277, short(&[3])),
        (278, long(height.into())),
        (279, long(pixels.len() as u32)),
        (284, short(&[1])),
        (50706, bytes(&[1, 4, 0, 0])),
        (50707, bytes(&[1, 1, 0, 0])),
        (50708, text("Test Linear")),
        (50714, short(&[BLACK; 3])),
        (50717, short(&[WHITE; 3])),
        (50721, rational(10, &matrix)),
        (50728, rational(5, &[[1, 2], [1, 1], [2, 3]])),
        (50778, short(&[21])),
    ];
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
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.dng");
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
    let exr = folder.path().join("a.exr");
    image.save_exr(&exr).unwrap();
    let other = Image::load(&exr).unwrap();
    let off = image.data.iter().zip(&other.data).map(|(a, b)| (a - b).abs());
    assert!(off.fold(0.0, f32::max) < 1e-5);
}

#[test]
fn a_damaged_raw_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.dng");
    let whole = dng(16, 8, |_, _| [1000; 3]);
    for bytes in [&b"no photograph"[..], &whole[..whole.len() / 2], &whole[..100]] {
        fs::write(&path, bytes).unwrap();
        let message = Image::load(&path).unwrap_err().to_string();
        assert!(message.contains("a.dng") && !message.contains('\n'), "{message}");
    }
}

/// The score after a few steps of training on a dataset.
fn trained(set: &std::path::Path) -> f64 {
    let out = set.with_extension("run");
    let options = "--steps 60 --sh-degree 0 --model plain --curve auto --progress none";
    succeed(&format!("train {} --out {} {options}", set.display(), out.display()));
    let metrics: serde_json::Value =
        serde_json::from_slice(&fs::read(out.join("metrics.json")).unwrap()).unwrap();
    metrics["mean"]["psnr"].as_f64().unwrap()
}

#[test]
fn photographs_in_raw_train_as_the_same_light_in_another_format() {
    let folder = tempfile::tempdir().unwrap();
    let [encoded, raw] = ["encoded", "raw"].map(|name| folder.path().join(name));
    let options =
        SyntheticOptions { views: 9, width: 48, height: 36, ..SyntheticOptions::default() };
    for set in [&encoded, &raw] {
        synthetic::write(set, &options).unwrap();
    }
    let mut count = 0;
    for entry in fs::read_dir(raw.join("low")).unwrap() {
        let path = entry.unwrap().path();
        let image = Image::load(&path).unwrap();
        let light = |x: u16, y: u16| image.pixel(x.into(), y.into()).map(linear_from_srgb);
        let (width, height) = (image.width as u16, image.height as u16);
        fs::write(path.with_extension("dng"), dng(width, height, |x, y| counted(light(x, y))))
            .unwrap();
        fs::remove_file(&path).unwrap();
        count += 1;
    }
    assert!(count >= 8);
    let (encoded, raw) = (trained(&encoded), trained(&raw));
    assert!((encoded - raw).abs() < 0.1, "{encoded} dB of PNG, {raw} dB of RAW");
}
