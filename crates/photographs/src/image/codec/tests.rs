use std::path::PathBuf;

use ::image::{ImageBuffer, Luma, LumaA, Rgb, Rgba};

use super::*;
use nightsplat_core::image::testing::{gradient, worst};

/// A path in a temporary folder, which is removed when the second value is dropped.
fn file(name: &str) -> (PathBuf, tempfile::TempDir) {
    let folder = tempfile::tempdir().unwrap();
    (folder.path().join(name), folder)
}

#[test]
fn every_png_layout_gives_the_same_colours_and_alpha_is_dropped() {
    let (path, _folder) = file("a.png");
    let grey = |x: u32, y: u32| (40 * x + 7 * y) as u8;
    let wide = |x: u32, y: u32| u16::from(grey(x, y)) * 257;
    let transparent = |grey: u8| Rgba([grey, grey, grey, 0]);
    let expected = Image::from_fn(5, 3, |x, y| [f32::from(grey(x, y)) / 255.0; 3]);
    let save: [&dyn Fn() -> ::image::ImageResult<()>; 6] = [
        &|| ImageBuffer::from_fn(5, 3, |x, y| Luma([grey(x, y)])).save(&path),
        &|| ImageBuffer::from_fn(5, 3, |x, y| LumaA([grey(x, y), 9])).save(&path),
        &|| ImageBuffer::from_fn(5, 3, |x, y| Rgb([grey(x, y); 3])).save(&path),
        &|| ImageBuffer::from_fn(5, 3, |x, y| transparent(grey(x, y))).save(&path),
        &|| ImageBuffer::from_fn(5, 3, |x, y| Luma([wide(x, y)])).save(&path),
        &|| ImageBuffer::from_fn(5, 3, |x, y| Rgb([wide(x, y); 3])).save(&path),
    ];
    for (layout, save) in save.iter().enumerate() {
        save().unwrap();
        assert!(worst(&Image::load(&path).unwrap(), &expected) < 1e-7, "layout {layout}");
        assert_eq!(Image::size_of(&path).unwrap(), (5, 3));
    }
}

#[test]
fn a_saved_image_is_loaded_to_the_precision_of_its_format() {
    let image = gradient(7, 5);
    let (path, _folder) = file("a");
    image.save_png8(&path).unwrap();
    assert!(worst(&Image::load(&path).unwrap(), &image) <= 0.5 / 255.0 + 1e-6);
    image.save_png16(&path).unwrap();
    assert!(worst(&Image::load(&path).unwrap(), &image) <= 0.5 / 65_535.0 + 1e-6);
    let bright = |value: &f32| 3.0 * value - 0.5;
    let bright = Image { data: image.data.iter().map(bright).collect(), ..image };
    bright.save_exr(&path).unwrap();
    assert!(worst(&Image::load(&path).unwrap(), &bright) < 1e-5);
    assert_eq!(Image::size_of(&path).unwrap(), (7, 5));
}

#[test]
fn an_exr_is_linear_light_with_its_sign_and_what_is_not_finite_counts_as_black() {
    let (path, _folder) = file("a.exr");
    let values = [0.5_f32, 0.001, f32::NAN, f32::INFINITY, -0.5, 4.0];
    exr::prelude::write_rgb_file(&path, 6, 1, |x, _| (values[x], values[x], values[x])).unwrap();
    let loaded = Image::load(&path).unwrap();
    let expected =
        [0.735_357, 0.012_92, 0.0, 0.0, -0.735_357, 1.055 * 4.0_f32.powf(1.0 / 2.4) - 0.055];
    for (x, expected) in expected.into_iter().enumerate() {
        assert!((loaded.data[x] - expected).abs() < 1e-5, "{}: {}", values[x], loaded.data[x]);
    }
}

