//! What is odd about photographs is said by every command that looks at them, and corrected where it can be.

use nightsplat_photographs::dataset::LoadOptions;

use crate::common::command::unwrapped;
use crate::common::prelude::*;
use crate::common::sets::{banded, changed, vignetted};

#[test]
fn a_run_records_what_it_evens_out_and_a_plan_file_repeats_it() {
    let middle = ["of the light of the middle"];
    let elsewhere = ["in 2.5 bands that lie elsewhere in each"];
    for (folder, name, of_line, of_diagnosis, of_tone, recorded, off) in [
        (vignetted(), "falloff", " on ", &middle[..], middle, "\nfalloff = ", "falloff=0"),
        (banded(), "bands", "rows differ by 1.", &[], elsewhere, "[bands.waves]", "bands={}"),
    ] {
        let text = folder.succeed("diagnose @ --plan @plan.toml");
        let line = text.lines().find(|line| line.starts_with(name)).unwrap();
        says(line, &[" on ", of_line]);
        says(&unwrapped(&text), of_diagnosis);
        says(&unwrapped(&folder.succeed("tone apply @")), &of_tone);
        let train = "train @ --out @run --steps 2 --overwrite";
        for more in ["", "--plan @plan.toml"] {
            says(&folder.succeed(&format!("{train} {more}")), &[line]);
            says(&folder.text("run/config.toml"), &[recorded]);
        }
        let printed = folder.succeed(&format!("{train} --set {off}"));
        assert!(!printed.contains(&format!("{name}  on")), "{printed}");
    }
}

#[test]
fn what_is_burnt_in_is_masked_in_every_view_and_said() {
    let bar = |index: usize, [x, y]: [u32; 2], light: f64| match y {
        0..56 => light,
        // Black, with text of which the end changes.
        58..70 => {
            let shift = if x >= 64 { index as u32 } else { 0 };
            f64::from(u8::from((x + shift) % 5 < 2 && y % 4 < 3))
        }
        _ => 0.0,
    };
    let folder = changed(bar);
    let dataset = Dataset::load(&folder, &LoadOptions::default()).unwrap();
    for view in dataset.train_views() {
        let mask = view.mask.as_ref().unwrap();
        let is_hidden = |y: usize| mask.weights[96 * y..][..96].iter().all(|&weight| weight == 0.0);
        assert!((56..72).all(is_hidden), "{}", view.name);
        assert!((0..52).all(|y| mask.weights[96 * y..][..96].iter().all(|&one| one == 1.0)));
    }
    for command in ["diagnose @", "tone apply @ --out @out"] {
        says(&folder.run(command, 0).1, &["to 71, columns 0 to 95 of the photographs of 96x72"]);
    }
    let train = "train @ --out @out --steps 2 --set mask_overlays=false --overwrite";
    assert!(!folder.run(train, 0).1.contains("hardly change"));
    // Its last rows are a black border as well.
    let plain = LoadOptions { mask_overlays: false, mask_borders: false, ..LoadOptions::default() };
    let dataset = Dataset::load(&folder, &plain).unwrap();
    assert!(dataset.views.iter().all(|view| view.mask.is_none()));
}

#[test]
fn every_command_that_looks_at_photographs_says_what_is_odd() {
    let veil = f64::from(linear_from_srgb(24.0 / 255.0));
    let folder = changed(|_, _, light| light + veil);
    let finding = ["black is raised: no photograph is darker than 25 of 255"];
    for command in ["diagnose", "diagnose --json", "tone apply", "tone apply --json"] {
        says(&folder.succeed(&format!("{command} @")), &finding);
    }
    says(&folder.run("train @ --out @run --steps 2", 0).1, &finding);
    says(&folder.succeed("tone apply @ --brightness 0.9"), &["near white (0.94 and above)"]);
}
