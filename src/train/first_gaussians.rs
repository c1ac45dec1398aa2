//! The first Gaussians: one for each point, with its colour in the targets of the training views.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::path::Path;

use glam::{DVec3, Vec3};
use nightsplat_core::camera::{Camera, Patch, TrainingFrame};
use nightsplat_core::random::Stream;
use nightsplat_models::gaussians::{COLOR_CHANNELS, Feature, Gaussians, Shape, init};
use nightsplat_photographs::dataset::{Dataset, Point, View};
use nightsplat_photographs::image::Image;

use super::config::TrainConfig;
use super::streams;
use super::views::{ImageKind, TrainView, TrainingPhotograph, Views};
use crate::gpu::Gpu;
use crate::networks::NetworkVariant;
use crate::splats::lamp::Lamp;
use crate::targets::pseudo_gt::PseudoGt;
use crate::{Error, Result};
use nightsplat_photographs::exposures::Affine;

impl Views {
    /// The points of the dataset, followed by random ones if there are few or none.
    fn points<'a>(
        &self,
        dataset: &'a Dataset,
        config: &TrainConfig,
        frame: &TrainingFrame,
    ) -> Cow<'a, [Point]> {
        let triangulated = &dataset.points;
        let wanted = if triangulated.is_empty() {
            config.random_points
        } else {
            config.density.sparse_threshold()
        };
        let count = wanted.min(config.max_gaussians).saturating_sub(triangulated.len());
        if count == 0 {
            return triangulated.into();
        }
        let firsts = self.all().iter().filter(|view| view.patch.is_first());
        let cameras: Vec<Camera> = firsts.map(|view| view.patch.camera).collect();
        let seed = Stream::new(config.seed, streams::POINTS).bits(0);
        let found =
            if triangulated.is_empty() { "no".to_owned() } else { triangulated.len().to_string() };
        tracing::info!("{found} points in the dataset; {count} random ones added");
        let point = |position| Point { position: frame.unframed(position), views: vec![] };
        let random = init::random(&cameras, count, seed).into_iter().map(point);
        triangulated.iter().cloned().chain(random).collect()
    }

    /// One Gaussian for each point of the dataset, and for random points if there are few or none, with their colours
    /// in the targets of the training views, without the light of the lamp, in world units.
    pub(super) fn initial_gaussians(
        &self,
        pseudo_gt: &PseudoGt,
        dataset: &Dataset,
        config: &TrainConfig,
        exposures: Option<&[Affine]>,
        lamp: Option<&Lamp>,
    ) -> Result<Gaussians> {
        let frame = config.frame.unwrap_or_default();
        let points = self.points(dataset, config, &frame);
        let kept = &sampled(points, config, pseudo_gt.gpu());
        // The training photograph of each view of the dataset.
        let mut photographs = vec![None; dataset.views.len()];
        self.photographs().for_each(|view| photographs[view.in_dataset.0] = Some(view.photograph));
        let mut targets = ImageBatches::new(self, pseudo_gt, ImageKind::Targets);
        let factor = |view: &View, point: &Point| {
            let in_view = view.camera.view_from_world.transform_point3(point.position);
            lamp.map_or(1.0, |lamp| lamp.factor(in_view) as f32)
        };
        let mut colors = init::colors_from_views(kept, &dataset.views, factor, |index| {
            let Some(photograph) = photographs[index] else { return Ok(None) };
            let mut target = targets.next(photograph)?;
            if let Some(affine) = exposures.and_then(|exposures| exposures.get(photograph.0)) {
                target = affine.inverse().applied(&target);
            }
            if let Some(lamp) = lamp {
                let shown = |value: f32| lamp.tone_inverse(value.into()) as f32;
                target.data.iter_mut().for_each(|value| *value = shown(*value));
            }
            Ok(Some(target))
        })?;
        if let Some(lamp) = lamp {
            let toned = |color: Vec3| color.to_array().map(|x| lamp.tone(x.into()) as f32);
            colors.iter_mut().for_each(|color| *color = toned(*color).into());
        }
        let positions: Vec<DVec3> = kept.iter().map(|point| frame.framed(point.position)).collect();
        let seed = Stream::new(config.seed, streams::FEATURES).bits(0);
        let shape = Shape { sh_degree: config.sh_degree, features: config.model.features() };
        let mut gaussians =
            Gaussians::from_points(&positions, &colors, shape, &config.start, seed)?;
        if config.model.network.variant == NetworkVariant::Identity {
            let low = if shape.features.illumination {
                let mut dark = ImageBatches::new(self, pseudo_gt, ImageKind::Photographs);
                init::colors_from_views(
                    kept,
                    &dataset.views,
                    |_, _| 1.0,
                    |index| photographs[index].map(|affine| dark.next(affine)).transpose(),
                )?
            } else {
                vec![]
            };
            begin_as_identity(&mut gaussians, &colors, &low);
        }
        Ok(gaussians)
    }

    /// Warns if hardly any Gaussian of a given model (in the training frame) is in sight of a camera: it is probably of
    /// another world.
    pub(super) fn warn_of_another_world(&self, gaussians: &Gaussians, path: &Path) {
        /// The smallest share that is seen.
        const SEEN: f64 = 0.1;
        /// The most Gaussians that are looked at.
        const MOST: usize = 10_000;
        let looked: Vec<usize> = scattered(gaussians.count).take(MOST).collect();
        let is_seen = |at: &&usize| {
            let mean = gaussians.means()[**at].as_dvec3();
            self.photographs().any(|view| view.patch.camera.sees(mean).is_some())
        };
        let (seen, count) = (looked.iter().filter(is_seen).count(), looked.len());
        if (seen as f64) < SEEN * count as f64 {
            let model = path.display();
            tracing::warn!(
                "{model}: {} of {count} Gaussians are out of sight of every camera; is the model of this dataset's \
                 world?",
                count - seen
            );
        }
    }

    /// Warns of every view that contains the mean of none of the first Gaussians (in the training frame): its pose is
    /// probably wrong.
    pub(super) fn warn_of_empty_views(&self, gaussians: &Gaussians) {
        let means: Vec<DVec3> = gaussians.means().iter().map(|mean| mean.as_dvec3()).collect();
        for TrainView { name, patch, .. } in self.photographs() {
            if !scattered(means.len()).any(|at| patch.camera.sees(means[at]).is_some()) {
                tracing::warn!(
                    "view {name} contains none of the {} first Gaussians; check its pose",
                    means.len()
                );
            }
        }
    }
}