#[test]
fn a_grey_exr_is_grey_and_one_without_colour_is_refused() {
    use exr::prelude::{SpecificChannels, Vec2, WritableImage};
    let (path, _folder) = file("a.exr");
    let save = |name: &str| {
        let channels = SpecificChannels::build().with_channel(name);
        let channels = channels.with_pixel_fn(|Vec2(x, _): Vec2<usize>| (0.25_f32 * x as f32,));
        exr::image::Image::from_channels((3, 2), channels).write().to_file(&path).unwrap();
    };
    save("Y");
    let [red, green, blue] = Image::load(&path).unwrap().pixel(2, 1);
    assert!((red - 0.735_357).abs() < 1e-5 && red == green && green == blue);
    save("Z");
    let error = Image::load(&path).unwrap_err().to_string();
    assert!(error.contains("neither R nor Y, but Z;"), "{error}");
}

#[test]
fn the_picture_of_an_exr_with_layers_is_read_where_only_one_can_be_meant() {
    use exr::prelude::{AnyChannel, AnyChannels, FlatSamples, WritableImage};
    let (path, _folder) = file("a.exr");
    let loaded = |groups: &[&str]| {
        let channel = |(value, name): (usize, String)| {
            AnyChannel::new(name.as_str(), FlatSamples::F32(vec![value as f32 / 16.0; 6]))
        };
        let names = groups.iter().flat_map(|group| ["R", "G", "B"].map(|c| format!("{group}{c}")));
        let channels = (1..).zip(names).map(channel).collect();
        let channels = AnyChannels::sort(channels);
        exr::image::Image::from_channels((3, 2), channels).write().to_file(&path).unwrap();
        Image::load(&path).map(|image| image.pixel(2, 1).map(linear_from_srgb))
    };
    let close = |found: [f32; 3], expected: [f32; 3]| {
        found.iter().zip(expected).all(|(a, b)| (a - b / 16.0).abs() < 1e-6)
    };
    assert!(close(loaded(&["ViewLayer.Combined."]).unwrap(), [1.0, 2.0, 3.0]));
    assert!(close(loaded(&["A.Diffuse.", "A.Combined."]).unwrap(), [4.0, 5.0, 6.0]));
    let error = loaded(&["Left.", "Right."]).unwrap_err().to_string();
    assert!(error.contains("but Left.B, Left.G, Left.R, Right.B"), "{error}");
}

#[test]
fn a_file_that_shows_nothing_is_named() {
    let (path, _folder) = file("a");
    let remark = |save: &dyn Fn()| {
        save();
        let file = PictureFile::open(&path).unwrap();
        let decoded = decode(file, Meaning::Colour, &Levels::default());
        decoded.unwrap().remark.unwrap_or_default()
    };
    let exr = |value: &dyn Fn(u32) -> f32| {
        let image = Image::from_fn(4, 1, |x, _| [value(x); 3]);
        remark(&|| image.save_exr_as_stored(&path).unwrap())
    };
    let one = Image::filled(4, 4, [700.0 / 65_535.0; 3]);
    let sixteen = remark(&|| one.save_png16(&path).unwrap());
    assert!(sixteen.contains("every value is 700 of 65535"), "{sixteen}");
    assert_eq!(remark(&|| gradient(4, 4).save_png16(&path).unwrap()), "");
    assert!(exr(&|_| 0.25).contains("every value is 0.25"));
    assert!(exr(&|x| -1.0 - x as f32).contains("every value is negative, -1 at most"));
    assert!(exr(&|x| if x == 1 { f32::NAN } else { x as f32 }).contains("3 values are not finite"));
    assert_eq!(exr(&|x| x as f32 - 1.0), "");
}

#[test]
fn the_error_names_a_file_that_is_not_an_image() {
    let (path, _folder) = file("noise.png");
    assert!(Image::load(&path).unwrap_err().to_string().contains("noise.png: cannot be read"));
    let (exr, _exr_folder) = file("whole.exr");
    gradient(9, 9).save_exr(&exr).unwrap();
    let exr = std::fs::read(exr).unwrap();
    for bytes in [
        &b""[..],
        b"not an image",
        b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR",
        &exr_file::MAGIC,
        &exr[..exr.len() / 2],
    ] {
        std::fs::write(&path, bytes).unwrap();
        let error = Image::load(&path).unwrap_err().to_string();
        assert!(error.contains("noise.png: is not a readable"), "{error}");
    }
}

