//! What commands say of datasets, and options of loading.

use nightsplat_diagnose::Diagnosis;
use nightsplat_photographs::dataset::LoadOptions;

use super::synthetic::*;
use crate::common::command::json;
use crate::common::paths;
use crate::common::png::put_chunk;
use crate::common::prelude::*;

#[test]
fn the_configuration_keeps_the_orientation() {
    let root = &Folder::empty();
    let mut turned = model(9);
    turned.points.clear();
    for (.., name) in &mut turned.images {
        *name = name.replace("png", "jpg");
        jpeg(&root.join("images").join(&*name), SIZE, 3);
    }
    turned.write_text(&root.join("sparse/0"));
    says(&root.run("diagnose @", 0).1, &["--orientation exif"]);
    let (_, log) = root.run("diagnose @ --orientation exif", 0);
    assert!(!log.contains("Exif"), "{log}");
    let train = "train @ --out @run --explain --orientation";
    let explained = root.succeed(&format!("{train} exif"));
    let kept = explained.lines().find(|line| line.contains("orientation")).unwrap();
    says(kept, &["exif", "--orientation"]);
    says(&root.run(&format!("{train} upright"), 2).1, &["auto, stored, exif"]);
}

#[test]
fn heic_is_refused_with_its_converter_and_listed_as_unread() {
    let root = &Folder::empty();
    fs::write(root.join("a.heic"), b"\0\0\0\x18ftypheic\0\0\0\0mif1heic").unwrap();
    photograph(&root.join("b.png"), SIZE, 0.1);
    root.refused("tone apply @a.heic", 3, &["a.heic", "HEIC", "heif-convert", "sips"]);
    says(&root.run("tone apply @", 0).1, &["not read: 1 .heic", "heif-convert"]);
}

#[test]
fn masked_pixels_are_not_in_the_statistics_of_tone() {
    let root = &Folder::empty();
    let measured =
        |more: &str| -> Value { json(root.run(&format!("tone apply @ --json{more}"), 0).0) };
    let halves = |x: u32, _| [if 2 * x < SIZE.0 { 0.1 } else { 0.9 }; 3];
    Image::from_fn(SIZE.0, SIZE.1, halves).save_png8(root.join("a.png")).unwrap();
    let mean = |json: &Value| (json["scene"]["mean"].as_f64().unwrap() * 100.0).round();
    assert_eq!(mean(&measured("")), 50.0);
    half_mask(&root.join("masks/a.png"), SIZE);
    assert_eq!(mean(&measured("")), 10.0);
    assert_eq!(measured("")["scene"]["unusable_pixels"], 600);
    assert_eq!(mean(&measured(" --invert-masks")), 90.0);
}

#[test]
fn a_profile_that_cannot_be_used_is_named_once_for_the_dataset() {
    let root = &Folder::lom();
    for path in paths(&root.join("low")) {
        put_chunk(&path, b"iCCP", b"name\0\0damaged");
    }
    let (_, message) = root.run("diagnose @", 0);
    let lines = message.lines().filter(|line| line.contains("a damaged ICC profile"));
    assert_eq!(lines.count(), 1, "{message}");
}

#[test]
fn an_invalid_white_balance_is_refused_in_one_line() {
    let root = &Folder::lom();
    for (white, code, part) in [
        ("0,1,1", 2, "white_balance (--white-balance) is \"0,1,1\"; it must be R,G,B"),
        ("warm", 2, "(--white-balance) is \"warm\""),
        ("v99,2,2,5,5", 3, "no photograph is called `v99`"),
        ("v03,39,2,5,5", 2, "it exceeds the photograph, which is 40x30"),
    ] {
        root.refused(&format!("train @ --out @run --white-balance {white}"), code, &[part]);
    }
}

#[test]
fn black_borders_are_neither_measured_nor_in_the_statistics_of_tone() {
    let folder = Folder::empty();
    model(9).write_binary(&folder.join("sparse/0"));
    circles(&folder, 20.0);
    // Photographs that are read again are measured without their borders as well.
    let options = LoadOptions::default();
    let (dataset, loaded) = Diagnosis::load(&folder, &options).unwrap();
    assert!(loaded.views[0].zero_fraction == 0.0, "{}", loaded.views[0].zero_fraction);
    assert_eq!(Diagnosis::new(&dataset, &options).unwrap(), loaded);
    let report = json(folder.run("tone apply @ --curve ap3 --json", 0).0);
    let p10 = report["views"]["v00"]["p10"].as_f64().unwrap();
    assert!(p10 > 0.03, "{report}");
}