/// Targets of the photographs in order, made in batches.
struct ImageBatches<'a> {
    views: &'a Views,
    pseudo_gt: &'a PseudoGt,
    kind: ImageKind,
    made: BTreeMap<TrainingPhotograph, Image>,
}

impl<'a> ImageBatches<'a> {
    fn new(views: &'a Views, pseudo_gt: &'a PseudoGt, kind: ImageKind) -> Self {
        Self { views, pseudo_gt, kind, made: BTreeMap::new() }
    }

    /// The target of a photograph; earlier ones are dropped.
    fn next(&mut self, photograph: TrainingPhotograph) -> Result<Image> {
        /// The pixels of a batch.
        const MAX_PIXELS: usize = 1 << 20;
        let Self { views, pseudo_gt, kind, ref mut made } = *self;
        if !made.contains_key(&photograph) {
            let mut pixels = 0;
            let whole = views.whole();
            let after = &whole[whole.partition_point(|view| view.photograph < photograph)..];
            let after = after.iter().filter(|view| view.patch.is_first());
            let now = after.take_while(|view| {
                let is_first = pixels == 0;
                pixels += Patch::from(&view.patch.camera).pixel_count();
                is_first || pixels <= MAX_PIXELS
            });
            let last = now.last().map_or(photograph, |view| view.photograph);
            let images = views.pictures(pseudo_gt, photograph..=last, kind)?;
            *made = (photograph.0..).map(TrainingPhotograph).zip(images).collect();
        }
        let gone = || Error::Usage(format!("there is no training photograph {}", photograph.0));
        made.remove(&photograph).ok_or_else(gone)
    }
}

/// Initialises features such that the parts of the model start as the identity: structure with 0, and illumination with
/// each point's colour in the dark photographs over that in the targets. Depth, which is trained by correlation, stays
/// random.
fn begin_as_identity(gaussians: &mut Gaussians, colors: &[Vec3], low: &[Vec3]) {
    /// Darker targets do not determine the illumination.
    const DARKEST: f32 = 1.0 / 255.0;
    let features = gaussians.shape.features;
    let indices = |feature| {
        let channels = features.channels_of(feature).unwrap_or_default();
        channels.map(|channel| channel - COLOR_CHANNELS)
    };
    let width = features.width();
    for (i, of_gaussian) in gaussians.features_mut().chunks_mut(width.max(1)).enumerate() {
        indices(Feature::Structure).for_each(|at| of_gaussian[at] = 0.0);
        for (channel, at) in indices(Feature::Illumination).enumerate() {
            of_gaussian[at] = (low[i][channel] / colors[i][channel].max(DARKEST)).clamp(0.0, 1.0);
        }
    }
}

