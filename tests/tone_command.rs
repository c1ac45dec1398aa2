//! `nightsplat tone`, in process.
#![cfg(feature = "cli")]

use std::path::{Path, PathBuf};

use nightsplat::Error;
use nightsplat::cli::ImageFormat;
use nightsplat::cli::tone::{ToneArgs, apply};
use nightsplat::image::Image;
use nightsplat::tone::{Statistics, ToneCurve, ToneSettings};

fn args(input: &Path, out: PathBuf) -> ToneArgs {
    ToneArgs {
        input: input.to_owned(),
        curve: ToneCurve::Ap3,
        out,
        gain: None,
        theta: 0.49,
        json: false,
        format: ImageFormat::Png,
        device: None,
    }
}

/// A dark gradient.
fn dark(width: u32, height: u32) -> Image {
    Image::from_fn(width, height, |x, y| [x, y, x + y].map(|v| (v % 32) as f32 / 255.0))
}

#[test]
fn a_folder_is_mapped_by_name_and_what_cannot_be_read_is_left_out() {
    let dir = tempfile::tempdir().unwrap();
    let photographs = dir.path().join("photographs");
    std::fs::create_dir(&photographs).unwrap();
    dark(40, 30).save_png8(photographs.join("a.PNG")).unwrap();
    dark(7, 90).save_png16(photographs.join("b.png")).unwrap();
    dark(16, 16).save_exr(photographs.join("c.exr")).unwrap();
    std::fs::write(photographs.join("broken.jpg"), b"no image").unwrap();
    std::fs::write(photographs.join("notes.txt"), b"no image either").unwrap();
    for curve in ToneCurve::ALL {
        let out = dir.path().join(curve.name());
        let args =
            ToneArgs { curve, gain: Some(2.0), theta: 0.4, ..args(&photographs, out.clone()) };
        let views = apply(&args).unwrap();
        assert_eq!(views.keys().collect::<Vec<_>>(), ["a", "b", "c"]);
        let settings = ToneSettings { gain_c: 2.0, theta: 0.4, ..ToneSettings::new(curve) };
        for (name, file) in [("a", "a.PNG"), ("b", "b.png"), ("c", "c.exr")] {
            let image = Image::load(photographs.join(file)).unwrap();
            let statistics = Statistics::of(&image.data);
            assert_eq!([views[name].p10, views[name].p90], [statistics.p10, statistics.p90]);
            assert!((views[name].delta0 - settings.offset(statistics.ratio())).abs() < 1e-6);
            let parameters = settings.parameters(&statistics);
            let mapped = Image::load(out.join(name).with_extension("png")).unwrap();
            assert_eq!((mapped.width, mapped.height), (image.width, image.height));
            for (&x, y) in image.data.iter().zip(&mapped.data) {
                // Half a code value of the 8-bit file.
                assert!((curve.apply(x, &parameters) - y).abs() < 0.51 / 255.0, "{curve} {name}");
            }
        }
    }
}

#[test]
fn exr_keeps_what_8_bits_round_and_clipping_is_counted() {
    let dir = tempfile::tempdir().unwrap();
    let photograph = dir.path().join("one.png");
    let mut image = dark(10, 10);
    image.data[..30].fill(1.0);
    image.save_png8(&photograph).unwrap();
    let image = Image::load(&photograph).unwrap();
    let linear = ToneArgs {
        curve: ToneCurve::Linear,
        format: ImageFormat::Exr,
        ..args(&photograph, dir.path().join("out"))
    };
    let views = apply(&linear).unwrap();
    let settings = ToneSettings::new(ToneCurve::Linear);
    let parameters = settings.parameters(&Statistics::of(&image.data));
    let expected: Vec<f32> =
        image.data.iter().map(|&x| settings.curve.apply(x, &parameters)).collect();
    let mapped = Image::load(dir.path().join("out/one.exr")).unwrap();
    for (a, b) in mapped.data.iter().zip(&expected) {
        assert!((a - b).abs() < 1e-5, "{a}, not {b}");
    }
    let clipped = expected.iter().filter(|&&y| y == 1.0).count();
    assert!(clipped >= 30);
    assert_eq!(views["one"].clipped_fraction, clipped as f64 / 300.0);
}

