//! The training views on the device: dark photographs, their curves, and the order in which steps take them.

use std::sync::Arc;

use glam::{DVec3, UVec2};

use super::{TrainConfig, streams};
use crate::Result;
use crate::camera::Camera;
use crate::dataset::{Dataset, Point};
use crate::exposure::Affine;
use crate::gpu::{Buffer, Gpu};
use crate::image::Image;
use crate::kernels::ToneParameters;
use crate::loss::ViewSource;
use crate::pseudo_gt::PseudoGt;
use crate::random::Stream;
use crate::scene::{Gaussians, Shape, init};
use crate::tone::{Statistics, ToneCurve, ToneSettings};

/// One training view.
#[derive(Debug)]
pub(super) struct TrainView {
    pub(super) name: String,
    /// Its place among the training views of all levels.
    pub(super) number: usize,
    /// Its place among those of its level.
    pub(super) place: usize,
    /// Index into the dataset's views.
    index: usize,
    pub(super) camera: Camera,
    /// Depth from elsewhere, (H, W), where the dataset's is of another size.
    depth: Option<Vec<f32>>,
    /// The dark photograph, planar (3, H, W), sRGB-encoded.
    pub(super) image: Buffer<f32>,
    /// The target, where the loss does not evaluate the curve.
    baked: Option<Arc<Buffer<f32>>>,
    /// The curve that its statistics give; one element. Of a baked target none.
    pub(super) tone: Buffer<ToneParameters>,
}

/// All training views in the dataset's order, as they are and then by level of the resolution schedule, each half the
/// size of the one before.
#[derive(Debug)]
pub(super) struct Views(Vec<Vec<TrainView>>);

/// A view whose shorter side would fall below this is not shrunk any more, in pixels.
const SHORTEST_SIDE: u32 = 32;

impl Views {
    /// Uploads every training photograph in as many sizes as there are levels, and takes its statistics once.
    pub(super) fn upload(
        gpu: &Gpu,
        pseudo_gt: &mut PseudoGt,
        dataset: &Dataset,
        levels: usize,
    ) -> Result<Self> {
        let photographs = dataset.views.iter().enumerate();
        let photographs: Vec<_> = photographs
            .filter(|(_, view)| view.is_train())
            .filter_map(|(index, view)| view.image.as_ref().map(|image| (index, view, image)))
            .collect();
        let (mut views, mut statistics) = (vec![], vec![]);
        views.resize_with(levels, Vec::<TrainView>::new);
        for (place, &(index, view, image)) in photographs.iter().enumerate() {
            for (level, views) in views.iter_mut().enumerate() {
                let size = shrunk(UVec2::new(image.width, image.height), level as u32);
                let own = image.resized(size.x, size.y);
                let pixels = gpu.buffer("low", &own.data)?;
                if level == 0 {
                    gpu.run("statistics", |pass| {
                        pseudo_gt.statistics(pass, &pixels, [image.width, image.height])
                    })?;
                    statistics.push(pseudo_gt.measured()?);
                }
                let depth = view.depth.as_ref().filter(|_| level > 0);
                views.push(TrainView {
                    name: view.name.clone(),
                    number: level * photographs.len() + place,
                    place,
                    index,
                    camera: view.camera.resized(size.x, size.y),
                    depth: depth.map(|depth| resized_plane(depth, image, size)),
                    image: pixels,
                    baked: None,
                    tone: gpu
                        .buffer("tone", &[pseudo_gt.settings().parameters(&statistics[place])])?,
                });
            }
        }
        let settings = pseudo_gt.settings();
        if let Some(scene) = Statistics::mean_of(&statistics).filter(|_| settings.scene_statistics)
        {
            let parameters = settings.parameters(&scene);
            for view in views.iter_mut().flatten() {
                gpu.write(&mut view.tone, &[parameters])?;
            }
        }
        if settings.needs_baking() {
            for view in views.iter_mut().flatten() {
                view.bake(gpu, pseudo_gt)?;
            }
        }
        Ok(Self(views))
    }

