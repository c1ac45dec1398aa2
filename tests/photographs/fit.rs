//! `nightsplat tone fit`, in process.

use clap::Parser as _;
use nightsplat::cli::tone::fit::{FamilyChoice, FitArgs, apply};
use nightsplat_photographs::tone::{CurveChoice, FAMILIES};

use crate::common::prelude::*;
use crate::pairs::{dark, reference, truth};

#[derive(Debug, clap::Parser)]
struct ToneFit {
    #[command(flatten)]
    args: FitArgs,
}

/// The arguments of `tone fit`, in which `@NAME` is a path in the folder.
fn args(folder: &Folder, arguments: &str) -> FitArgs {
    let family = if arguments.contains("--family") { "" } else { "--family reinhard" };
    let plain = "--weigh pixels --prior 0 --huber 1.345 --bins 512";
    let line = folder.named(&format!("fit {arguments} {family} {plain}"));
    ToneFit::parse_from(line.split_whitespace()).args
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
    let folder = Folder::empty();
    ["a", "b"].iter().for_each(|name| scene(&folder.join(name), 3));
    let written = "--out @curve.toml --plot @curve.svg";
    let all = args(&folder, &format!("@a @b --family all --cross-validate {written}"));
    let fitted = apply(&all).unwrap();
    assert_eq!(fitted.len(), FAMILIES.len() - 1);
    let best = &fitted[0];
    let choice: CurveChoice = folder.named("@curve.toml").parse().unwrap();
    assert_eq!(choice.settings().unwrap(), best.fit.settings.clone().rounded());
    let written = folder.text("curve.toml");
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
    let svg = folder.text("curve.svg");
    assert!(svg.starts_with("<svg xmlns=") && svg.contains("--series-0: #"), "{svg}");
}

#[test]
fn a_formula_is_fitted_within_its_bounds_and_written_for_other_commands() {
    let folder = Folder::empty();
    scene(&folder, 3);
    let family = "a*t/(t+b); b = 0.5 in 0.01..5".parse().unwrap();
    let args = FitArgs { family, ..args(&folder, "@ --out @mine.toml --plot @mine.svg") };
    let fitted = &apply(&args).unwrap()[0];
    let names: Vec<&str> = fitted.fit.constants.iter().map(|one| one.name.as_ref()).collect();
    assert_eq!((fitted.family.as_str(), names), ("a*t/(t+b)", vec!["a", "b"]));
    // Noise of 0.02 leaves 34 dB.
    assert!(fitted.fit.psnr.fitted > 33.0, "{:?}", fitted.fit.psnr);
    let mine = folder.named("@mine.toml");
    let choice: CurveChoice = mine.parse().unwrap();
    assert_eq!(choice.settings().unwrap(), fitted.fit.settings.clone().rounded());
    let written = folder.text("mine.toml");
    says(&written, &["# a*t/(t+b)\n", "curve = \"a*t/(t+b)\"", "[bounds]", "b = [0.01, 5.0]"]);
    says(&folder.text("mine.svg"), &["a*t/(t+b) fitted"]);
    // What was fitted is where the next fit starts.
    let again = FitArgs { family: mine.parse().unwrap(), ..args };
    assert!((apply(&again).unwrap()[0].fit.psnr.fitted - fitted.fit.psnr.fitted).abs() < 1e-3);
}

#[test]
fn pairs_that_cannot_be_used_are_named_in_one_line() {
    let folder = Folder::empty();
    let fitted = |arguments: &str| apply(&args(&folder, arguments));
    let fails = |arguments: &str, part: &str, code: u8| {
        let error = fitted(arguments).unwrap_err();
        let message = error.to_string();
        assert!(message.contains(part) && !message.contains('\n'), "{message}");
        assert_eq!(error.exit_code(), code, "{message}");
    };
    scene(&folder.join("good"), 2);
    // Two folders by name are the same as one.
    let two = fitted("@good/low --normal @good/high").unwrap();
    assert_eq!(two[0].fit, fitted("@good").unwrap()[0].fit);

    fails("@absent", "is not a folder", 3);
    fails("@good/low", "--normal", 3);
    fails("@good/low @good --normal @good/high", "--normal", 2);
    fails("@good/low --normal @nowhere", "nowhere", 3);
    fails("@good --out @no/folder.toml", "cannot be written", 1);
    fails("@good --family none", "no constants", 2);
    for family in ["table", "nonsense"] {
        assert!(family.parse::<FamilyChoice>().is_err(), "{family}");
    }

    // A photograph without a partner is left out; without any pair, nothing is left.
    fs::remove_file(folder.join("good/high/1.png")).unwrap();
    assert_eq!(fitted("@good").unwrap()[0].fit.values, 4800.0);
    fails("@good --cross-validate", "1 pairs in 5 folds", 2);
    fs::rename(folder.join("good/high/0.png"), folder.join("good/high/7.png")).unwrap();
    fails("@good", "no photograph has a partner", 3);

    for name in ["sizes", "twins", "broken", "black", "flat"] {
        scene(&folder.join(name), 1);
    }
    dark(41, 0.05, 0.0, 1).save_png8(folder.join("sizes/low/0.png")).unwrap();
    dark(40, 0.05, 0.0, 1).save_exr(folder.join("twins/low/0.exr")).unwrap();
    folder.write("broken/low/0.png", b"no image");
    for (name, grey) in [("black", 0.0), ("flat", 0.1)] {
        let plain = Image::filled(40, 40, [grey; 3]);
        plain.save_png8(folder.join(name).join("low/0.png")).unwrap();
    }
    for (arguments, part) in [
        ("@sizes", "0.png: is 41x41 but its reference 40x40"),
        ("@twins", "same name"),
        ("@broken", "0.png"),
        ("@black", "black"),
        ("@flat", "1 different values"),
    ] {
        fails(arguments, part, 3);
    }
}
