//! Which views show a block, by the points that they see.

use glam::DVec3;
use rayon::prelude::*;

use super::partition::BlockCells;
use crate::dataset::{Dataset, Point, View};

/// A view serves a block that contains this share of its points.
const SHARE: f64 = 0.05;
/// A view from a direction that a block lacks serves it from this share on.
const LEAST_SHARE: f64 = 0.02;
/// The views of a block from each quarter of the horizon, if there are as many.
const OF_QUARTER: usize = 3;
/// The views of the coarse model that see each point, if there are as many.
const OF_POINT: usize = 4;
/// A view joins the coarse model if this share of its points lack views.
const NEW_SHARE: f64 = 0.1;
/// Points that stand for all where photographs are not recorded with points.
const SAMPLES: usize = 20_000;

/// What the views of a dataset see.
#[derive(Debug)]
pub struct Visibility<'a> {
    dataset: &'a Dataset,
    /// The training views with photographs, as indices into the dataset's views.
    pub training: Vec<usize>,
    /// The points that each of them sees, ascending.
    seen: Vec<Vec<u32>>,
    /// The scene's up direction, a unit vector.
    pub up: DVec3,
}

impl<'a> Visibility<'a> {
    /// By the recorded tracks of the points; where there are none, every point in a view's frame counts as seen.
    pub fn new(dataset: &'a Dataset) -> Self {
        let is_used = |view: &View| view.is_train() && view.has_photograph();
        let all = dataset.views.iter().enumerate();
        let training: Vec<usize> =
            all.filter(|(_, view)| is_used(view)).map(|(index, _)| index).collect();
        let mut index_of = vec![None; dataset.views.len()];
        training.iter().enumerate().for_each(|(at, &index)| index_of[index] = Some(at));
        let mut seen = vec![vec![]; training.len()];
        for (number, point) in (0..).zip(&dataset.points) {
            for at in point.views.iter().filter_map(|&view| index_of[view as usize]) {
                seen[at].push(number);
            }
        }
        let mut visibility = Self { dataset, training, seen, up: dataset.up() };
        if visibility.seen.iter().all(Vec::is_empty) {
            tracing::warn!(
                "{}: its points do not record which photographs see them; every point in the frame of a photograph \
                 counts as seen",
                dataset.root.display()
            );
            visibility.seen = visibility.in_frame();
        }
        visibility
    }

    fn in_frame(&self) -> Vec<Vec<u32>> {
        let step = self.dataset.points.len().div_ceil(SAMPLES).max(1);
        let in_frame = |&view: &usize| {
            let camera = &self.dataset.views[view].camera;
            let points = (0..).zip(&self.dataset.points).step_by(step);
            let seen = points.filter(|(_, point)| camera.sees(point.position).is_some());
            seen.map(|(number, _)| number).collect()
        };
        self.training.par_iter().map(in_frame).collect()
    }

    /// The number of pixels for which each point stands: a view's pixels are shared by its points. In units of their
    /// mean.
    pub fn pixel_shares(&self) -> Vec<f64> {
        let mut shares = vec![0.0; self.dataset.points.len()];
        for seen in self.seen.iter().filter(|seen| !seen.is_empty()) {
            let each = 1.0 / seen.len() as f64;
            seen.iter().for_each(|&point| shares[point as usize] += each);
        }
        let mean = shares.iter().sum::<f64>() / shares.len().max(1) as f64;
        shares.iter_mut().for_each(|share| *share /= mean.max(f64::MIN_POSITIVE));
        shares
    }

    /// The views that serve each part, as ascending places in [`Self::training`].
    pub fn serving(&self, parts: &[BlockCells]) -> Vec<Vec<usize>> {
        let owner =
            |point: &Point| parts.iter().position(|part| part.core.contains(point.position));
        let part_of: Vec<Option<usize>> = self.dataset.points.par_iter().map(owner).collect();
        let shares = |seen: &Vec<u32>| {
            let mut counts = vec![0_u32; parts.len()];
            let owned = seen.iter().filter_map(|&point| part_of[point as usize]);
            owned.for_each(|part| counts[part] += 1);
            counts.iter().map(|&count| f64::from(count) / seen.len().max(1) as f64).collect()
        };
        let shares: Vec<Vec<f64>> = self.seen.par_iter().map(shares).collect();
        (0..parts.len()).map(|part| self.of_part(part, &shares)).collect()
    }

    fn of_part(&self, part: usize, shares: &[Vec<f64>]) -> Vec<usize> {
        let share = |view: usize| shares[view][part];
        let mut serving: Vec<usize> =
            (0..shares.len()).filter(|&view| share(view) >= SHARE).collect();
        let mut others: Vec<usize> =
            (0..shares.len()).filter(|&view| (LEAST_SHARE..SHARE).contains(&share(view))).collect();
        others.sort_by(|&a, &b| share(b).total_cmp(&share(a)).then(a.cmp(&b)));
        for quarter in 0..4 {
            let looks = |view: &&usize| self.quarter(**view) == quarter;
            let count = serving.iter().filter(looks).count();
            let more = others.iter().filter(looks).take(OF_QUARTER.saturating_sub(count));
            let more: Vec<usize> = more.copied().collect();
            serving.extend(more);
        }
        serving.sort_unstable();
        serving
    }