#[test]
fn bad_input_is_named_in_one_line() {
    let dir = tempfile::tempdir().unwrap();
    let path = |name: &str| dir.path().join(name);
    let out = path("out");
    let fails = |args: ToneArgs, part: &str, code: u8| {
        let error = apply(&args).unwrap_err();
        let message = error.to_string();
        assert!(message.contains(part) && !message.contains('\n'), "{message}");
        assert_eq!(error.exit_code(), code, "{message}");
    };
    fails(args(&path("absent"), out.clone()), "absent", 1);

    std::fs::create_dir(path("empty")).unwrap();
    fails(args(&path("empty"), out.clone()), "no PNG, JPEG or EXR", 1);

    std::fs::write(path("broken.png"), b"no image").unwrap();
    fails(args(&path("broken.png"), out.clone()), "broken.png", 1);

    std::fs::create_dir(path("all_broken")).unwrap();
    for name in ["all_broken/a.png", "all_broken/b.png"] {
        std::fs::write(path(name), b"no image").unwrap();
    }
    fails(args(&path("all_broken"), out.clone()), "b.png", 1);

    std::fs::create_dir(path("twins")).unwrap();
    dark(4, 4).save_png8(path("twins/a.png")).unwrap();
    dark(4, 4).save_exr(path("twins/a.exr")).unwrap();
    fails(args(&path("twins"), out.clone()), "same file", 1);

    dark(4, 4).save_png8(path("good.png")).unwrap();
    let before = std::fs::read(path("good.png")).unwrap();
    fails(args(&path("good.png"), dir.path().to_owned()), "is one of the photographs", 1);
    assert_eq!(std::fs::read(path("good.png")).unwrap(), before);

    fails(args(&path("good.png"), path("broken.png")), "cannot be made", 1);
    fails(ToneArgs { gain: Some(-1.0), ..args(&path("good.png"), out.clone()) }, "--gain", 2);
    fails(ToneArgs { theta: f64::NAN, ..args(&path("good.png"), out) }, "--theta", 2);
}

#[test]
fn a_photograph_that_exceeds_a_binding_is_named_with_the_limit() {
    let device = nightsplat::gpu::Gpu::new(&Default::default()).unwrap();
    // lavapipe binds 128 MiB; this takes 139 MB as floats.
    if device.properties().max_storage_buffer_range > 139_000_000 {
        println!("skipped: {} binds more", device.properties().name);
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let photograph = dir.path().join("vast.png");
    Image::filled(4000, 2900, [0.1; 3]).save_png8(&photograph).unwrap();
    let error = apply(&args(&photograph, dir.path().join("out"))).unwrap_err();
    assert!(matches!(error, Error::Input { .. }), "{error}");
    assert!(error.to_string().contains("4000x2900"), "{error}");
}

#[test]
fn an_unknown_curve_is_misuse_and_lists_the_curves() {
    #[derive(Debug, clap::Parser)]
    struct Command {
        #[command(flatten)]
        tone: ToneArgs,
    }
    let parse = |curve: &str| {
        <Command as clap::Parser>::try_parse_from(["tone", "in", "--out", "out", "--curve", curve])
    };
    assert_eq!(parse("ase").unwrap().tone.curve, ToneCurve::Ase);
    let error = parse("gamma").unwrap_err();
    assert_eq!(error.exit_code(), 2);
    assert!(error.to_string().contains("linear, ase, ap3, none"), "{error}");
    assert!(matches!("gamma".parse::<ToneCurve>(), Err(Error::Usage(_))));
}
