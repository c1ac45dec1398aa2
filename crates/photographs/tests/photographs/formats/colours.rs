//! Photographs in other colour spaces, and white balance, in a dataset.

use nightsplat_photographs::image::linear_from_srgb;
use nightsplat_photographs::image::srgb_from_linear;

use crate::png::put_chunk;

use super::*;

/// Marks every image of a folder as linear light.
fn mark_linear(folder: &Path) {
    for entry in fs::read_dir(folder).unwrap() {
        put_chunk(&entry.unwrap().path(), b"gAMA", &100_000_u32.to_be_bytes());
    }
}

fn pixel(view: &View) -> [f32; 3] {
    view.loaded().unwrap().unwrap().pixel(9, 9)
}

#[test]
fn photographs_and_references_become_srgb_and_masks_do_not() {
    let root = &Folder::lom();
    let before = load(root);
    mark_linear(&root.join("low"));
    mark_linear(&root.join("high"));
    // A mask of 0.4 masks; as linear light it would be 0.66 and count.
    fs::create_dir(root.join("masks")).unwrap();
    let mask = root.join("masks/v03.png");
    Image::from_fn(SIZE.0, SIZE.1, |x, _| [if x < 4 { 0.4 } else { 1.0 }; 3])
        .save_png8(&mask)
        .unwrap();
    mark_linear(&root.join("masks"));
    let mut after = None;
    let message = warnings(|| after = Some(load(root)));
    let after = after.unwrap();
    for (before, after) in before.views.iter().zip(&after.views) {
        let expected = pixel(before).map(srgb_from_linear);
        let off = pixel(after).iter().zip(expected).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(off < 1e-5, "{}: {:?} for {expected:?}", after.name, pixel(after));
        if let (Some(before), Some(after)) = (&before.reference, &after.reference) {
            assert!((after.data[0] - srgb_from_linear(before.data[0])).abs() < 1e-5);
        }
    }
    let hidden = view(&after, "v03").mask.as_ref().unwrap();
    assert_eq!(hidden.weights.iter().filter(|&&weight| weight == 0.0).count(), 4 * SIZE.1 as usize);
    let lines: Vec<&str> =
        message.lines().filter(|line| line.contains("converted to sRGB")).collect();
    assert_eq!(lines.len(), 2, "{message}");
    for (line, objects) in lines.iter().zip(["photographs", "reference images"]) {
        assert!(line.contains(&format!("{objects} in sRGB at gamma 1.00")), "{message}");
    }
}

/// The photographs of a dataset under a lamp.
fn lamp_lit(root: &Path) {
    lom(root, 10, &[2, 5]);
    for entry in fs::read_dir(root.join("low")).unwrap() {
        let path = entry.unwrap().path();
        let grey = Image::load(&path).unwrap().data[0];
        let lit = [2.0, 1.0, 0.5].map(|light| srgb_from_linear(light * linear_from_srgb(grey)));
        Image::filled(SIZE.0, SIZE.1, lit).save_png16(&path).unwrap();
    }
}

#[test]
fn one_grey_card_balances_every_photograph_cached_or_not() {
    let root = &Folder::empty();
    lamp_lit(root);
    let balanced = |keep: Option<u64>, white: &str| {
        let white_balance = Some(white.parse().unwrap());
        load_with(root, LoadOptions { white_balance, keep, ..Default::default() })
    };
    let (stored, kept) = (load(root), balanced(None, "v03,2,2,5,5"));
    for (view, stored) in kept.views.iter().zip(&stored.views) {
        let [red, green, blue] = pixel(view);
        assert!((red - green).abs() < 1e-4 && (blue - green).abs() < 1e-4, "{}", view.name);
        assert_eq!(view.reference, stored.reference);
    }
    let anew = balanced(Some(0), "v03.png,2,2,5,5");
    for (view, kept) in anew.views.iter().zip(&kept.views) {
        assert!(view.image.is_none());
        assert_eq!(*view.loaded().unwrap().unwrap(), *kept.loaded().unwrap().unwrap());
    }
    let same = balanced(None, "1,1,1");
    assert!(same.views.iter().zip(&stored.views).all(|(a, b)| a.image == b.image));
}
