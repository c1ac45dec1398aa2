//! `nightsplat tone fit`, in process.

use nightsplat::cli::tone::fit::{ChannelChoice, FamilyChoice, FitArgs, WeightingChoice, apply};
use nightsplat_photographs::tone::{CurveChoice, FAMILIES};

use crate::common::prelude::*;
use crate::common::says;
use crate::pairs::{dark, reference, truth};

fn args(pairs: &[PathBuf]) -> FitArgs {
    FitArgs {
        pairs: pairs.to_vec(),
        normal: None,
        family: FamilyChoice::One(ToneCurve::Reinhard.into()),
        out: None,
        channels: ChannelChoice::Rgb,
        weigh: WeightingChoice::Pixels,
        prior: 0.0,
        huber: 1.345,
        bins: 512,
        bounded: false,
        adapt: false,
        cross_validate: false,
        folds: 5,
        plot: None,
        profile: false,
        json: false,
    }
}

/// A scene on disk: `low` and `high` with `count` pairs.
fn scene(folder: &Path, count: u64) {
    let settings = truth(ToneCurve::Reinhard.family());
    for name in ["low", "high"] {
        fs::create_dir_all(folder.join(name)).unwrap();
    }
    for seed in 0..count {
        let dark = dark(40, 0.05, 0.0, seed);
        dark.save_png16(folder.join(format!("low/{seed}.png"))).unwrap();
        reference(&settings, &dark, 0.02, seed)
            .save_png8(folder.join(format!("high/{seed}.png")))
            .unwrap();
    }
}

#[test]
fn a_written_curve_is_accepted_by_other_commands() {
    let dir = tempfile::tempdir().unwrap();
    let folders = [dir.path().join("a"), dir.path().join("b")];
    folders.iter().for_each(|folder| scene(folder, 3));
    let (out, plot) = (dir.path().join("curve.toml"), dir.path().join("curve.svg"));
    let args = FitArgs {
        family: FamilyChoice::All,
        out: Some(out.clone()),
        plot: Some(plot.clone()),
        cross_validate: true,
        ..args(&folders)
    };
    let fitted = apply(&args).unwrap();
    assert_eq!(fitted.len(), FAMILIES.len() - 1);
    let best = &fitted[0];
    let choice: CurveChoice = out.to_str().unwrap().parse().unwrap();
    assert_eq!(choice.settings().unwrap(), best.fit.settings.clone().rounded());
    let written = fs::read_to_string(&out).unwrap();
    let numbers = written.lines().filter_map(|line| line.split_once(" = ")).map(|(_, text)| text);
    assert!(
        numbers.filter(|text| text.parse::<f64>().is_ok()).all(|text| text.len() <= 12),
        "{written}"
    );
    let folds = &best.held_out.as_ref().unwrap().folds;
    assert_eq!(folds.iter().map(|fold| fold.name.as_str()).collect::<Vec<_>>(), ["a", "b"]);
    let scores: Vec<f64> =
        fitted.iter().map(|f| f.held_out.as_ref().unwrap().psnr.fitted).collect();
    assert!(scores.is_sorted_by(|a, b| a >= b), "{scores:?}");
    // Noise of 0.02 leaves 34 dB.
    assert!((scores[0] - 34.0).abs() < 0.5, "{scores:?}");
    let svg = fs::read_to_string(plot).unwrap();
    assert!(svg.starts_with("<svg xmlns=") && svg.contains("--series-0: #"), "{svg}");
}

