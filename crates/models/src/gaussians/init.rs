//! Initialization of Gaussians.

use std::borrow::Borrow;
use std::ops::Bound::Excluded;

use glam::{DMat3, DQuat, DVec2, DVec3, Vec3};
use nalgebra::{Matrix3, SymmetricEigen};
use nightsplat_core::camera::Camera;
use nightsplat_core::random::Stream;
use nightsplat_core::settings;
use nightsplat_core::settings::Rule;
use nightsplat_core::{Error, Result};
use nightsplat_photographs::dataset::{Point, Split, View};
use nightsplat_photographs::image::Image;
use rayon::prelude::*;

use super::neighbours::Neighbours;
use super::{Gaussians, SH_C0, Shape};

settings! {
"start."
/// The initialization of the Gaussians; points give positions and colours.
///
/// The defaults are more opaque and smaller than those of 3DGS. They score higher after the same steps in less time,
/// since opaque Gaussians hide those behind a surface (docs/measurements.md). Even more opaque ones score higher still,
/// but lose more when they are split. Discs score like round ones, with more Gaussians.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Initialization {
    /// Initial opacity.
    opacity: f64 = 0.2 => Rule::Number(Excluded(0.0), Excluded(1.0));
    /// Standard deviation in units of the root mean squared distance to the three nearest points.
    scale: f64 = 0.8 => Rule::from_to(1e-3, 1e3);
    /// The shortest axis of a disc in units of its longest: if neighbouring points are on a surface, Gaussians are
    /// discs along it. 1: all are isotropic.
    min_axis_ratio: f64 = 1.0 => Rule::from_to(1e-3, 1.0);
}
}

impl Initialization {
    /// The initialization of 3DGS and of the paper.
    #[doc(hidden)]
    pub const PAPER: Self = Self { opacity: 0.1, scale: 1.0, min_axis_ratio: 1.0 };

    /// Checks the values.
    pub fn check(&self) -> Result<()> {
        self.check_rows()
    }
}

/// The minimum of the mean squared distance to the neighbours, world units squared (3DGS).
const MIN_SQUARED_DISTANCE: f64 = 1e-7;

/// The most views that are searched for a point without a track.
pub const MAX_VIEWS: usize = 64;

/// The standard deviation of a Gaussian without neighbours, world units.
const LONE_SCALE: f64 = 0.01;

impl Gaussians {
    /// One Gaussian per point, in the points' order.
    ///
    /// SH of degree 0 gives the colour `colors[i]` (sRGB-encoded, [0, 1]); higher degrees are zero. Scales are
    /// `start.scale` times the root of the mean squared distance to the three nearest other positions (3DGS);
    /// coincident points count as one position, so that duplicates do not shrink to nothing. With fewer than four
    /// positions the mean is over those that exist; a single position has the standard deviation 0.01. Features are
    /// uniform in [0, 1), drawn from `seed` (LITA-GS).
    ///
    /// # Errors
    /// [`Error::Usage`] if a position or colour is not finite or their numbers differ, and those of
    /// `Initialization::check`.
    pub fn from_points(
        positions: &[DVec3],
        colors: &[Vec3],
        shape: impl Into<Shape>,
        start: &Initialization,
        seed: u64,
    ) -> Result<Self> {
        start.check()?;
        if positions.len() != colors.len() {
            return Err(Error::Usage(format!(
                "{} points have {} colours",
                positions.len(),
                colors.len()
            )));
        }
        let finite = |(position, color): (&DVec3, &Vec3)| position.is_finite() && color.is_finite();
        if let Some(point) = positions.iter().zip(colors).position(|pair| !finite(pair)) {
            return Err(Error::Usage(format!(
                "point {point} has a position or colour that is not finite"
            )));
        }

        let mut gaussians = Self::zeros(positions.len(), shape);
        for (mean, position) in gaussians.means_mut().iter_mut().zip(positions) {
            *mean = position.as_vec3();
        }
        let ellipsoids = ellipsoids(positions, start);
        for (quat, ellipsoid) in gaussians.quats_mut().iter_mut().zip(&ellipsoids) {
            let [x, y, z, w] = ellipsoid.rotation.to_array().map(|part| part as f32);
            *quat = [w, x, y, z];
        }
        for (log_scale, ellipsoid) in gaussians.log_scales_mut().iter_mut().zip(&ellipsoids) {
            *log_scale = ellipsoid.scales.map(f64::ln).as_vec3();
        }
        gaussians.raw_opacities_mut().fill((start.opacity / (1.0 - start.opacity)).ln() as f32);
        for (dc, color) in gaussians.dc_mut().iter_mut().zip(colors) {
            *dc = (color - 0.5) / SH_C0;
        }
        let draws = Stream::new(seed, 0);
        for (i, feature) in gaussians.features_mut().iter_mut().enumerate() {
            *feature = draws.uniform(i as u64) as f32;
        }
        Ok(gaussians)
    }
}

