//! Which photographs share a camera, and whether a calibration can be one.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use glam::DVec2;

use crate::camera::Lens;
use crate::photographs::image::{Image, lens_name};

/// The photographs of one size, lens and focal length, as far as Exif tells; each group by name.
pub(super) fn groups(photographs: &[PathBuf]) -> Vec<Vec<&Path>> {
    let mut groups: BTreeMap<_, Vec<&Path>> = BTreeMap::new();
    for path in photographs {
        let key = (Image::size_of(path).ok(), lens_name(path));
        groups.entry(key).or_default().push(path);
    }
    groups.into_values().collect()
}

/// A calibration in a few words.
pub(super) fn shown(lens: &Lens) -> String {
    let DVec2 { x, y } = lens.focal;
    let focal = if (x - y).abs() < 0.5 { format!("{x:.0}") } else { format!("{x:.0} x {y:.0}") };
    format!("{}x{} with focal length {focal}", lens.width, lens.height)
}

/// What no lens of a camera has, in a line.
pub(super) fn implausible(lens: &Lens) -> Option<String> {
    /// Pixels are square; lenses for cinema squeeze by a third.
    const MOST_SQUEEZED: f64 = 1.2;
    /// Of what the distortion does to the distance of a corner from the principal point.
    const MOST_DISTORTED: f64 = 0.6;
    let squeezed = lens.focal.max_element() / lens.focal.min_element();
    if squeezed > MOST_SQUEEZED {
        return Some(format!("its focal lengths are {:.0} % apart", 100.0 * (squeezed - 1.0)));
    }
    let size = DVec2::new(lens.width.into(), lens.height.into());
    let off = ((lens.principal_point - 0.5 * size) / size).abs().max_element();
    if off > 0.25 {
        return Some(format!(
            "its principal point is {:.0} % of the image off its middle",
            100.0 * off
        ));
    }
    if lens.distortion.is_fisheye {
        return None;
    }
    let corners = [DVec2::ZERO, DVec2::X, DVec2::Y, DVec2::ONE];
    let bent = corners.map(|corner| {
        let at = (corner * size - lens.principal_point) / lens.focal;
        let moved = lens.distortion.distort(at).distance(at) / at.length();
        // A NaN folds, too.
        if lens.distortion.determinant(at) > 0.0 { moved } else { f64::INFINITY }
    });
    let most = bent.into_iter().fold(0.0, f64::max);
    let is_absurd = most > MOST_DISTORTED;
    is_absurd.then(|| match most.is_finite() {
        true => format!("its distortion moves a corner by {:.0} % of its distance", 100.0 * most),
        false => "its distortion folds the image over itself".to_owned(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::Distortion;

    #[test]
    fn a_calibration_of_a_camera_passes_and_one_of_two_lenses_does_not() {
        let lens = |focal: [f64; 2], k1: f64, k2: f64| Lens {
            width: 500,
            height: 375,
            focal: focal.into(),
            principal_point: DVec2::new(255.0, 180.0),
            distortion: Distortion { k1, k2, ..Distortion::default() },
        };
        assert_eq!(implausible(&lens([520.0, 521.0], -0.02, 0.03)), None);
        assert_eq!(implausible(&lens([300.0, 300.0], -0.3, 0.08)), None, "an action camera");
        for (lens, part) in [
            (lens([964.0, 686.0], 0.0, 0.0), "41 % apart"),
            (lens([300.0, 300.0], -0.9, 0.0), "folds"),
            (lens([300.0, 300.0], 1.0, 0.0), "moves a corner by 1"),
            (
                Lens { principal_point: DVec2::new(20.0, 180.0), ..lens([500.0; 2], 0.0, 0.0) },
                "off its middle",
            ),
        ] {
            let problem = implausible(&lens).unwrap();
            assert!(problem.contains(part), "{problem}");
        }
        assert_eq!(shown(&lens([520.2, 520.4], 0.0, 0.0)), "500x375 with focal length 520");
        assert_eq!(shown(&lens([964.0, 686.0], 0.0, 0.0)), "500x375 with focal length 964 x 686");
    }
}
