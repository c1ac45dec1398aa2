//! Conversion of files in other colour spaces.

mod files;

use crate::image::ImageFile as _;
use std::io::Cursor;

use ::image::{ExtendedColorType, ImageEncoder};

use self::files::*;
use super::super::jpeg::exif_segment;
use super::counters::ColourCounts;
use super::*;

/// Linear colours from nearly black to bright, all within every gamut.
const COLOURS: [[f64; 3]; 6] = [
    [0.0004, 0.0003, 0.0005],
    [0.001, 0.002, 0.0015],
    [0.02, 0.02, 0.02],
    [0.05, 0.01, 0.02],
    [0.1, 0.3, 0.2],
    [0.9, 0.8, 0.95],
];

/// The image of a file's bytes, and the result of its conversion.
fn read(bytes: &[u8]) -> (Image, Conversion) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("file");
    std::fs::write(&path, bytes).unwrap();
    let mut stored = Image::load_as_stored(&path).unwrap();
    let conversion = convert(&mut stored, bytes);
    assert_eq!(stored, Image::load(&path).unwrap());
    (stored, conversion)
}

fn as_stored(bytes: &[u8]) -> Image {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("file");
    std::fs::write(&path, bytes).unwrap();
    Image::load_as_stored(&path).unwrap()
}

/// Asserts that a file contains [`COLOURS`] in sRGB, to a tolerance, converted from a space of this name.
fn holds_the_colours(bytes: &[u8], name: &str, tolerance: f64) {
    let (image, conversion) = read(bytes);
    assert_eq!(
        conversion.from.as_ref().map(|(name, _)| name.as_str()),
        Some(name),
        "{conversion:?}"
    );
    assert_eq!(conversion.unknown, None);
    for (x, linear) in COLOURS.into_iter().enumerate() {
        for (value, linear) in image.pixel(x as u32, 0).into_iter().zip(linear) {
            let expected = TransferFunction::Srgb.encode(linear);
            assert!(
                (f64::from(value) - expected).abs() < tolerance,
                "{name} {x}: {value} for {expected}"
            );
            assert_eq!((value * LEVELS).round() / LEVELS, value);
        }
    }
}

fn in_space(space: [[f64; 2]; 4], curve: TransferFunction) -> Vec<[f64; 3]> {
    COLOURS.map(|linear| encoded(linear, space, curve)).to_vec()
}

