//! Measurements across cameras: points, overlap, and relative exposures.

use std::collections::BTreeMap;

use glam::DVec2;
use nightsplat_core::camera::Camera;
use nightsplat_models::gaussians::init;
use nightsplat_photographs::dataset::{Dataset, Point, View};
use nightsplat_photographs::image::{Image, linear_from_srgb};
use nightsplat_photographs::tone::{bounded, luminance};
use rayon::prelude::*;

use nightsplat_core::Result;

/// Random points in front of the cameras if the dataset has none.
const RANDOM_POINTS: usize = 2000;
/// The most points used for exposures.
const MAX_POINTS: usize = 20_000;
/// The brightness of a point is the mean over a square with this half-width, in pixels.
const REACH: i64 = 2;
/// Where more of the values are 0, noise is cut off, and the mean is too bright.
const MAX_ZEROS: f64 = 0.1;
/// The fewest shared points for an exposure.
const MIN_SHARED: usize = 12;

/// A point in a photograph.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Observation {
    /// The position of the view among the training views.
    pub(super) view: usize,
    /// log2 of the linear luminance around it.
    pub(super) light: f64,
    /// The distance from the camera, world units.
    pub(super) distance: f64,
    /// 1 - cos of the angle between the direction to the point and the camera's axis.
    pub(super) off_axis: f64,
    /// The position in the height of the photograph, 0 to 1.
    pub(super) row: f64,
    /// Whether too many of the values around it are 0 for its brightness to be that of the point.
    pub(super) is_clipped: bool,
}

/// Measurements across the cameras of the training views.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct SceneGeometry {
    /// The number of points of each view: those that it helped to triangulate, if the dataset lists them.
    pub(super) points: Vec<usize>,
    /// For each view, the mean fraction of the other views that see its points.
    pub(super) overlaps: Vec<f64>,
    /// The mean number of views of a point.
    pub(super) views_per_point: f64,
    /// log2 exposure of each view at shared points, with mean 0; `None` if it shares too few.
    pub(super) exposures: Vec<Option<f64>>,
    /// 1 - cos of the angle off the axis at the corner of a photograph that is farthest from it; the median.
    pub(super) corner: f64,
    /// Those of each point that two views see, unless the points are random.
    pub(super) observations: Vec<Vec<Observation>>,
}

impl SceneGeometry {
    /// Measures training views, in order.
    pub(super) fn measure(dataset: &Dataset, views: &[(usize, &View)]) -> Result<Self> {
        let random;
        let points = if dataset.points.is_empty() {
            let cameras: Vec<Camera> = views.iter().map(|(_, view)| view.camera).collect();
            let point = |position| Point { position, views: vec![] };
            random = init::random(&cameras, RANDOM_POINTS, 0).into_iter().map(point).collect();
            &random
        } else {
            &dataset.points
        };
        let stride = points.len().div_ceil(MAX_POINTS).max(1);
        let points: Vec<&Point> = points.iter().step_by(stride).collect();
        let inside = |point: &&Point| -> Vec<usize> {
            let sees = |view: &View| pixel(&view.camera, point).is_some();
            (0..views.len()).filter(|&index| sees(views[index].1)).collect()
        };
        let seen: Vec<Vec<usize>> = points.par_iter().map(inside).collect();
        let tracked: Vec<Vec<usize>> = points.iter().map(|point| track(point, views)).collect();
        let has_tracks = tracked.iter().any(|track| !track.is_empty());
        let counted = if has_tracks { &tracked } else { &seen };

        let others = views.len().saturating_sub(1).max(1) as f64;
        let mut shares = vec![(0.0, 0_usize); views.len()];
        for seeing in &seen {
            for &view in seeing {
                let (sum, count) = &mut shares[view];
                *sum += (seeing.len() - 1) as f64 / others;
                *count += 1;
            }
        }
        let mut counts = vec![0; views.len()];
        counted.iter().flatten().for_each(|&view| counts[view] += 1);
        let visible = seen.iter().map(Vec::len).filter(|&count| count > 0);
        let (sum, visible) = visible.fold((0, 0), |(sum, n), count| (sum + count, n + 1));
        // Random points are not points of the dataset.
        let each = if dataset.points.is_empty() { 0 } else { stride };
        let observations =
            if dataset.points.is_empty() { vec![] } else { observations(&points, counted, views)? };
        Ok(Self {
            points: counts.into_iter().map(|count| each * count).collect(),
            overlaps: shares.iter().map(|&(sum, count)| sum / count.max(1) as f64).collect(),
            views_per_point: sum as f64 / visible.max(1) as f64,
            exposures: exposures(&observations, views.len()),
            corner: median(views.iter().map(|(_, view)| corner(&view.camera)).collect())
                .unwrap_or_default(),
            observations,
        })
    }
}

