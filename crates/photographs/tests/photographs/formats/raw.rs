//! Camera RAW: a minimal file, and its linear light.

use std::fs;

use nightsplat_photographs::image::{Image, ImageFile as _, linear_from_srgb, srgb_from_linear};

use self::dng::{counted, dng};
use crate::common::Folder;

#[path = "dng.rs"]
mod dng;

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