/// Every space that cameras and raw converters write, with its encoding and name.
fn spaces() -> [([[f64; 2]; 4], TransferFunction, &'static str); 5] {
    [
        (P3, TransferFunction::Srgb, "Display P3"),
        (ADOBE, TransferFunction::Power(2.199_218_75), "Adobe RGB"),
        (PROPHOTO, TransferFunction::Power(1.8), "ProPhoto RGB"),
        (SRGB, TransferFunction::Power(1.0), "\"of a test\""),
        (SRGB, TransferFunction::Power(2.2), "\"of a test\""),
    ]
}

#[test]
fn a_matrix_profile_restores_the_colours_of_png_and_tiff() {
    for (space, curve, name) in spaces() {
        let (colours, profile) = (in_space(space, curve), matrix_profile(space, curve));
        // Sixteen bits at a gamma of 2.2 are coarse near black.
        holds_the_colours(&png(&colours, &[(b"iCCP", iccp(&profile))]), name, 3e-4);
        holds_the_colours(&tiff(&colours, &profile), name, 3e-4);
    }
}

#[test]
fn the_profile_of_a_webp_is_used() {
    let colours = in_space(ADOBE, TransferFunction::Power(2.199_218_75));
    let bytes: Vec<u8> =
        colours.concat().iter().map(|value| (value * 255.0).round() as u8).collect();
    let mut file = vec![];
    let mut encoder = ::image::codecs::webp::WebPEncoder::new_lossless(&mut file);
    encoder.set_icc_profile(matrix_profile(ADOBE, TransferFunction::Power(2.199_218_75))).unwrap();
    encoder.write_image(&bytes, colours.len() as u32, 1, ExtendedColorType::Rgb8).unwrap();
    let (image, conversion) = read(&file);
    assert_eq!(conversion.from.unwrap().0, "Adobe RGB");
    let expected = TransferFunction::Srgb.encode(COLOURS[4][0]);
    assert!((f64::from(image.pixel(4, 0)[0]) - expected).abs() < 6e-3);
}

/// A JPEG of one dark colour without segments.
fn jpeg(code: u8) -> Vec<u8> {
    let mut file = Cursor::new(vec![]);
    let encoder = ::image::codecs::jpeg::JpegEncoder::new_with_quality(&mut file, 100);
    encoder.write_image(&[code; 3 * 64], 8, 8, ExtendedColorType::Rgb8).unwrap();
    file.into_inner()
}

#[test]
fn the_parts_of_a_profile_are_assembled_in_their_order() {
    let profile = matrix_profile(ADOBE, TransferFunction::Power(2.199_218_75));
    let mut segments = profile_segments(&profile, 100);
    segments.reverse();
    let (image, conversion) = read(&with_segments(&jpeg(10), &segments));
    assert_eq!(conversion.from.unwrap().0, "Adobe RGB");
    let expected = TransferFunction::Srgb.encode((10.0_f64 / 255.0).powf(2.2));
    assert!((f64::from(image.data[0]) - expected).abs() < 3e-4, "{}", image.data[0]);
    segments.pop();
    let (image, conversion) = read(&with_segments(&jpeg(10), &segments));
    assert_eq!(image.data[0], 10.0 / 255.0);
    assert_eq!(conversion.unknown.unwrap(), "an ICC profile with missing parts");
}

#[test]
fn exif_without_a_profile_can_mean_adobe_rgb() {
    let colour = |segment| read(&with_segments(&jpeg(10), &[segment]));
    for (space, index) in [(Some(65535), Some(b"R03\0")), (None, Some(b"R03\0")), (Some(2), None)] {
        let (image, conversion) = colour(exif(space, index));
        assert_eq!(conversion.from.unwrap().0, "Adobe RGB", "{space:?} {index:?}");
        assert!(image.data[0] < 5.0 / 255.0);
    }
    for (space, index) in
        [(Some(1), Some(b"R98\0")), (Some(1), None), (None, Some(b"R98\0")), (None, None)]
    {
        let (image, conversion) = colour(exif(space, index));
        assert_eq!((image.data[0], conversion), (10.0 / 255.0, Conversion::default()));
    }
    let (image, conversion) = colour(exif(Some(65535), None));
    assert_eq!(image.data[0], 10.0 / 255.0);
    assert!(conversion.unknown.unwrap().contains("uncalibrated"));
}

#[test]
fn a_profile_overrides_exif() {
    let srgb = profile_segments(&matrix_profile(SRGB, TransferFunction::Srgb), 60_000);
    let segments = [srgb, vec![exif(Some(65535), Some(b"R03\0"))]].concat();
    let (image, conversion) = read(&with_segments(&jpeg(10), &segments));
    assert_eq!((image.data[0], conversion), (10.0 / 255.0, Conversion::default()));
}

#[test]
fn srgb_values_keep_every_bit() {
    let colours: Vec<[f64; 3]> = (0..256).map(|code| [f64::from(code) / 255.0; 3]).collect();
    let srgb = hundred_thousandths(&SRGB.concat());
    let chunks: [Vec<(&[u8; 4], Vec<u8>)>; 9] = [
        vec![],
        vec![(b"sRGB", vec![0])],
        vec![(b"iCCP", iccp(&matrix_profile(SRGB, TransferFunction::Srgb)))],
        vec![(b"cICP", vec![1, 13, 0, 1])],
        // Frames of clips, from newer and older ffmpeg.
        vec![(b"cICP", vec![1, 1, 0, 1]), (b"gAMA", hundred_thousandths(&[0.50994]))],
        vec![(b"cHRM", srgb.clone()), (b"gAMA", hundred_thousandths(&[0.50994]))],
        vec![(b"gAMA", hundred_thousandths(&[0.45455]))],
        vec![(b"cHRM", srgb)],
        // The sRGB chunk overrides the others.
        vec![(b"sRGB", vec![0]), (b"gAMA", hundred_thousandths(&[1.0]))],
    ];
    for chunks in chunks {
        let file = png(&colours, &chunks);
        let (image, conversion) = read(&file);
        assert_eq!(conversion, Conversion::default(), "{chunks:?}");
        assert_eq!(image, as_stored(&file), "{chunks:?}");
    }
}

#[test]
fn the_chunks_of_a_png_have_the_precedence_of_its_specification() {
    let colours = in_space(P3, TransferFunction::Srgb);
    let p3 = || (b"iCCP", iccp(&matrix_profile(P3, TransferFunction::Srgb)));
    let linear = || (b"gAMA", hundred_thousandths(&[1.0]));
    holds_the_colours(&png(&colours, &[linear(), (b"sRGB", vec![0]), p3()]), "Display P3", 3e-4);
    let cicp = (b"cICP", vec![12, 13, 0, 1]);
    let adobe = (b"iCCP", iccp(&matrix_profile(ADOBE, TransferFunction::Power(2.2))));
    holds_the_colours(&png(&colours, &[adobe, cicp]), "Display P3", 3e-4);
    // After a statement that cannot be used, the next applies.
    let file = png(&colours, &[(b"cICP", vec![9, 16, 0, 1]), p3()]);
    let conversion = read(&file).1;
    assert_eq!(conversion.from.unwrap().0, "Display P3");
    assert!(conversion.unknown.unwrap().contains("high dynamic range"));
}

#[test]
fn gamma_and_chromaticities_convert_without_a_profile() {
    let gamma = |value: f64| (b"gAMA", hundred_thousandths(&[value]));
    let primaries = |space: [[f64; 2]; 4]| (b"cHRM", hundred_thousandths(&space.concat()));
    let file = |space, curve, chunks: &[_]| png(&in_space(space, curve), chunks);
    let linear = file(SRGB, TransferFunction::Power(1.0), &[gamma(1.0)]);
    holds_the_colours(&linear, "sRGB at gamma 1.00", 3e-4);
    let adobe = file(ADOBE, TransferFunction::Power(2.2), &[gamma(0.45455), primaries(ADOBE)]);
    holds_the_colours(&adobe, "Adobe RGB", 3e-4);
    let wide = file(P3, TransferFunction::Srgb, &[primaries(P3)]);
    holds_the_colours(&wide, "Display P3", 3e-4);
    // A frame of a wide-gamut clip.
    let frame = file(P3, TransferFunction::Srgb, &[gamma(0.50994), primaries(P3)]);
    holds_the_colours(&frame, "Display P3", 3e-4);
}

#[test]
fn grey_is_converted_by_its_curve() {
    let file = with_segments(
        &jpeg(10),
        &profile_segments(&grey_profile(TransferFunction::Power(1.8)), 60_000),
    );
    let (image, conversion) = read(&file);
    assert_eq!(conversion.from.unwrap().0, "\"grey\"");
    let expected = TransferFunction::Srgb.encode((10.0_f64 / 255.0).powf(1.8));
    assert!((f64::from(image.data[0]) - expected).abs() < 1e-4);
}

#[test]
fn metadata_that_cannot_be_used_is_named_and_the_values_stay() {
    let whole = matrix_profile(ADOBE, TransferFunction::Power(2.2));
    let cut = &whole[..whole.len() / 2];
    let gamma = hundred_thousandths(&[0.0]);
    let cases: [(&[u8; 4], Vec<u8>, &str); 8] = [
        (b"iCCP", iccp(&table_profile(PROPHOTO, 1.8)), "\"tables\" (no matrix and curves)"),
        (b"iCCP", iccp(&ink_profile()), "\"Coated\" (for Cmyk"),
        (b"iCCP", iccp(cut), "a damaged ICC profile"),
        (b"iCCP", b"name\0\0not deflated".to_vec(), "a damaged ICC profile"),
        (b"cICP", vec![9, 18, 0, 1], "[9, 18, 0, 1] of a cICP chunk (high dynamic range)"),
        (b"cICP", vec![1, 13, 0, 0], "no RGB of full range"),
        (b"gAMA", gamma, "invalid gAMA"),
        (b"cHRM", hundred_thousandths(&[0.0; 8]), "invalid chromaticities"),
    ];
    for (name, data, problem) in cases {
        let file = png(&[[0.1, 0.2, 0.3]], &[(name, data)]);
        let (image, conversion) = read(&file);
        assert!(conversion.unknown.as_ref().unwrap().contains(problem), "{conversion:?}");
        assert_eq!((conversion.from, image), (None, as_stored(&file)));
    }
}

#[test]
fn a_damaged_profile_is_only_ignored() {
    for whole in [matrix_profile(ADOBE, TransferFunction::Power(2.2)), table_profile(PROPHOTO, 1.8)]
    {
        for at in 0..whole.len() {
            let mut damaged = whole.clone();
            damaged[at] ^= 0x5A;
            for bytes in [&damaged, &whole[..at]] {
                let file = with_segments(&jpeg(10), &profile_segments(bytes, 60_000));
                let mut image = Image::filled(2, 1, [0.1, 0.2, 0.3]);
                convert(&mut image, &file);
                assert!(image.data.iter().all(|value| (0.0..=1.0).contains(value)), "{at}");
            }
        }
    }
}

#[test]
fn a_profile_whose_curve_does_not_rise_or_that_is_too_long_is_not_used() {
    let unknown = |profile: &[u8]| {
        let (_, conversion) = read(&png(&[[0.2; 3]], &[(b"iCCP", iccp(profile))]));
        assert_eq!(conversion.from, None);
        conversion.unknown.unwrap()
    };
    let flat = unknown(&matrix_profile(ADOBE, TransferFunction::Power(0.0)));
    assert!(flat.contains("does not rise from 0 to 1"), "{flat}");
    let mut long = matrix_profile(ADOBE, TransferFunction::Power(2.2));
    long.resize((1 << 24) + 1, 0);
    assert!(unknown(&long).contains("more than 16 MB"));
}

#[test]
fn colours_outside_srgb_are_clipped_and_counted() {
    // The green of Adobe RGB, its white, and a grey.
    let colours = [[0.0, 1.0, 0.0], [1.0, 1.0, 1.0], [0.2, 0.2, 0.2], [0.1, 0.1, 0.1]];
    let file =
        png(&colours, &[(b"iCCP", iccp(&matrix_profile(ADOBE, TransferFunction::Power(2.2))))]);
    let (image, conversion) = read(&file);
    assert_eq!(conversion.from.unwrap().1, 0.25);
    assert_eq!(image.pixel(0, 0)[0], 0.0);
    assert!(image.pixel(1, 0).iter().all(|value| (value - 1.0).abs() < 1e-3));
}

#[test]
fn an_exr_of_other_primaries_is_converted_unless_it_contains_numbers() {
    use exr::prelude::{SpecificChannels, Vec2, WritableImage};
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.exr");
    let stored = COLOURS
        .map(|linear| encoded(linear, P3, TransferFunction::Power(1.0)).map(|value| value as f32));
    let channels = SpecificChannels::rgb(|Vec2(x, _): Vec2<usize>| {
        let [red, green, blue] = stored[x];
        (red, green, blue)
    });
    let mut image = exr::image::Image::from_channels((COLOURS.len(), 1), channels);
    let pair = |[x, y]: [f64; 2]| Vec2(x as f32, y as f32);
    let [white, red, green, blue] = P3.map(pair);
    image.attributes.chromaticities =
        Some(exr::meta::attribute::Chromaticities { red, green, blue, white });
    image.write().to_file(&path).unwrap();
    let (loaded, numbers) = (Image::load(&path).unwrap(), Image::load_as_stored(&path).unwrap());
    for (x, linear) in COLOURS.into_iter().enumerate() {
        assert_eq!(numbers.pixel(x as u32, 0), stored[x]);
        for (value, linear) in loaded.pixel(x as u32, 0).into_iter().zip(linear) {
            assert!((f64::from(value) - TransferFunction::Srgb.encode(linear)).abs() < 1e-4, "{x}");
        }
    }
}

#[test]
fn the_exif_of_a_converted_image_is_set_to_srgb() {
    let file = with_segments(&jpeg(10), &[exif(Some(65535), Some(b"R03\0"))]);
    assert_eq!(convert(&mut Image::filled(1, 1, [0.5; 3]), &file).from.unwrap().0, "Adobe RGB");
    let copied = exif_segment(&file).unwrap();
    let again = [&[0xFF, 0xD8], &copied[..], &file[2..]].concat();
    assert_eq!(convert(&mut Image::filled(1, 1, [0.5; 3]), &again), Conversion::default());
}

#[test]
fn many_files_are_reported_in_a_line_for_each_colour_space() {
    let counters = ColourCounts::default();
    for (count, from, unknown) in [
        (3, Some(("Adobe RGB", 0.0)), None),
        (1, Some(("Display P3", 0.12)), None),
        (2, None, Some("a damaged ICC profile")),
        (5, None, None),
    ] {
        for _ in 0..count {
            let from = from.map(|(name, outside): (&str, f64)| (name.to_owned(), outside));
            counters.count(Conversion { from, unknown: unknown.map(str::to_owned) });
        }
    }
    let lines = counters.lines();
    let begins = [
        "3 photographs in Adobe RGB converted to sRGB",
        "1 photograph in Display P3 converted to sRGB",
        "12 % of the pixels of 1 photograph in Display P3",
        "2 photographs with a damaged ICC profile",
    ];
    assert_eq!(lines.len(), begins.len(), "{lines:?}");
    assert!(lines.iter().zip(begins).all(|(line, begin)| line.starts_with(begin)), "{lines:?}");
}