/// Standard deviations along the principal axes, world units.
#[derive(Clone, Copy)]
struct Ellipsoid {
    rotation: DQuat,
    scales: DVec3,
}

/// The ellipsoid of each point.
fn ellipsoids(positions: &[DVec3], start: &Initialization) -> Vec<Ellipsoid> {
    // The nearest position is the point itself.
    const NEAREST: usize = 1 + 3;
    /// The neighbours from which the direction of a surface is estimated.
    const AROUND: usize = 1 + 8;
    // Adding zero turns -0 into 0, so that equal coordinates have equal bits.
    let key = |position: &DVec3| (*position + 0.0).to_array().map(f64::to_bits);
    let mut distinct: Vec<_> = positions.iter().map(key).collect();
    distinct.sort_unstable();
    distinct.dedup();
    let distinct = distinct.into_iter().map(|bits| bits.map(f64::from_bits).into());
    let distinct: Vec<DVec3> = distinct.collect();
    let round = |scale: f64| Ellipsoid { rotation: DQuat::IDENTITY, scales: DVec3::splat(scale) };
    if distinct.len() <= 1 {
        return vec![round(LONE_SCALE * start.scale); positions.len()];
    }

    let found = distinct.len().min(AROUND);
    let neighbours = Neighbours::new(distinct);
    let ellipsoid = |position: &DVec3| {
        let around = neighbours.nearest::<AROUND>(*position);
        let others = &around[1..found];
        let nearest = &others[..others.len().min(NEAREST - 1)];
        let mean = nearest.iter().map(|(squared, _)| squared).sum::<f64>() / nearest.len() as f64;
        let scale = start.scale * mean.max(MIN_SQUARED_DISTANCE).sqrt();
        if start.min_axis_ratio == 1.0 {
            return round(scale);
        }
        let (rotation, spread) = spread(others.iter().map(|(_, other)| *other - *position));
        let axes = spread.map(|axis| axis.max(start.min_axis_ratio));
        // The area of the disc, the product of its two longer axes, is that of the isotropic Gaussian.
        let area = axes.element_product() / axes.min_element();
        Ellipsoid { rotation, scales: axes * (scale / area.sqrt()) }
    };
    positions.par_iter().map(ellipsoid).collect()
}

/// The principal axes of directions, and the spread along each, relative to the largest. All directions have the same
/// weight, whatever their length.
fn spread(directions: impl Iterator<Item = DVec3>) -> (DQuat, DVec3) {
    let mut moments = Matrix3::zeros();
    for direction in directions.filter_map(DVec3::try_normalize) {
        let direction = nalgebra::Vector3::from(direction.to_array());
        moments += direction * direction.transpose();
    }
    let SymmetricEigen { eigenvectors, eigenvalues } = SymmetricEigen::new(moments);
    let axes = DMat3::from_cols_slice(eigenvectors.as_slice());
    let axes = if axes.determinant() < 0.0 { -axes } else { axes };
    let longest = eigenvalues.max().max(f64::MIN_POSITIVE);
    let spread = DVec3::from_slice(eigenvalues.as_slice()) / longest;
    (DQuat::from_mat3(&axes).normalize(), spread.max(DVec3::ZERO).map(f64::sqrt))
}

/// `count` random positions within the views of the cameras, for captures without points; empty without cameras.
///
/// Each is at a uniform position of a random camera's image, at a depth that is log-uniform between half the capture's
/// radius and five times it (radius: the greatest distance of a camera from the cameras' mean; 1 if all cameras
/// coincide). Positions that a second camera sees are preferred, since their depth can be learned. At most
/// [`MAX_VIEWS`] cameras are tried, so that the time is proportional to `count`.
pub fn random(cameras: &[Camera], count: usize, seed: u64) -> Vec<DVec3> {
    const TRIES: u64 = 16;
    const DRAWS_PER_TRY: u64 = 4;
    if cameras.is_empty() {
        return Vec::new();
    }
    let radius = radius(cameras);
    let (near, far) = (0.5 * radius, 5.0 * radius);
    let draw = |point: u64| {
        let stream = Stream::new(seed, point);
        let position = |attempt: u64| {
            let uniform = |draw: u64| stream.uniform(attempt * DRAWS_PER_TRY + draw);
            let index = (uniform(0) * cameras.len() as f64) as usize;
            let camera = &cameras[index];
            let pixel = DVec2::new(
                uniform(1) * f64::from(camera.width),
                uniform(2) * f64::from(camera.height),
            );
            let depth = near * (far / near).powf(uniform(3));
            // Outside of a fisheye's image circle, straight ahead.
            let in_view = camera.in_view(pixel, depth).unwrap_or(DVec3::Z * depth);
            (index, camera.view_from_world.inverse().transform_point3(in_view))
        };
        // Consecutive views overlap: the second camera is usually among the first ones tried.
        let seen_twice = |(index, position): &(usize, DVec3)| {
            let (before, from) = cameras.split_at(*index);
            let seen = from.iter().chain(before.iter().rev()).take(MAX_VIEWS);
            seen.filter(|camera| camera.sees(*position).is_some()).nth(1).is_some()
        };
        let (_, position) =
            (1..TRIES).map(position).find(seen_twice).unwrap_or_else(|| position(0));
        position
    };
    (0..count as u64).into_par_iter().map(draw).collect()
}

