//! Groups photographs by camera, and checks calibrations for plausibility.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use glam::DVec2;
use nightsplat_core::camera::Lens;
use nightsplat_photographs::image::{Image, ImageFile, lens_name};

/// Groups photographs by size and by the lens and focal length of their Exif; each group is sorted by name.
pub(super) fn groups(photographs: &[PathBuf]) -> Vec<Vec<&Path>> {
    let mut groups: BTreeMap<_, Vec<&Path>> = BTreeMap::new();
    for path in photographs {
        let key = (Image::size_of(path).ok(), lens_name(path));
        groups.entry(key).or_default().push(path);
    }
    groups.into_values().collect()
}

/// The image size and focal length of a lens, in pixels.
pub fn describe(lens: &Lens) -> String {
    let DVec2 { x, y } = lens.focal;
    let focal = if (x - y).abs() < 0.5 { format!("{x:.0}") } else { format!("{x:.0} x {y:.0}") };
    format!("{}x{} with focal length {focal}", lens.width, lens.height)
}

/// The reason why there is no lens with this calibration: the poses found with it are wrong, too.
pub(super) fn impossible(lens: &Lens) -> Option<String> {
    /// Ratio of the focal lengths. The most that anamorphic lenses have is 2.
    const MAX_ASPECT: f64 = 2.5;
    /// The larger field of view of both axes, degrees; a fisheye has any.
    const FIELD: [f64; 2] = [5.0, 170.0];
    let aspect = lens.focal.max_element() / lens.focal.min_element();
    if aspect > MAX_ASPECT {
        return Some(format!(
            "one of its focal lengths is {aspect:.1} times the other ({MAX_ASPECT} at most)"
        ));
    }
    let size = DVec2::new(lens.width.into(), lens.height.into());
    let half = (0.5 * size / lens.focal).max_element();
    let angle = if lens.distortion.is_fisheye { half } else { half.atan() };
    let field = 2.0 * angle.to_degrees();
    let [least, most] = FIELD;
    let is_possible = field >= least && (field <= most || lens.distortion.is_fisheye);
    (!is_possible).then(|| {
        format!("its field of view is {field:.1} degrees ({least} at least, {most} at most)")
    })
}

/// The reason why the lenses of most photographs, of which each has its number, cannot be; `None` if they can.
pub(super) fn mostly_impossible(lenses: &[(Lens, usize)]) -> Option<String> {
    let taken: usize = lenses.iter().map(|(_, photographs)| photographs).sum();
    let mut first = None;
    let mut with_problem = 0;
    for (lens, photographs) in lenses {
        if let Some(problem) = impossible(lens) {
            with_problem += photographs;
            first.get_or_insert_with(|| format!("{}: {problem}", describe(lens)));
        }
    }
    first.filter(|_| 2 * with_problem > taken)
}

/// The reason why no real lens has this calibration; `None` if it is plausible.
pub(super) fn implausible(lens: &Lens) -> Option<String> {
    /// Ratio of the focal lengths. Pixels are square; an anamorphic lens has 1.33.
    const MAX_ASPECT: f64 = 1.2;
    /// Displacement of a corner, relative to its distance from the principal point.
    const MAX_DISTORTION: f64 = 0.6;
    if let Some(problem) = impossible(lens) {
        return Some(problem);
    }
    let aspect = lens.focal.max_element() / lens.focal.min_element();
    if aspect > MAX_ASPECT {
        return Some(format!("its focal lengths are {:.0} % apart", 100.0 * (aspect - 1.0)));
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
        // A NaN counts as folded.
        if lens.distortion.determinant(at) > 0.0 { moved } else { f64::INFINITY }
    });
    let most = bent.into_iter().fold(0.0, f64::max);
    let is_absurd = most > MAX_DISTORTION;
    is_absurd.then(|| match most.is_finite() {
        true => format!("its distortion moves a corner by {:.0} % of its distance", 100.0 * most),
        false => "its distortion folds the image over itself".to_owned(),
    })
}

/// Photographs whose cameras rest on few points.
pub(super) struct WeakCameras {
    pub(super) names: Vec<String>,
    /// One line that names them, with the remedy.
    pub(super) warning: String,
}