/// A permutation of the numbers below `count` that separates neighbours, so that a search through a sorted list soon
/// samples all of it.
fn scattered(count: usize) -> impl Iterator<Item = usize> {
    const GOLDEN: f64 = 0.618_033_988_75;
    let divides_both = |step: usize| {
        let (mut a, mut b) = (step, count);
        while b > 0 {
            (a, b) = (b, a % b);
        }
        a > 1
    };
    let mut step = ((GOLDEN * count as f64) as usize).max(1);
    while divides_both(step) {
        step += 1;
    }
    (0..count).scan(0, move |at, _| {
        let here = *at;
        *at = (here + step) % count;
        Some(here)
    })
}

/// The points that become Gaussians: an even sample if there are more than the limit.
fn sampled<'a>(points: Cow<'a, [Point]>, config: &TrainConfig, gpu: &Gpu) -> Cow<'a, [Point]> {
    let fitting = config.render_settings().peak_gaussians(gpu);
    let (of, count) = (points.len(), points.len().min(config.max_gaussians).min(fitting));
    if count == of {
        return points;
    }
    let limit = if count == config.max_gaussians {
        "max_gaussians allows no more".to_owned()
    } else {
        format!("{} binds no more", gpu.properties().name)
    };
    tracing::warn!("{count} of {of} points, an even sample, become Gaussians: {limit}");
    let seed = Stream::new(config.seed, streams::POINTS).bits(1);
    even_sample(of, count, seed).into_iter().map(|index| points[index].clone()).collect()
}

/// `count` of the indices below `of`, ascending, evenly spread: a random one from each of `count` equal intervals. A
/// laser scan lists points in rows, and a fixed stride would select the same columns of every row.
fn even_sample(of: usize, count: usize, seed: u64) -> Vec<usize> {
    if count >= of {
        return (0..of).collect();
    }
    let draws = Stream::new(seed, 0);
    let begin = |stretch: usize| (stretch as u128 * of as u128 / count as u128) as usize;
    let index = |stretch: usize| {
        let (first, end) = (begin(stretch), begin(stretch + 1));
        first + (draws.uniform(stretch as u64) * (end - first) as f64) as usize
    };
    (0..count).map(index).collect()
}

#[cfg(test)]
mod tests {
    use super::{even_sample, scattered};

    #[test]
    fn a_sample_is_even_and_has_no_period() {
        for (of, count) in [(60_000, 6000), (10, 9), (7, 7), (7, 12), (5, 1), (3, 0)] {
            let sample = even_sample(of, count, 3);
            assert_eq!(sample.len(), count.min(of));
            assert!(
                sample.windows(2).all(|two| two[0] < two[1]) && sample.iter().all(|&at| at < of)
            );
            for (stretch, &at) in sample.iter().enumerate() {
                let length = of as f64 / count.min(of) as f64;
                let begin = stretch as f64 * length;
                assert!((begin.floor()..begin + length).contains(&(at as f64)), "{at} of {of}");
            }
            assert_eq!(sample, even_sample(of, count, 3));
        }
        // Rows of ten: a stride of ten would select a single column.
        let mut columns = [0; 10];
        even_sample(10_000, 1000, 0).into_iter().for_each(|at| columns[at % 10] += 1);
        assert!(columns.iter().all(|&count| count > 50), "{columns:?}");
    }

    #[test]
    fn scattered_numbers_are_a_permutation_with_neighbours_far_apart() {
        for count in [0, 1, 2, 3, 4, 6, 10, 97, 1000] {
            let numbers: Vec<usize> = scattered(count).collect();
            let near = numbers.windows(2).filter(|two| two[0].abs_diff(two[1]) < count / 4).count();
            assert!(near <= 1 || count < 4, "{count}: {near}");
            let mut sorted = numbers;
            sorted.sort_unstable();
            assert!(sorted.into_iter().eq(0..count));
        }
    }
}