    /// The quarter of the horizon into which a view looks.
    fn quarter(&self, view: usize) -> usize {
        let camera = &self.dataset.views[self.training[view]].camera;
        let direction = camera.view_from_world.matrix3.row(2);
        let east = self.up.any_orthonormal_vector();
        let (x, y) = (direction.dot(east), direction.dot(self.up.cross(east)));
        usize::from(x >= 0.0) + 2 * usize::from(y >= 0.0)
    }

    /// The views of the coarse model: in an order that covers the cameras, those that add to points seen by few.
    pub fn thinned(&self) -> Vec<usize> {
        let mut views_of = vec![0_usize; self.dataset.points.len()];
        let mut views = vec![];
        for view in scattered(self.training.len()) {
            let seen = &self.seen[view];
            let lacking = seen.iter().filter(|&&point| views_of[point as usize] < OF_POINT).count();
            if lacking as f64 >= NEW_SHARE * seen.len() as f64 {
                seen.iter().for_each(|&point| views_of[point as usize] += 1);
                views.push(view);
            }
        }
        views.sort_unstable();
        views
    }
}

/// The numbers below `count` in an order whose every beginning is spread over all of them.
fn scattered(count: usize) -> Vec<usize> {
    let mut order: Vec<usize> = (0..count).collect();
    order.sort_by_key(|number| number.reverse_bits());
    order
}

#[cfg(test)]
mod tests {
    use glam::{DAffine3, DVec3};

    use super::*;
    use crate::dataset::Split;
    use crate::dataset::block::partition::{Until, WeightedPoint, partition};
    use crate::image::Image;
    use nightsplat_core::camera::Camera;

    /// `count` views along a street, each of which sees the points within 4 of it.
    fn street(count: u32, has_tracks: bool) -> Dataset {
        let view = |at: u32| {
            let world_from_view = DAffine3::from_translation(DVec3::new(f64::from(at), 0.0, -2.0));
            let camera = Camera::perspective(world_from_view.inverse(), 1.2, [8, 8]);
            let image = Image { width: 8, height: 8, data: vec![0.1; 192] };
            View::new(&format!("{at:03}"), Split::Train, camera, Some(image))
        };
        let point = |i: u32| {
            let x = f64::from(i) * f64::from(count) / 1000.0;
            let near = (0..count).filter(|&at| (f64::from(at) - x).abs() <= 4.0);
            let views = if has_tracks { near.collect() } else { vec![] };
            Point { position: DVec3::new(x, 0.1 * f64::from(i % 7), 0.0), views }
        };
        Dataset {
            root: "street".into(),
            views: (0..count).map(view).collect(),
            points: (0..1000).map(point).collect(),
            skipped: vec![],
        }
    }

    fn parts(dataset: &Dataset, count: usize) -> Vec<BlockCells> {
        let weighted = dataset.points.iter();
        let weighted =
            weighted.map(|point| WeightedPoint { position: point.position, weight: 1.0 });
        partition(&weighted.collect::<Vec<_>>(), DVec3::Y, Until::Count(count)).unwrap()
    }

    #[test]
    fn a_block_has_the_views_that_see_it_and_few_others() {
        let dataset = street(40, true);
        let visibility = Visibility::new(&dataset);
        let serving = visibility.serving(&parts(&dataset, 4));
        assert!(serving[0].iter().all(|&view| view < 16), "{:?}", serving[0]);
        assert!((0..10).all(|view| serving[0].contains(&view)), "{:?}", serving[0]);
        let all: std::collections::BTreeSet<usize> = serving.into_iter().flatten().collect();
        assert_eq!(all.len(), 40);
    }

    #[test]
    fn without_tracks_what_is_in_the_frame_counts() {
        let dataset = street(40, false);
        let serving = Visibility::new(&dataset).serving(&parts(&dataset, 2));
        assert!(serving[0].contains(&3) && !serving[0].contains(&36), "{:?}", serving[0]);
    }

    #[test]
    fn the_coarse_model_has_views_for_every_point() {
        let dataset = street(200, true);
        let thinned = Visibility::new(&dataset).thinned();
        assert!(thinned.len() < 130, "{}", thinned.len());
        let has = |view: &u32| thinned.contains(&(*view as usize));
        assert!(
            dataset.points.iter().all(|point| point.views.iter().filter(|v| has(v)).count() >= 2)
        );
    }

    #[test]
    fn points_share_the_pixels_of_the_views_that_see_them() {
        let mut dataset = street(2, true);
        dataset.points.truncate(3);
        for (point, views) in dataset.points.iter_mut().zip([vec![0], vec![0, 1], vec![]]) {
            point.views = views;
        }
        // Half a view, a view and a half, none; relative to their mean.
        assert_eq!(Visibility::new(&dataset).pixel_shares(), [0.75, 2.25, 0.0]);
    }
}
