//! Levels of the files of a set: the same for all of its photographs.

use nightsplat_photographs::image::{StoredLight, linear_from_srgb, srgb_from_linear};

use super::*;

/// A dataset of 17 photographs in 16 bits, of codes by photograph and pixel.
fn set(code: impl Fn(usize, u32) -> u16) -> Folder {
    let root = Folder::empty();
    fs::create_dir(root.join("images")).unwrap();
    for index in 0..17 {
        let path = root.join("images").join(name(index)).with_extension("png");
        let pixel = |x, y| Rgb([code(index, SIZE.0 * y + x); 3]);
        ImageBuffer::from_fn(SIZE.0, SIZE.1, pixel).save(path).unwrap();
    }
    model(17).write_text(&root.join("sparse/0"));
    root
}

/// The values of a view's photograph at two pixels.
fn values(root: &Path, light: Option<StoredLight>, downscale: f64) -> [f32; 2] {
    let dataset = load_with(root, LoadOptions { light, downscale, ..Default::default() });
    let view = view(&dataset, "v02");
    let whole = view.photograph().unwrap().unwrap();
    [0, 77].map(|pixel| whole.data[pixel])
}

#[test]
fn sensor_values_in_16_bits_have_their_white_and_are_linear_if_told_so() {
    let root = set(|index, pixel| (pixel % 40) as u16 + index as u16);
    let light = [2.0, 77.0 % 40.0 + 2.0];
    // From memory, and decoded again.
    for downscale in [1.0, 1.5] {
        let close = |found: [f32; 2], expected: [f32; 2]| {
            let is_close = found.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-6);
            assert!(is_close, "{found:?}, not {expected:?}");
        };
        close(values(&root, None, downscale), light.map(|code| code / 4095.0));
        // Light is reduced when it is loaded.
        if downscale == 1.0 {
            let linear = light.map(|code| srgb_from_linear(code / 4095.0));
            close(values(&root, Some(StoredLight::Linear), downscale), linear);
        }
        close(values(&root, Some(StoredLight::Srgb), downscale), light.map(|code| code / 65_535.0));
    }
}

#[test]
fn a_photograph_beyond_the_levels_that_others_show_restores_those_of_the_format() {
    let root = set(|index, pixel| (pixel % 40) as u16 + if index == 4 { 6000 } else { 2 });
    let found = values(&root, None, 1.0);
    assert!((found[1] - 39.0 / 65_535.0).abs() < 1e-7, "{found:?}");
}

/// Noise at black keeps its mean, kept in memory or decoded again; no curve is applied to it before.
#[test]
fn photographs_of_linear_light_are_shrunk_in_light() {
    let root = Folder::empty();
    fs::create_dir(root.join("images")).unwrap();
    let light = |x, y| if (x + 3 * y) % 4 == 0 { 0.09 } else { -0.01 };
    for index in 0..9 {
        let path = root.join("images").join(name(index)).with_extension("exr");
        exr::prelude::write_rgb_file(path, SIZE.0 as usize, SIZE.1 as usize, |x, y| {
            (light(x, y), light(x, y), light(x, y))
        })
        .unwrap();
    }
    model(9).write_text(&root.join("sparse/0"));
    for keep in [None, Some(0)] {
        let dataset = load_with(&root, LoadOptions { keep, downscale: 1.25, ..Default::default() });
        let view = view(&dataset, "v03");
        for image in [view.loaded().unwrap().unwrap(), view.photograph().unwrap().unwrap()] {
            assert_eq!((image.width, image.height), (32, 24));
            let sum: f32 = image.data.iter().map(|&x| linear_from_srgb(x)).sum();
            let mean = sum / image.data.len() as f32;
            assert!((mean - 0.015).abs() < 1e-4, "{mean}");
        }
    }
}