/// The positions, in `views`, of those that triangulated a point; ascending.
fn track(point: &Point, views: &[(usize, &View)]) -> Vec<usize> {
    let position =
        |&view: &u32| views.binary_search_by_key(&(view as usize), |(index, _)| *index).ok();
    point.views.iter().filter_map(position).collect()
}

/// 1 - cos of the angle off the axis at the farthest corner.
fn corner(camera: &Camera) -> f64 {
    let size = DVec2::new(camera.width.into(), camera.height.into());
    let corners = [DVec2::ZERO, DVec2::X, DVec2::Y, DVec2::ONE].map(|at| at * size);
    let seen = corners.into_iter().filter_map(|at| camera.in_view(at, 1.0));
    seen.map(|ray| 1.0 - ray.z / ray.length()).fold(0.0, f64::max)
}

fn pixel(camera: &Camera, point: &Point) -> Option<DVec2> {
    let size = DVec2::new(camera.width.into(), camera.height.into());
    let pixel = camera.project(point.position)?;
    (pixel.cmpge(DVec2::ZERO).all() && pixel.cmplt(size).all()).then_some(pixel)
}

/// The observations of each point around which a photograph is neither black nor white; of at least two views.
fn observations(
    points: &[&Point],
    seen: &[Vec<usize>],
    views: &[(usize, &View)],
) -> Result<Vec<Vec<Observation>>> {
    let mut of_view = vec![vec![]; views.len()];
    for (point, seeing) in seen.iter().enumerate() {
        seeing.iter().for_each(|&view| of_view[view].push(point));
    }
    let mut lights = vec![vec![]; points.len()];
    // One photograph at a time, since they may have to be read again.
    for (index, ((_, view), shown)) in views.iter().zip(of_view).enumerate() {
        let Some(image) = view.loaded()? else { continue };
        let observation = |&point: &usize| {
            let at = pixel(&view.camera, points[point])?;
            let (light, is_clipped) = light_around(&image, at)?;
            let in_view = view.camera.view_from_world.transform_point3(points[point].position);
            let distance = in_view.length();
            let off_axis = 1.0 - in_view.z / distance;
            let (light, row) = (light.log2(), at.y / f64::from(view.camera.height));
            Some((point, Observation { view: index, light, distance, off_axis, row, is_clipped }))
        };
        let of_view: Vec<_> = shown.par_iter().filter_map(observation).collect();
        of_view.into_iter().for_each(|(point, seen)| lights[point].push(seen));
    }
    lights.retain(|seen| seen.len() >= 2);
    Ok(lights)
}

/// The mean linear luminance around a pixel, and whether many values there are 0.
fn light_around(image: &Image, at: DVec2) -> Option<(f64, bool)> {
    let (width, height) = (i64::from(image.width), i64::from(image.height));
    let (x, y) = (at.x as i64, at.y as i64);
    if !(REACH..width - REACH).contains(&x) || !(REACH..height - REACH).contains(&y) {
        return None;
    }
    let (mut sum, mut zeros) = (0.0, 0_usize);
    for (dy, dx) in (-REACH..=REACH).flat_map(|dy| (-REACH..=REACH).map(move |dx| (dy, dx))) {
        let rgb = image.pixel((x + dx) as u32, (y + dy) as u32).map(|x| bounded(x, f32::MAX));
        if rgb.iter().any(|&value| value >= 1.0) {
            return None;
        }
        // Noise below black is not cut.
        zeros += rgb.iter().filter(|&&value| value == 0.0).count();
        sum += f64::from(luminance(rgb.map(linear_from_srgb)));
    }
    let pixels = ((2 * REACH + 1) as f64).powi(2);
    let mean = sum / pixels;
    (mean > 0.0).then_some((mean, zeros as f64 > MAX_ZEROS * 3.0 * pixels))
}

/// log2 exposure of each training view at shared points, with mean 0, by name; without views that share too few.
pub fn exposures_at_points(dataset: &Dataset) -> Result<BTreeMap<String, f64>> {
    let views: Vec<(usize, &View)> =
        dataset.views.iter().enumerate().filter(|(_, view)| view.is_for_training()).collect();
    let shared = SceneGeometry::measure(dataset, &views)?;
    let named = views.iter().zip(shared.exposures);
    Ok(named.filter_map(|((_, view), value)| Some((view.name.clone(), value?))).collect())
}