#[test]
fn images_that_other_programs_convert_name_these() {
    let (path, _folder) = file("a.png");
    for (begin, program) in [
        (&b"\0\0\0\x1cftypheic"[..], "heif-convert"),
        (b"\0\0\0 ftypavif", "avifdec"),
        (b"\xff\x0a\xfa\x1f", "djxl"),
        (b"\0\0\0\x0cJXL \r\n", "djxl"),
        (b"#?RADIANCE\n", "oiiotool"),
    ] {
        std::fs::write(&path, [begin, &[0; 999]].concat()).unwrap();
        let error = Image::load(&path).unwrap_err().to_string();
        assert!(error.contains(program) && error.contains("; convert it"), "{error}");
    }
}

#[test]
fn of_a_file_that_is_no_image_only_the_beginning_is_read() {
    let (path, _folder) = file("a.png");
    std::fs::File::create(&path).unwrap().set_len(1 << 30).unwrap();
    let opened = PictureFile::open(&path).unwrap();
    assert_eq!(opened.bytes.len() as u64, START);
    let error = opened.decode().unwrap_err().to_string();
    assert!(error.contains("a.png: is not a readable PNG"), "{error}");
}

#[test]
fn a_png_of_sixteen_bits_that_is_interlaced_is_read() {
    let (path, _folder) = file("a.png");
    let mut encoder = png::Encoder::new(std::fs::File::create(&path).unwrap(), 1, 1);
    encoder.set_color(png::ColorType::Grayscale);
    encoder.set_depth(png::BitDepth::Sixteen);
    encoder.write_header().unwrap().write_image_data(&[0x12, 0x34]).unwrap();
    let mut bytes = std::fs::read(&path).unwrap();
    // A single pixel is the first pass, whole.
    bytes[28] = 1;
    let mut crc = flate2::Crc::new();
    crc.update(&bytes[12..29]);
    bytes[29..33].copy_from_slice(&crc.sum().to_be_bytes());
    std::fs::write(&path, bytes).unwrap();
    let value = Image::load(&path).unwrap().data[0];
    assert_eq!(value.to_bits(), (f32::from(0x1234_u16) / 65_535.0).to_bits());
}

#[test]
fn a_failed_write_leaves_no_file() {
    let (path, folder) = file("taken");
    std::fs::create_dir(&path).unwrap();
    let error = gradient(4, 4).save_png8(&path).unwrap_err();
    assert!(
        matches!(&error, Error::Output { .. }) && error.to_string().contains("taken"),
        "{error}"
    );
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
}

#[test]
fn a_file_of_any_length_is_refused_by_its_header() {
    let (path, _folder) = file("a.png");
    Image::filled(16, 16, [0.5; 3]).save_png8(&path).unwrap();
    let png = std::fs::read(&path).unwrap();
    let mut bomb = png.clone();
    bomb[16..24].copy_from_slice(&[0, 0, 0x4E, 0x20, 0, 0, 0x4E, 0x20]);
    for (start, part) in [
        (&bomb[..], "declares 20000x20000"),
        (&png[..], "has 8192 GiB for 256 pixels"),
        (&b"\xFF\xD8\xFF"[..], "this JPEG is truncated"),
        (&exr_file::MAGIC[..], "is not a readable"),
        (&b"II*\0"[..], "is not a readable"),
        (&b"RIFF\0\0\0\0WEBPVP8 "[..], "is not a readable"),
        (&b"no image"[..], "is not a readable"),
    ] {
        std::fs::write(&path, start).unwrap();
        // More than there is memory.
        std::fs::File::options().write(true).open(&path).unwrap().set_len(1 << 43).unwrap();
        let message = Image::load(&path).unwrap_err().to_string();
        assert!(message.contains(part), "{part}: {message}");
        assert!(Image::size_of(&path).is_err() || part.contains("pixels") || start == bomb);
    }
}
