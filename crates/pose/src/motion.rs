//! What makes cameras hopeless, measured before the hours of work: photographs from one place, and clips of a moment.

use std::path::{Path, PathBuf};

use nightsplat_core::output::duration;
use nightsplat_photographs::image::{Image, ImageFile};

/// Width and height of the thumbnails that are compared, in pixels.
const THUMBNAIL: u32 = 48;
/// The most photographs that are compared with the first.
const COMPARED: usize = 12;
/// The correlation with the first from which on a photograph shows the same from the same place.
const SAME: f64 = 0.98;
/// The fewest frames and seconds of a clip around a scene.
const LEAST_OF_CLIP: (usize, f64) = (20, 8.0);

/// A remark on tone-mapped copies that hardly differ, up to noise. Those that cannot be read are left to others.
pub(super) fn at_rest(copies: &[PathBuf]) -> Option<String> {
    let every = copies.len().div_ceil(COMPARED).max(1);
    // The last one is as far from the first as any.
    let last = copies.last().filter(|_| copies.len() > 1);
    let compared = copies.iter().step_by(every).chain(last);
    let thumbnails: Vec<Vec<f64>> = compared.filter_map(|copy| thumbnail(copy)).collect();
    let (first, others) = thumbnails.split_first()?;
    let is_same = |other: &Vec<f64>| correlation(first, other) > SAME;
    let count = copies.len();
    (!others.is_empty() && others.iter().all(is_same)).then(|| {
        format!(
            "the {count} photographs hardly move: cameras need views from different places; walk around the scene, a \
             step for each photograph"
        )
    })
}

/// A remark on a clip of a few frames, of which some per second are taken.
pub(super) fn short_clip(clip: &Path, frames: usize, fps: f64) -> Option<String> {
    let (least_frames, least_seconds) = LEAST_OF_CLIP;
    let seconds = frames as f64 / fps;
    (frames < least_frames || seconds < least_seconds).then(|| {
        format!(
            "{}: {frames} frames of {} are few; film 20 s or more while you walk around the scene{}",
            clip.display(),
            duration(seconds),
            if seconds < least_seconds { "" } else { ", or raise --fps" }
        )
    })
}

/// The green channel of a thumbnail, without its mean.
fn thumbnail(copy: &Path) -> Option<Vec<f64>> {
    let small = Image::load(copy).ok()?.resized(THUMBNAIL, THUMBNAIL);
    let pixels = small.pixel_count();
    let green = small.data[pixels..2 * pixels].iter().map(|&value| f64::from(value));
    let mean = green.clone().sum::<f64>() / pixels as f64;
    Some(green.map(|value| value - mean).collect())
}

fn correlation(a: &[f64], b: &[f64]) -> f64 {
    let product = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    product(a, b) / (product(a, a) * product(b, b)).sqrt().max(f64::MIN_POSITIVE)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn photographs_from_one_place_are_told_from_those_that_move() {
        let folder = tempfile::tempdir().unwrap();
        let taken = |step: u32| -> Vec<PathBuf> {
            let one = |index: u32| {
                let path = folder.path().join(format!("{step}-{index}.png"));
                let picture = Image::from_fn(96, 96, |x, y| {
                    let noise = 0.1 * ((7 * x + 13 * y + 5 * index) % 11) as f32 / 11.0;
                    let x = (x + step * index) as f32;
                    [0.4 + 0.3 * (0.13 * x).sin() * (0.09 * y as f32).cos() + noise; 3]
                });
                picture.save_png8(&path).unwrap();
                path
            };
            (0..20).map(one).collect()
        };
        let remark = at_rest(&taken(0)).unwrap();
        assert!(remark.starts_with("the 20 photographs hardly move"), "{remark}");
        assert_eq!(at_rest(&taken(2)), None);
        assert_eq!(at_rest(&taken(0)[..1]), None, "one photograph moves as it may");
        assert_eq!(at_rest(&["absent.png".into()]), None);
    }

    #[test]
    fn a_clip_of_a_moment_is_told() {
        let remark = |frames, fps| short_clip(Path::new("a.mp4"), frames, fps);
        let line =
            "a.mp4: 10 frames of 1 s are few; film 20 s or more while you walk around the scene";
        assert_eq!(remark(10, 12.0).as_deref(), Some(line));
        assert!(remark(12, 0.5).unwrap().ends_with(", or raise --fps"));
        assert_eq!(remark(40, 2.0), None);
    }
}