/// Alternating medians: a point's brightness over its views, a view's exposure over its points. Only the brighter half
/// of the points counts, judged without the exposures: noise and quantisation distort the logarithm of dim light. A
/// view that clips those takes the others.
fn exposures(points: &[Vec<Observation>], view_count: usize) -> Vec<Option<f64>> {
    const ROUNDS: usize = 20;
    let mut exposures = vec![Some(0.0); view_count];
    let mut kept: Vec<&Vec<Observation>> = points.iter().collect();
    for round in 0..ROUNDS {
        // Approximate exposures determine which points are bright.
        if round == ROUNDS / 2 {
            let levels = points.iter().filter_map(|point| level(&exposures, point));
            let typical = median(levels.collect());
            kept.retain(|point| level(&exposures, point) >= typical);
        }
        let mut of_view = vec![vec![]; view_count];
        for point in &kept {
            let Some(level) = level(&exposures, point) else { continue };
            for one in *point {
                of_view[one.view].push(one.light - level);
            }
        }
        exposures = of_view.into_iter().map(exposure).collect();
        center(&mut exposures);
    }
    let mut of_clipped = vec![vec![]; view_count];
    for point in points {
        let Some(level) = level(&exposures, point) else { continue };
        for one in point.iter().filter(|one| exposures[one.view].is_none()) {
            of_clipped[one.view].push(one.light - level);
        }
    }
    for (exposure_of_view, of) in exposures.iter_mut().zip(of_clipped) {
        *exposure_of_view = exposure_of_view.or_else(|| exposure(of));
    }
    center(&mut exposures);
    exposures
}

/// The brightness of a point at these exposures.
fn level(exposures: &[Option<f64>], point: &[Observation]) -> Option<f64> {
    median(point.iter().filter_map(|one| Some(one.light - exposures[one.view]?)).collect())
}

/// The exposure of a view from those at its points; `None` if there are too few.
fn exposure(at_points: Vec<f64>) -> Option<f64> {
    if at_points.len() < MIN_SHARED { None } else { median(at_points) }
}

fn center(exposures: &mut [Option<f64>]) {
    let values: Vec<f64> = exposures.iter().copied().flatten().collect();
    let mean = values.iter().sum::<f64>() / values.len().max(1) as f64;
    exposures.iter_mut().flatten().for_each(|exposure| *exposure -= mean);
}

/// The middle one, or the mean of the two in the middle; `None` without values.
pub fn median(mut values: Vec<f64>) -> Option<f64> {
    values.sort_unstable_by(f64::total_cmp);
    let middle = values.len() / 2;
    let lower = values.get(middle.checked_sub(1 - values.len() % 2)?)?;
    Some((lower + values[middle]) / 2.0)
}

/// The standard deviation; `None` for fewer than two values.
pub(super) fn deviation(values: impl Iterator<Item = f64>) -> Option<f64> {
    let values: Vec<f64> = values.collect();
    let count = values.len() as f64;
    let mean = values.iter().sum::<f64>() / count;
    let variance = values.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / count;
    (values.len() >= 2).then(|| variance.sqrt())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn observed(view: usize, light: f64) -> Observation {
        Observation { view, light, distance: 1.0, off_axis: 0.0, row: 0.0, is_clipped: false }
    }

    #[test]
    fn exposures_are_found_for_any_brightness_of_the_points() {
        let truth = [0.5, -1.0, 0.25, 0.25];
        let point = |index: usize| -> Vec<Observation> {
            let level = -3.0 - 0.1 * (index % 17) as f64;
            let views = (0..4).filter(|view| view % 3 != index % 3 || index.is_multiple_of(2));
            views.map(|view| observed(view, level + truth[view])).collect()
        };
        let points: Vec<_> = (0..200).map(point).collect();
        for (found, truth) in exposures(&points, 4).into_iter().zip(truth) {
            assert!((found.unwrap() - truth).abs() < 1e-6);
        }
        assert_eq!(exposures(&points[..3], 4), [None; 4]);
    }

    #[test]
    fn a_view_that_clips_every_bright_point_is_measured_at_the_dim_ones() {
        let truth = [-0.5, -0.75, -0.75, 2.0];
        let point = |index: usize| -> Vec<Observation> {
            let level = -4.0 + 0.02 * index as f64;
            let views = (0..4).filter(|&view| view < 3 || index < 80);
            views.map(|view| observed(view, level + truth[view])).collect()
        };
        let points: Vec<_> = (0..200).map(point).collect();
        for (found, truth) in exposures(&points, 4).into_iter().zip(truth) {
            assert!((found.unwrap() - truth).abs() < 1e-6);
        }
    }
}