    /// What the loss terms may compare the views with.
    pub(super) fn sources<'a>(
        &'a self,
        gpu: &'a Gpu,
        pseudo_gt: &'a PseudoGt,
        dataset: &'a Dataset,
    ) -> Vec<ViewSource<'a>> {
        let source = |view: &'a TrainView| ViewSource {
            size: view.size(),
            depth: view.depth.as_deref().or(dataset.views[view.index].depth.as_deref()),
            target: Box::new(|| view.target(gpu, pseudo_gt)),
        };
        self.0.iter().flatten().map(source).collect()
    }

    /// The view that a step trains on, at one of the levels: every epoch takes each view once, in an order of its own.
    pub(super) fn of_step(&self, seed: u64, step: u64, level: usize) -> &TrainView {
        let views = &self.0[level];
        let count = views.len() as u64;
        let (epoch, place) = ((step - 1) / count, (step - 1) % count);
        let stream = Stream::new(seed, streams::VIEWS);
        // Fisher-Yates from the end; the picks of an epoch only depend on its number.
        let mut order: Vec<usize> = (0..views.len()).collect();
        for left in (1..count).rev() {
            let draw = stream.bits(epoch * count + left) % (left + 1);
            order.swap(left as usize, draw as usize);
        }
        &views[order[place as usize]]
    }

    pub(super) fn cameras(&self) -> impl Iterator<Item = &Camera> {
        self.0.iter().flatten().map(|view| &view.camera)
    }

    /// The names of the training photographs.
    pub(super) fn names(&self) -> impl Iterator<Item = &str> {
        self.0.first().into_iter().flatten().map(|view| view.name.as_str())
    }

    /// Width and height of every view, unshrunk.
    pub(super) fn sizes(&self) -> Vec<UVec2> {
        self.0.first().into_iter().flatten().map(TrainView::size).collect()
    }

    /// One Gaussian per point of the dataset, or per random point where there is none, coloured as the targets of the
    /// training views show it.
    pub(super) fn initial_gaussians(
        &self,
        gpu: &Gpu,
        pseudo_gt: &PseudoGt,
        dataset: &Dataset,
        config: &TrainConfig,
        exposures: Option<&[Affine]>,
    ) -> Result<Gaussians> {
        let random;
        let points = if dataset.points.is_empty() {
            let cameras: Vec<Camera> = self.cameras().cloned().collect();
            let count = config.random_points.min(config.max_gaussians);
            let seed = Stream::new(config.seed, streams::POINTS).bits(0);
            tracing::info!("no points in the dataset: {count} random ones");
            let point = |position| Point { position, views: vec![] };
            random = init::random(&cameras, count, seed).into_iter().map(point).collect();
            &random
        } else {
            &dataset.points
        };
        let kept = &points[..points.len().min(config.max_gaussians)];
        let colors = init::colors_from_views(kept, &dataset.views, |index| {
            let view = self.0.iter().flatten().find(|view| view.index == index);
            let target = view.map(|view| {
                let target = view.target_image(gpu, pseudo_gt)?;
                let exposure = exposures.and_then(|exposures| exposures.get(view.place));
                Ok(exposure.map_or(target.clone(), |own| own.inverse().applied(&target)))
            });
            target.transpose()
        })?;
        let positions: Vec<DVec3> = kept.iter().map(|point| point.position).collect();
        let seed = Stream::new(config.seed, streams::FEATURES).bits(0);
        let shape = Shape { sh_degree: config.sh_degree, features: config.model.features() };
        init::from_points(&positions, &colors, shape, seed)
    }
}

/// A size halved as often as its level says and its shorter side allows.
fn shrunk(size: UVec2, level: u32) -> UVec2 {
    let suits = |&level: &u32| level == 0 || (size >> level).min_element() >= SHORTEST_SIDE;
    (0..=level).rev().find(suits).map_or(size, |level| size >> level)
}

/// A plane of the size of `image` at another size: the means of the areas.
fn resized_plane(plane: &[f32], image: &Image, size: UVec2) -> Vec<f32> {
    let Image { width, height, .. } = *image;
    let mut data = Image { width, height, data: plane.repeat(3) }.resized(size.x, size.y).data;
    data.truncate(size.x as usize * size.y as usize);
    data
}

impl TrainView {
    /// Width and height in pixels.
    pub(super) fn size(&self) -> UVec2 {
        UVec2::new(self.camera.width, self.camera.height)
    }

    /// What the loss applies its curve to.
    pub(super) fn loss_input(&self) -> &Buffer<f32> {
        self.baked.as_deref().unwrap_or(&self.image)
    }

    /// Makes the target now, in place of the loss kernels.
    fn bake(&mut self, gpu: &Gpu, pseudo_gt: &PseudoGt) -> Result<()> {
        self.baked = Some(self.target(gpu, pseudo_gt)?);
        gpu.write(
            &mut self.tone,
            &[ToneSettings::new(ToneCurve::None).parameters(&Statistics::default())],
        )
    }

    /// The pseudo-GT of the view, (3, H, W).
    fn target(&self, gpu: &Gpu, pseudo_gt: &PseudoGt) -> Result<Arc<Buffer<f32>>> {
        if let Some(baked) = &self.baked {
            return Ok(Arc::clone(baked));
        }
        let mut target = gpu.uninit("target", self.image.len())?;
        gpu.run("target", |pass| pseudo_gt.map(pass, &self.image, &self.tone, 0, &mut target))?;
        Ok(Arc::new(target))
    }

    fn target_image(&self, gpu: &Gpu, pseudo_gt: &PseudoGt) -> Result<Image> {
        let data = gpu.read(&*self.target(gpu, pseudo_gt)?)?;
        let Camera { width, height, .. } = self.camera;
        Ok(Image { width, height, data })
    }
}
