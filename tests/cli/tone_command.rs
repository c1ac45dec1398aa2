//! `nightsplat tone`, in process.

use clap::Parser as _;
use nightsplat::cli::tone::apply::{ApplyArgs, apply};
use nightsplat::results::toned::ToneReport;
use nightsplat_photographs::image::srgb_from_linear;
use nightsplat_photographs::metrics::psnr;

use crate::common::prelude::*;

#[derive(Debug, clap::Parser)]
struct ToneApply {
    #[command(flatten)]
    args: ApplyArgs,
}

/// `tone apply INPUT` with these options.
fn automatic(input: &Path, options: &str) -> ApplyArgs {
    let words = ["apply".as_ref(), input.as_os_str()].into_iter();
    ToneApply::parse_from(words.chain(options.split_whitespace().map(AsRef::as_ref))).args
}

/// `tone apply INPUT --curve ap3 --out OUT` with these options.
fn args(input: &Path, out: &Path, options: &str) -> ApplyArgs {
    let curve = if options.contains("--curve") { "" } else { "--curve ap3" };
    automatic(input, &format!("--out {} {curve} {options}", out.display()))
}

/// A folder with one of photographs in `photographs`.
fn folder_of(photographs: &[(&str, Image)]) -> Folder {
    let folder = Folder::empty();
    fs::create_dir(folder.join("photographs")).unwrap();
    for (name, image) in photographs {
        image.save_png8(folder.join("photographs").join(name)).unwrap();
    }
    folder
}

/// A dark gradient.
fn dark(width: u32, height: u32) -> Image {
    Image::from_fn(width, height, |x, y| [x, y, x + y].map(|v| (v % 32) as f32 / 255.0))
}