/// The greatest distance of a camera from the cameras' mean, world units; 1 if that is zero.
fn radius(cameras: &[Camera]) -> f64 {
    let centers: Vec<DVec3> = cameras.iter().map(Camera::center).collect();
    let mean = centers.iter().sum::<DVec3>() / centers.len() as f64;
    let radius = centers.iter().map(|center| center.distance(mean)).fold(0.0, f64::max);
    // A smaller spread is rounding error of a single position's coordinates.
    let least = 1e-9 * mean.length().max(1.0);
    if radius > least { radius } else { 1.0 }
}

/// The colour of each point: the mean of the targets of the training views that see it, RGB.
///
/// A point is seen by the training views of its track; without a track, by the training views that it projects into,
/// of [`MAX_VIEWS`] that cover the scene (`Camera::covering`). A point that none of them sees gets the mean grey of the
/// targets.
///
/// `factor` is that of the light of a view on a colour at a point: the colours are those in even light, by least
/// squares. `target` returns the target of a view (an index into `views`), or `None`; it is called once per training
/// view, in order, so it may compute.
///
/// The time is proportional to the pixels of the views and the length of all tracks; a point without a track counts as
/// one of [`MAX_VIEWS`] views.
pub fn colors_from_views<I: Borrow<Image>>(
    points: &[Point],
    views: &[View],
    factor: impl Fn(&View, &Point) -> f32 + Sync,
    mut target: impl FnMut(usize) -> Result<Option<I>>,
) -> Result<Vec<Vec3>> {
    let candidates = Candidates::new(points, views);
    let mut colors = vec![Mean::default(); points.len()];
    let mut grey = Mean::default();
    for (index, view) in views.iter().enumerate().filter(|(_, view)| view.split == Split::Train) {
        let Some(target) = target(index)? else { continue };
        let target = target.borrow();
        grey.add(mean_grey(&view.counted(target)), 1.0);
        let color = |&index: &u32| {
            let point = &points[index as usize];
            let pixel = shown(view, point)?;
            Some((index, bilinear(target, pixel), factor(view, point)))
        };
        let [tracked, untracked] = candidates.of_view(index);
        let seen = tracked.par_iter().chain(untracked).filter_map(color);
        for (point, color, factor) in seen.collect::<Vec<_>>() {
            colors[point as usize].add(color, factor);
        }
    }
    let grey = grey.value().unwrap_or(Vec3::splat(0.5));
    Ok(colors.into_iter().map(|color| color.value().unwrap_or(grey)).collect())
}

/// The pixel of a view that shows a point; `None` if the point is outside the view or its pixel is masked.
fn shown(view: &View, point: &Point) -> Option<DVec2> {
    let pixel = view.camera.sees(point.position)?;
    let is_hidden = view.mask.as_ref().is_some_and(|mask| mask.hides_around(pixel));
    (!is_hidden).then_some(pixel)
}

/// The candidate points of each view.
struct Candidates {
    /// For each view, the points whose track includes it, ascending.
    of_view: Vec<Vec<u32>>,
    /// The points without a training view in their track.
    untracked: Vec<u32>,
    /// Whether each view is searched for these.
    covers: Vec<bool>,
}