#[test]
fn a_formula_is_fitted_within_its_bounds_and_written_for_other_commands() {
    let dir = tempfile::tempdir().unwrap();
    scene(dir.path(), 3);
    let (out, plot) = (dir.path().join("mine.toml"), dir.path().join("mine.svg"));
    let text = "a*t/(t+b); b = 0.5 in 0.01..5";
    let args = FitArgs {
        family: text.parse().unwrap(),
        out: Some(out.clone()),
        plot: Some(plot.clone()),
        ..args(&[dir.path().to_owned()])
    };
    let fitted = &apply(&args).unwrap()[0];
    let names: Vec<&str> = fitted.fit.constants.iter().map(|one| one.name.as_ref()).collect();
    assert_eq!((fitted.family.as_str(), names), ("a*t/(t+b)", vec!["a", "b"]));
    // Noise of 0.02 leaves 34 dB.
    assert!(fitted.fit.psnr.fitted > 33.0, "{:?}", fitted.fit.psnr);
    let choice: CurveChoice = out.to_str().unwrap().parse().unwrap();
    assert_eq!(choice.settings().unwrap(), fitted.fit.settings.clone().rounded());
    let written = fs::read_to_string(&out).unwrap();
    says(&written, &["# a*t/(t+b)\n", "curve = \"a*t/(t+b)\"", "[bounds]", "b = [0.01, 5.0]"]);
    assert!(fs::read_to_string(plot).unwrap().contains("a*t/(t+b) fitted"));
    // What was fitted is where the next fit starts.
    let again = FitArgs { family: out.to_str().unwrap().parse().unwrap(), ..args };
    assert!((apply(&again).unwrap()[0].fit.psnr.fitted - fitted.fit.psnr.fitted).abs() < 1e-3);
}

#[test]
fn pairs_that_cannot_be_used_are_named_in_one_line() {
    let dir = tempfile::tempdir().unwrap();
    let path = |name: &str| dir.path().join(name);
    let fails = |args: FitArgs, part: &str, code: u8| {
        let error = apply(&args).unwrap_err();
        let message = error.to_string();
        assert!(message.contains(part) && !message.contains('\n'), "{message}");
        assert_eq!(error.exit_code(), code, "{message}");
    };
    scene(&path("good"), 2);
    assert!(apply(&args(&[path("good")])).is_ok());
    // Two folders by name are the same as one.
    let two = FitArgs { normal: Some(path("good/high")), ..args(&[path("good/low")]) };
    assert_eq!(apply(&two).unwrap()[0].fit, apply(&args(&[path("good")])).unwrap()[0].fit);

    fails(args(&[path("absent")]), "is not a folder", 3);
    fails(args(&[path("good/low")]), "--normal", 3);
    fails(
        FitArgs { normal: Some(path("good/high")), ..args(&[path("good/low"), path("good")]) },
        "--normal",
        2,
    );
    fails(FitArgs { normal: Some(path("nowhere")), ..args(&[path("good/low")]) }, "nowhere", 3);
    fails(
        FitArgs { out: Some(path("no/folder.toml")), ..args(&[path("good")]) },
        "cannot be written",
        1,
    );
    fails(
        FitArgs { family: FamilyChoice::One(ToneCurve::None.into()), ..args(&[path("good")]) },
        "no constants",
        2,
    );
    assert!(
        "table".parse::<FamilyChoice>().is_err() && "nonsense".parse::<FamilyChoice>().is_err()
    );

    // A photograph without a partner is left out; without any pair, nothing is left.
    fs::remove_file(path("good/high/1.png")).unwrap();
    assert_eq!(apply(&args(&[path("good")])).unwrap()[0].fit.values, 4800.0);
    fails(FitArgs { cross_validate: true, ..args(&[path("good")]) }, "1 pairs in 5 folds", 2);
    fs::rename(path("good/high/0.png"), path("good/high/7.png")).unwrap();
    fails(args(&[path("good")]), "no photograph has a partner", 3);

    scene(&path("sizes"), 2);
    dark(41, 0.05, 0.0, 1).save_png8(path("sizes/low/1.png")).unwrap();
    fails(args(&[path("sizes")]), "1.png: is 41x41 but its reference 40x40", 3);

    scene(&path("twins"), 1);
    dark(40, 0.05, 0.0, 1).save_exr(path("twins/low/0.exr")).unwrap();
    fails(args(&[path("twins")]), "same name", 3);

    scene(&path("broken"), 1);
    fs::write(path("broken/low/0.png"), b"no image").unwrap();
    fails(args(&[path("broken")]), "0.png", 3);

    scene(&path("black"), 2);
    for name in ["black/low/0.png", "black/low/1.png"] {
        Image::filled(40, 40, [0.0; 3]).save_png8(path(name)).unwrap();
    }
    fails(args(&[path("black")]), "black", 3);

    scene(&path("flat"), 1);
    Image::filled(40, 40, [0.1; 3]).save_png8(path("flat/low/0.png")).unwrap();
    fails(args(&[path("flat")]), "1 different values", 3);
}