#[test]
fn a_folder_is_mapped_by_name_and_unreadable_files_are_left_out() {
    let dir = folder_of(&[("a.PNG", dark(40, 30))]);
    let photographs = dir.join("photographs");
    dark(7, 90).save_png16(photographs.join("b.png")).unwrap();
    dark(16, 16).save_exr(photographs.join("c.exr")).unwrap();
    fs::write(photographs.join("broken.jpg"), b"no image").unwrap();
    fs::write(photographs.join("notes.txt"), b"no image either").unwrap();
    for curve in [ToneCurve::Linear, ToneCurve::Ase, ToneCurve::Ap3, ToneCurve::Hybrid] {
        let out = dir.join(curve.name());
        let args = args(&photographs, &out, &format!("--curve {curve} --gain 2 --theta 0.4"));
        let views = apply(&args).unwrap().views;
        assert_eq!(views.keys().collect::<Vec<_>>(), ["a", "b", "c"]);
        let settings = ToneSettings { gain_c: 2.0, theta: 0.4, ..ToneSettings::new(curve) };
        for (name, file) in [("a", "a.PNG"), ("b", "b.png"), ("c", "c.exr")] {
            let image = Image::load(photographs.join(file)).unwrap();
            let statistics = Statistics::new(&image.data);
            let before = views[name].before;
            assert_eq!([before.p10, before.p90], statistics.percentiles());
            // Curves without a black level have no delta0.
            let black_level = settings.offset(statistics.printed_ratio());
            let is_raised = matches!(curve, ToneCurve::Ase | ToneCurve::Ap3);
            assert_eq!(views[name].delta0, is_raised.then_some(black_level), "{curve}");
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
fn exr_is_not_rounded_and_what_is_near_white_is_counted() {
    let dir = Folder::empty();
    let photograph = dir.join("one.png");
    let mut image = dark(10, 10);
    image.data[..30].fill(1.0);
    image.save_png8(&photograph).unwrap();
    let image = Image::load(&photograph).unwrap();
    let out = dir.join("out");
    let linear = args(&photograph, &out, "--curve linear --format exr");
    let views = apply(&linear).unwrap().views;
    let settings = ToneSettings::new(ToneCurve::Linear);
    let parameters = settings.parameters(&Statistics::new(&image.data));
    let expected: Vec<f32> =
        image.data.iter().map(|&x| settings.curve.apply(x, &parameters)).collect();
    let mapped = Image::load(dir.join("out/one.exr")).unwrap();
    for (a, b) in mapped.data.iter().zip(&expected) {
        assert!((a - b).abs() < 1e-5, "{a}, not {b}");
    }
    let near_white = expected.iter().filter(|&&y| y >= 0.94).count();
    assert!(near_white >= 30);
    assert_eq!(views["one"].after.near_white_fraction, near_white as f64 / 300.0);
    assert_eq!(views["one"].before.near_white_fraction, 0.1);
}

#[test]
fn bad_input_is_named_in_one_line() {
    let dir = Folder::empty();
    let path = |name: &str| dir.join(name);
    let out = path("out");
    let fails = |args: ApplyArgs, part: &str, code: u8| {
        let error = apply(&args).unwrap_err();
        let message = error.to_string();
        assert!(message.contains(part) && !message.contains('\n'), "{message}");
        assert_eq!(error.exit_code(), code, "{message}");
    };
    for folder in ["empty", "all_broken", "twins"] {
        fs::create_dir(path(folder)).unwrap();
    }
    for name in ["broken.png", "all_broken/a.png", "all_broken/b.png"] {
        fs::write(path(name), b"no image").unwrap();
    }
    dark(4, 4).save_png8(path("twins/a.png")).unwrap();
    dark(4, 4).save_exr(path("twins/a.exr")).unwrap();
    for (name, part) in [
        ("absent", "absent"),
        ("empty", "no PNG, JPEG, WebP, TIFF or EXR"),
        ("broken.png", "broken.png"),
        ("all_broken", "b.png"),
        ("twins", "same file"),
    ] {
        fails(args(&path(name), &out, ""), part, 3);
    }
    dark(4, 4).save_png8(path("good.png")).unwrap();
    let before = fs::read(path("good.png")).unwrap();
    fails(args(&path("good.png"), &dir, ""), "is one of the photographs", 1);
    assert_eq!(fs::read(path("good.png")).unwrap(), before);

    fails(args(&path("good.png"), &path("broken.png"), ""), "cannot be created", 1);
    fails(args(&path("good.png"), &out, "--gain=-1"), "tone.gain_c", 2);
    fails(args(&path("good.png"), &out, "--theta=nan"), "tone.theta", 2);
}

/// A dark and a normal-light folder of three photographs.
fn pairs(dir: &Path) -> [PathBuf; 2] {
    let folders = ["dark", "bright"].map(|name| dir.join(name));
    for (folder, gain) in folders.iter().zip([1.0, 6.0]) {
        fs::create_dir(folder).unwrap();
        for (name, shift) in [("a", 0), ("b", 5), ("c", 9)] {
            let mut image = dark(40 + shift, 30);
            image.data.iter_mut().for_each(|value| *value *= gain);
            image.save_png8(folder.join(format!("{name}.png"))).unwrap();
        }
    }
    folders
}

#[test]
fn references_give_scores_and_the_page_shows_the_distributions() {
    let dir = Folder::empty();
    let [low, high] = pairs(&dir);
    let page = dir.join("page.html");
    let options = format!(
        "--reference {} --report {} --compare linear,lum_preserve",
        high.display(),
        page.display()
    );
    let args = args(&low, &dir.join("out"), &options);
    let output = apply(&args).unwrap();
    let scores: Vec<f64> = output.views.values().map(|view| view.scores.unwrap().psnr).collect();
    let mean = scores.iter().sum::<f64>() / 3.0;
    assert!((output.scene.scores.unwrap().psnr - mean).abs() < 1e-9 && mean > 10.0);
    let html = fs::read_to_string(&page).unwrap();
    for name in ["photograph", "ap3", "linear", "lum_preserve", "reference"] {
        assert!(html.contains(&format!("{name} (skewness")), "{name}");
    }
    assert!(html.contains("<polyline") && html.contains("dB, SSIM"));
    let json = serde_json::to_value(&output).unwrap();
    let keys = "p10 p90 r delta0 mean_luminance psnr ssim skewness near_white_fraction";
    for key in keys.split(' ') {
        assert!(json["scene"][key].is_number() && json["views"]["a"][key].is_number(), "{key}");
    }
    assert!(json["views"]["b"]["after"]["skewness"].is_number());

    // A file of another size is not a reference.
    dark(9, 9).save_png8(high.join("b.png")).unwrap();
    let error = apply(&args).unwrap_err().to_string();
    says(&error, &["b.png", "9x9", "45x30"]);
}

#[test]
fn the_page_shows_every_photograph_and_tables_have_what_the_curve_uses() {
    let names = ["1.png", "2.png", "10.png", "11.png", "9.png"];
    let dir = folder_of(&names.map(|name| (name, dark(40, 30))));
    dir.write("curve.csv", "0,0\n1,0.7\n2,1\n");
    let printed = |curve: &str| {
        dir.succeed(&format!("tone apply @photographs --curve {curve} --report @page.html"))
    };
    let ap3 = printed("ap3");
    let html = dir.text("page.html");
    assert_eq!(html.matches("data:image/jpeg").count(), 10, "five photographs, dark and lit");
    for text in [&ap3, &html] {
        let at = |name: &str| text.find(name).unwrap();
        assert!(text.contains("delta0") && !text.contains("PSNR"), "{text}");
        assert!(text.contains("lit white %"), "{text}");
        let [nine, ten] = match text.contains("<html") {
            true => ["alt=\"9, lit\"", "alt=\"10, lit\""].map(at),
            false => ["\n9 ", "\n10 "].map(at),
        };
        assert!(nine < ten, "{text}");
    }
    let of_table = printed("@curve.csv");
    assert!(!of_table.contains("delta0") && !of_table.contains(" r "), "{of_table}");
}

#[test]
fn scene_statistics_give_every_photograph_one_curve() {
    let dir = Folder::empty();
    let [low, _] = pairs(&dir);
    dark(40, 30).save_png8(low.join("b.png")).unwrap();
    let out = dir.join("out");
    for scene_statistics in [false, true] {
        let options = if scene_statistics { "--scene-statistics" } else { "" };
        let args = args(&low, &out, &format!("--format exr {options}"));
        let output = apply(&args).unwrap();
        let statistics = ["a", "b", "c"].map(|name| {
            Statistics::new(&Image::load(low.join(name).with_extension("png")).unwrap().data)
        });
        let scene = Statistics::mean_of(&statistics).unwrap();
        for (name, of_photograph) in ["a", "b", "c"].into_iter().zip(&statistics) {
            let used = if scene_statistics { &scene } else { of_photograph };
            let parameters = output.curve.parameters(used);
            let photograph = Image::load(low.join(name).with_extension("png")).unwrap();
            let mapped = Image::load(out.join(name).with_extension("exr")).unwrap();
            for (&x, y) in photograph.data.iter().zip(&mapped.data) {
                assert!((ToneCurve::Ap3.apply(x, &parameters) - y).abs() < 1e-5, "{name}");
            }
        }
    }
}

#[test]
fn a_dataset_is_measured_on_training_views_and_scored_on_test_views() {
    let set = written(&SyntheticOptions { width: 48, height: 36, ..Default::default() });
    let output = apply(&automatic(&set, "--curve ap3")).unwrap();
    assert!(output.scene.scores.is_some());
    let (test, training): (Vec<ToneReport>, Vec<ToneReport>) =
        output.views.into_values().partition(|view| view.scores.is_some());
    assert!(!test.is_empty() && training.len() > test.len());
    let p90 = training.iter().map(|view| view.before.p90).sum::<f64>() / training.len() as f64;
    assert!((output.scene.before.p90 - p90).abs() < 1e-12);
}

#[test]
fn values_that_are_not_finite_are_counted_and_excluded_from_the_statistics() {
    let dir = Folder::empty();
    let path = dir.join("gaps.exr");
    let value = |x: usize| match x % 10 {
        3 => f32::NAN,
        5 => f32::INFINITY,
        _ => 0.01,
    };
    exr::prelude::write_rgb_file(&path, 40, 10, |x, _| (0.02, value(x), 0.03)).unwrap();
    let clean = dir.join("clean.exr");
    exr::prelude::write_rgb_file(&clean, 32, 10, |_, _| (0.02_f32, 0.01, 0.03)).unwrap();
    let run = |path: &Path| apply(&args(path, &dir.join("out"), "")).unwrap().scene;
    let (found, expected) = (run(&path), run(&clean));
    assert_eq!((found.unusable_pixels, expected.unusable_pixels), (80, 0));
    assert_eq!((found.before.p10, found.before.p90), (expected.before.p10, expected.before.p90));
    assert!((found.before.mean_luminance - expected.before.mean_luminance).abs() < 1e-7);

    exr::prelude::write_rgb_file(&path, 4, 4, |_, _| (f32::NAN, 0.0, 0.0)).unwrap();
    let error = apply(&args(&path, &dir.join("out"), "")).unwrap_err().to_string();
    assert!(error.contains("no finite, unmasked pixel"), "{error}");
}

#[test]
fn degenerate_photographs_have_defined_results_under_every_kind_of_curve() {
    let plain = |name, size, value| (name, Image::filled(size, size, [value; 3]));
    let dir = folder_of(&[
        plain("black.png", 20, 0.0),
        plain("white.png", 20, 1.0),
        plain("grey.png", 20, 0.03),
        plain("pixel.png", 1, 0.2),
    ]);
    let (photographs, table) = (dir.join("photographs"), dir.join("curve.csv"));
    dir.write("curve.csv", "0,0\n1,0.7\n2,1\n");
    let named = [
        ToneCurve::Linear,
        ToneCurve::Ap3,
        ToneCurve::SinhRatio,
        ToneCurve::P80,
        ToneCurve::LumPreserve,
        ToneCurve::PerChannel,
    ];
    let table = table.display().to_string();
    for curve in named.map(|curve| curve.to_string()).into_iter().chain([table]) {
        let args = args(&photographs, &dir.join("out"), &format!("--curve {curve}"));
        let output = apply(&args).unwrap();
        let text = serde_json::to_string(&output).unwrap();
        assert!(!text.contains("null"), "{text}");
        assert!(output.views["black"].after.mean < 0.01, "{text}");
        assert!(output.views["white"].after.mean > 0.4, "{text}");
    }
}

#[test]
fn the_automatic_curve_reports_its_brightness_which_other_curves_can_use() {
    let dir = Folder::empty();
    let [low, _] = pairs(&dir);
    // Grey: the rule is about the curve of the luminance, which for colours differs from the luminance of the curve.
    for name in ["a", "b", "c"] {
        let path = low.join(name).with_extension("png");
        let mut image = Image::load(&path).unwrap();
        let pixels = image.pixel_count();
        image.data.copy_within(0..pixels, pixels);
        image.data.copy_within(0..pixels, 2 * pixels);
        image.save_png8(path).unwrap();
    }
    let output = apply(&automatic(&low, "")).unwrap();
    let exposure = output.exposure.unwrap();
    assert!(exposure.reason().contains("gain"), "{}", exposure.reason());
    assert_eq!(output.curve.colour, 0.0, "single pictures keep their curve");
    let means: Vec<f64> = output.views.values().map(|view| view.after.mean_luminance).collect();
    assert!(means.iter().all(|mean| (0.43..0.55).contains(mean)), "{means:?}");
    let json = serde_json::to_value(apply(&automatic(&low, "")).unwrap()).unwrap();
    for key in ["gain", "target", "mean", "brightening", "weight", "spread", "share", "black"] {
        assert!(json["exposure"][key].is_number(), "{key}");
    }
    assert!(json["views"]["a"]["gain"].is_number() && json["exposure"]["reason"].is_string());
    // Every curve with a gain has the same brightness, or a requested one.
    for curve in [ToneCurve::Ase, ToneCurve::Ap3, ToneCurve::Linear, ToneCurve::Gamma] {
        let lent = format!("--curve {curve} --gain auto");
        let views = apply(&automatic(&low, &lent)).unwrap().views;
        for (view, mean) in views.values().zip(&means) {
            let found = view.after.mean_luminance;
            assert!((found - mean).abs() < 0.006, "{curve}: {found}, not {mean}");
        }
        let brighter = apply(&automatic(&low, &format!("{lent} --brightness 0.6"))).unwrap();
        let found = brighter.scene.after.mean_luminance;
        assert!((found - 0.6).abs() < 0.02, "{curve}: {found}");
    }
}

#[test]
fn targets_of_linear_light_are_equally_bright_for_any_exposure() {
    let dir = Folder::empty();
    // Scene-referred light over two decades, as in camera RAW; the sensor receives a part of it.
    let light = |x: u32, y: u32| 10.0_f32.powf(-2.0 * ((7 * x + 11 * y) % 40) as f32 / 40.0);
    let target = |exposure: f32| {
        let [folder, out] = ["dark", "out"].map(|name| dir.join(format!("{name}{exposure}")));
        fs::create_dir(&folder).unwrap();
        let photograph =
            Image::from_fn(40, 30, |x, y| [srgb_from_linear(exposure * light(x, y)); 3]);
        photograph.save_exr(folder.join("a.exr")).unwrap();
        let args = automatic(&folder, &format!("--format exr --out {}", out.display()));
        let report = apply(&args).unwrap();
        (report.exposure.unwrap(), Image::load(out.join("a.exr")).unwrap())
    };
    let (exposure, eighth) = target(1.0 / 8.0);
    for stops in 4..8 {
        let (darker, image) = target(0.5_f32.powi(stops));
        assert!(darker.gain > exposure.gain, "{stops}: {} {}", darker.gain, exposure.gain);
        let off = (darker.target - exposure.target).abs();
        // On the linear part of sRGB's curve the contrast is higher, for which the rule's mean is lower, down to its
        // bound.
        assert!(off < 0.045, "{stops}: {} {}", darker.target, exposure.target);
        // The images differ: the darkest light is on the linear part of sRGB's curve, the rest on the power.
        let psnr = psnr(&image, &eighth).unwrap();
        assert!(psnr > 20.0, "{stops} stops below the light: {psnr} dB");
    }
}

#[test]
fn a_well_lit_folder_is_unchanged_and_a_black_one_refused() {
    let bright = Image::from_fn(40, 30, |x, y| [x, y, x + y].map(|v| 0.3 + v as f32 / 120.0));
    let dir = folder_of(&[("a.png", bright)]);
    let folder = dir.join("photographs");
    let out = dir.join("out");
    let args = automatic(&folder, &format!("--out {}", out.display()));
    assert!(apply(&args).unwrap().exposure.unwrap().reason().contains("well lit"));
    let stored = Image::load(folder.join("a.png")).unwrap();
    assert_eq!(Image::load(out.join("a.png")).unwrap(), stored);

    Image::filled(40, 30, [0.004; 3]).save_png8(folder.join("a.png")).unwrap();
    let error = apply(&args).unwrap_err();
    assert!(error.to_string().contains("almost black"), "{error}");
    assert_eq!(error.exit_code(), 3);
    for (options, part) in [
        ("--gain 2", "tone.brightness"),
        ("--curve ap3 --brightness 0.5", "tone.brightness"),
        ("--brightness 2", "tone.brightness"),
        ("--colour=-0.5", "tone.colour"),
        ("--curve lum_preserve --gain auto", "no automatic gain"),
    ] {
        let message = apply(&automatic(&folder, options)).unwrap_err().to_string();
        assert!(message.contains(part) && !message.contains('\n'), "{message}");
    }
}

/// PSNR of the curve, without training, on the test views; ASE and AP3 with constant gains have means of 23.4 and 23.0
/// dB.
#[test]
fn the_automatic_curve_has_its_known_scores() {
    let Some(lom) = shared("data/lom") else { return };
    let mut mean = 0.0;
    for (scene, known) in [("chair", 25.86), ("sofa", 30.42), ("shrub", 19.74)] {
        let output = apply(&automatic(&lom.join(scene), "")).unwrap();
        let psnr = output.scene.scores.unwrap().psnr;
        assert!((psnr - known).abs() < 0.05, "{scene}: {psnr}");
        mean += psnr / 3.0;
    }
    assert!(mean >= 25.3, "{mean}");
}