impl Candidates {
    fn new(points: &[Point], views: &[View]) -> Self {
        let is_training = |&&view: &&u32| {
            let view = views.get(view as usize);
            view.is_some_and(|view| view.split == Split::Train && view.has_photograph())
        };
        let is_shown = |point: &Point| {
            let mut track = point.views.iter().filter(is_training);
            track.any(|&view| shown(&views[view as usize], point).is_some())
        };
        let is_tracked: Vec<bool> = points.par_iter().map(is_shown).collect();
        let (training, cameras): (Vec<usize>, Vec<Camera>) = (0..views.len())
            .filter(|&view| is_training(&&(view as u32)))
            .map(|view| (view, views[view].camera))
            .unzip();
        let mut candidates = Self {
            of_view: vec![vec![]; views.len()],
            untracked: vec![],
            covers: vec![false; views.len()],
        };
        for index in Camera::covering(&cameras, MAX_VIEWS) {
            candidates.covers[training[index]] = true;
        }
        for (number, (point, is_tracked)) in (0..).zip(points.iter().zip(is_tracked)) {
            if !is_tracked {
                candidates.untracked.push(number);
                continue;
            }
            for &view in point.views.iter().filter(is_training) {
                let of_view = &mut candidates.of_view[view as usize];
                if of_view.last() != Some(&number) {
                    of_view.push(number);
                }
            }
        }
        candidates
    }

    /// The points of a view: those with a track, and those without.
    fn of_view(&self, view: usize) -> [&[u32]; 2] {
        [&self.of_view[view], if self.covers[view] { &self.untracked } else { &[] }]
    }
}

/// A running mean of colours in lights whose factors are known: the sums of factor times colour and of squared factors.
#[derive(Clone, Copy, Default)]
struct Mean {
    sum: Vec3,
    weight: f32,
}

impl Mean {
    fn add(&mut self, color: Vec3, factor: f32) {
        self.sum += factor * color;
        self.weight += factor * factor;
    }

    fn value(self) -> Option<Vec3> {
        (self.weight > 0.0).then(|| self.sum / self.weight)
    }
}

fn mean_grey(values: &[f32]) -> Vec3 {
    let sum: f64 = values.iter().copied().map(f64::from).sum();
    Vec3::splat((sum / values.len().max(1) as f64) as f32)
}

/// The bilinearly interpolated image at a position in pixels (pixel centres at +0.5), RGB; clamped to the outermost
/// centres.
fn bilinear(image: &Image, pixel: DVec2) -> Vec3 {
    let (width, height) = (image.width as usize, image.height as usize);
    let axis = |at: f64, size: usize| {
        let at = (at - 0.5).clamp(0.0, size.saturating_sub(1) as f64);
        let low = at as usize;
        (low, (low + 1).min(size.saturating_sub(1)), at.fract() as f32)
    };
    let ((x0, x1, tx), (y0, y1, ty)) = (axis(pixel.x, width), axis(pixel.y, height));
    let channel = |channel: usize| {
        let at = |x: usize, y: usize| image.data[(channel * height + y) * width + x];
        let row = |y: usize| at(x0, y) + tx * (at(x1, y) - at(x0, y));
        row(y0) + ty * (row(y1) - row(y0))
    };
    Vec3::new(channel(0), channel(1), channel(2))
}

#[cfg(test)]
mod tests {
    use glam::DAffine3;

    use super::*;

    /// Views side by side that look along z, 10 wide at a distance of 1.
    fn views(count: usize) -> Vec<View> {
        let view = |i: usize| {
            let view_from_world = DAffine3::from_translation(DVec3::NEG_X * 0.01 * i as f64);
            let camera = Camera::perspective(view_from_world, 2.0 * 5_f64.atan(), [10, 10]);
            let image = Image::from_fn(10, 10, |_, _| [0.5; 3]);
            View::new(&i.to_string(), Split::Train, camera, Some(image))
        };
        (0..count).map(view).collect()
    }

    #[test]
    fn a_point_is_searched_in_its_track_or_in_a_limited_number_of_views() {
        let point = |views: Vec<u32>| Point { position: DVec3::Z, views };
        let points: Vec<Point> =
            (0..30).map(|i| point(if i % 3 == 0 { vec![0, 7] } else { vec![] })).collect();
        let pairs = |count: usize| -> usize {
            let candidates = Candidates::new(&points, &views(count));
            (0..count).flat_map(|view| candidates.of_view(view)).map(<[u32]>::len).sum()
        };
        assert_eq!(pairs(20), 10 * 2 + 20 * 20, "all views of a small set");
        for count in [100, 300] {
            assert_eq!(pairs(count), 10 * 2 + 20 * MAX_VIEWS, "{count} views");
        }
        let colors = colors_from_views(
            &points,
            &views(300),
            |_, _| 1.0,
            |index| Ok(Some(Image::from_fn(10, 10, |_, _| [index as f32; 3]))),
        );
        let colors = colors.unwrap();
        assert_eq!(colors[0], Vec3::splat(3.5), "the mean over its track");
        assert!((colors[1].x - 149.5).abs() < 5.0, "the views cover the set: {}", colors[1].x);
    }
}