impl WeakCameras {
    /// The weak ones of photographs with how many points each sees. In dark photographs, a third of what half of the
    /// others see is what chance matches reach: such cameras are often of another pose altogether.
    pub(super) fn find(seen: &[(String, usize)]) -> Option<Self> {
        /// The share of the median, and a number of points that holds any camera.
        const SHARE: f64 = 1.0 / 3.0;
        const ENOUGH: usize = 60;
        let mut counts: Vec<usize> = seen.iter().map(|(_, count)| *count).collect();
        counts.sort_unstable();
        let median = *counts.get(counts.len() / 2)?;
        let is_weak = |count: usize| count < ENOUGH && (count as f64) < SHARE * median as f64;
        let weak = || seen.iter().filter(|(_, count)| is_weak(*count));
        let names: Vec<String> = weak().map(|(name, _)| name.clone()).collect();
        let with_counts = weak().map(|(name, count)| format!("{name} ({count})"));
        let warning = format!(
            "few points hold these cameras, which may be wrong and are left out: {}; half of all photographs see \
             {median}. Take more photographs close to them",
            first_of(with_counts)
        );
        (!names.is_empty()).then_some(Self { names, warning })
    }
}

/// The first of some names, and how many more there are.
pub(super) fn first_of(mut names: impl Iterator<Item = String>) -> String {
    const NAMED: usize = 5;
    let first: Vec<String> = names.by_ref().take(NAMED).collect();
    match names.count() {
        0 => first.join(", "),
        more => format!("{} and {more} more", first.join(", ")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nightsplat_core::camera::Distortion;

    #[test]
    fn cameras_that_rest_on_few_points_are_found() {
        let seen = |counts: &[usize]| -> Vec<(String, usize)> {
            counts.iter().enumerate().map(|(i, &count)| (format!("{i}.png"), count)).collect()
        };
        let weak = WeakCameras::find(&seen(&[33, 75, 83, 112, 130, 193])).unwrap();
        let line = weak.warning;
        assert!(line.contains(": 0.png (33); half") && line.contains("see 112."), "{line}");
        assert_eq!(weak.names, ["0.png"]);
        for counts in [&[75, 83, 112, 130][..], &[20, 25, 30, 35], &[61, 300, 400, 500], &[]] {
            assert!(WeakCameras::find(&seen(counts)).is_none(), "{counts:?}");
        }
    }

    #[test]
    fn a_real_calibration_passes_and_a_mixture_of_two_lenses_does_not() {
        let lens = |focal: [f64; 2], k1: f64, k2: f64| Lens {
            width: 500,
            height: 375,
            focal: focal.into(),
            principal_point: DVec2::new(255.0, 180.0),
            distortion: Distortion { k1, k2, ..Distortion::default() },
        };
        assert_eq!(implausible(&lens([520.0, 521.0], -0.02, 0.03)), None);
        assert_eq!(implausible(&lens([300.0, 300.0], -0.3, 0.08)), None, "an action camera");
        assert_eq!(impossible(&lens([964.0, 686.0], 0.0, 0.0)), None, "implausible alone");
        assert_eq!(impossible(&lens([22.0, 22.0], 0.0, 0.0)), None, "170 degrees");
        for (focal, part) in [
            ([3723.0, 309.0], "12.0 times the other (2.5 at most)"),
            ([6000.0, 6000.0], "field of view is 4.8 degrees (5 at least"),
            ([20.0, 20.0], "field of view is 170.9 degrees"),
        ] {
            let lens = lens(focal, 0.0, 0.0);
            let problem = impossible(&lens).unwrap();
            assert!(problem.contains(part), "{problem}");
            assert_eq!(implausible(&lens), Some(problem));
        }
        let distortion = Distortion { is_fisheye: true, ..Distortion::default() };
        let fisheye = Lens { distortion, ..lens([150.0, 150.0], 0.0, 0.0) };
        assert_eq!(impossible(&fisheye), None, "a fisheye of 190 degrees");
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
        assert_eq!(describe(&lens([520.2, 520.4], 0.0, 0.0)), "500x375 with focal length 520");
        assert_eq!(
            describe(&lens([964.0, 686.0], 0.0, 0.0)),
            "500x375 with focal length 964 x 686"
        );
    }
}
