//! The training views on the device: dark photographs, their curves, and the order in which steps take them.

use std::sync::Arc;

use glam::{DVec3, UVec2};

use super::{TrainConfig, streams};
use crate::Result;
use crate::camera::Camera;
use crate::dataset::{Dataset, Point};
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
    /// Its place among the training views.
    pub(super) number: usize,
    /// Index into the dataset's views.
    index: usize,
    pub(super) camera: Camera,
    /// The dark photograph, planar (3, H, W), sRGB-encoded.
    pub(super) image: Buffer<f32>,
    /// The target, where the loss does not evaluate the curve.
    baked: Option<Arc<Buffer<f32>>>,
    /// The curve that its statistics give; one element. Of a baked target none.
    pub(super) tone: Buffer<ToneParameters>,
}

/// All training views, in the dataset's order.
#[derive(Debug)]
pub(super) struct Views(Vec<TrainView>);

impl Views {
    /// Uploads every training photograph and takes its statistics once.
    pub(super) fn upload(gpu: &Gpu, pseudo_gt: &mut PseudoGt, dataset: &Dataset) -> Result<Self> {
        let (mut views, mut statistics) = (Vec::<TrainView>::new(), vec![]);
        for (index, view) in dataset.views.iter().enumerate() {
            let Some(image) = view.image.as_ref().filter(|_| view.is_train()) else { continue };
            let pixels = gpu.buffer("low", &image.data)?;
            gpu.run("statistics", |pass| {
                pseudo_gt.statistics(pass, &pixels, [image.width, image.height])
            })?;
            let measured = pseudo_gt.measured()?;
            statistics.push(measured);
            views.push(TrainView {
                name: view.name.clone(),
                number: views.len(),
                index,
                camera: view.camera,
                image: pixels,
                baked: None,
                tone: gpu.buffer("tone", &[pseudo_gt.settings().parameters(&measured)])?,
            });
        }
        let settings = pseudo_gt.settings();
        if let Some(scene) = Statistics::mean_of(&statistics).filter(|_| settings.scene_statistics)
        {
            let parameters = settings.parameters(&scene);
            for view in &mut views {
                gpu.write(&mut view.tone, &[parameters])?;
            }
        }
        if settings.needs_baking() {
            for view in &mut views {
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
            depth: dataset.views[view.index].depth.as_deref(),
            target: Box::new(|| view.target(gpu, pseudo_gt)),
        };
        self.0.iter().map(source).collect()
    }

    /// The view that a step trains on: every epoch takes each view once, in an order of its own.
    pub(super) fn of_step(&self, seed: u64, step: u64) -> &TrainView {
        let count = self.0.len() as u64;
        let (epoch, place) = ((step - 1) / count, (step - 1) % count);
        let stream = Stream::new(seed, streams::VIEWS);
        // Fisher-Yates from the end; the picks of an epoch only depend on its number.
        let mut order: Vec<usize> = (0..self.0.len()).collect();
        for left in (1..count).rev() {
            let draw = stream.bits(epoch * count + left) % (left + 1);
            order.swap(left as usize, draw as usize);
        }
        &self.0[order[place as usize]]
    }

    pub(super) fn cameras(&self) -> impl Iterator<Item = &Camera> {
        self.0.iter().map(|view| &view.camera)
    }

    /// Width and height of every view.
    pub(super) fn sizes(&self) -> Vec<UVec2> {
        self.0.iter().map(TrainView::size).collect()
    }

    /// One Gaussian per point of the dataset, or per random point where there is none, coloured as the targets of the
    /// training views show it.
    pub(super) fn initial_gaussians(
        &self,
        gpu: &Gpu,
        pseudo_gt: &PseudoGt,
        dataset: &Dataset,
        config: &TrainConfig,
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
            let view = self.0.iter().find(|view| view.index == index);
            view.map(|view| view.target_image(gpu, pseudo_gt)).transpose()
        })?;
        let positions: Vec<DVec3> = kept.iter().map(|point| point.position).collect();
        let seed = Stream::new(config.seed, streams::FEATURES).bits(0);
        let shape = Shape { sh_degree: config.sh_degree, features: config.model.features() };
        init::from_points(&positions, &colors, shape, seed)
    }
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
