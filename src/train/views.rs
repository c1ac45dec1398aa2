//! The training views on the device: photographs, their curves, and the order of steps.

use std::collections::{BTreeMap, BTreeSet};
use std::ops::RangeInclusive;
use std::sync::Arc;

use glam::UVec2;

use super::TrainConfig;
use super::cache::{Cache, CacheSize, Slot};
use super::epochs::Epochs;
use super::measuring::{TargetExposure, photographs};
use super::precision::Encoder;
use super::scene_light::SceneLight;
use crate::Result;
use crate::camera::Patch;
use crate::gpu::{Buffer, Download, Gpu, Recorder};
use crate::kernels::ToneParameters;
use crate::loss::ViewSource;
use crate::photographs::dataset::Dataset;
use crate::photographs::image::Image;
use crate::photographs::pseudo_gt::PseudoGt;
use crate::splats::render::{Viewpoint, Viewpoints};
use crate::splats::scene::COLOR_CHANNELS;

/// A training view: a photograph, or a patch of a large one.
#[derive(Debug)]
pub(super) struct TrainView {
    pub(super) name: String,
    /// Its number among the training views of all levels.
    pub(super) number: usize,
    /// The position of its photograph among those trained on.
    pub(super) place: usize,
    /// Index into the dataset's views.
    pub(super) index: usize,
    /// Its part of the photograph, in the frame.
    pub(super) patch: Patch,
    /// The given depth, (H, W), if the dataset's map has another size.
    depth: Option<Vec<f32>>,
    /// The stored image from which its target is made in every step: planar (3, H, W), sRGB-encoded.
    stored: Slot,
    /// Whether that is the dark photograph, to which the curve is applied; else it is the target, tone-mapped at the
    /// photograph's own size.
    gets_curve: bool,
    /// The dark photograph, if it is not the stored image and a network uses it.
    photograph: Option<Slot>,
}

/// A training view.
#[derive(Clone, Copy, Debug)]
pub(super) struct ViewId {
    /// The level of the resolution schedule.
    level: usize,
    /// The index among the views of the level.
    index: usize,
}

/// All training views in the dataset's order, at full size and then for each level of the resolution schedule at half
/// the size of the one before.
#[derive(Debug)]
pub(super) struct Views {
    levels: Vec<Vec<TrainView>>,
    /// By number.
    viewpoints: Viewpoints,
    /// The positions of photographs left out of training.
    left_out: BTreeSet<usize>,
    cache: Cache,
    epochs: Epochs,
    /// The curve of every photograph, by position.
    curves: Buffer<ToneParameters>,
}

/// A view is not resized below this shorter side, in pixels.
const SHORTEST_SIDE: u32 = 32;

impl Views {
    /// Uploads every training photograph or its target for every level, and the photograph if a network uses it. Only
    /// one photograph at a time is in memory at its own size.
    pub(super) fn upload(
        gpu: &Gpu,
        pseudo_gt: &PseudoGt,
        light: &SceneLight,
        dataset: &Dataset,
        config: &TrainConfig,
    ) -> Result<(Self, Option<TargetExposure>)> {
        let settings = pseudo_gt.settings().clone();
        let keeps_photographs = config.model.denoiser || config.model.tonemapper;
        let frame = config.frame.unwrap_or_default();
        let mut encoder = Encoder::new(gpu, config.precision.photographs);
        let budget = CacheSize::on_device(config.cache, config.max_vram, gpu);
        let mut cache = Cache::new(gpu, budget, config.spool.clone());
        let mut views = vec![];
        views.resize_with(config.schedule.resolution_levels(), Vec::<TrainView>::new);
        let (mut gains, mut curves) = (BTreeMap::new(), vec![]);
        for (place, ((index, view), tone_mapping)) in
            photographs(dataset).zip(light.tone_mappings(dataset)?).enumerate()
        {
            gains.extend(tone_mapping.gain.map(|gain| (view.name.clone(), gain)));
            curves.push(tone_mapping.parameters);
            let Some(image) = view.loaded()? else { continue };
            let own = UVec2::new(image.width, image.height);
            let sizes = (0..views.len()).map(|level| shrunk(own, level as u32));
            let sizes: Vec<UVec2> = sizes.collect();
            // At its own size, the curve is applied in every step.
            let own = view.own_size().filter(|_| settings.full_resolution);
            let is_larger = own.filter(|own| sizes.iter().any(|size| size != own));
            let whole = if is_larger.is_some() { view.photograph()? } else { None };
            let whole =
                whole.map(|whole| pseudo_gt.tone_mapped(&whole, &tone_mapping)).transpose()?;
            for (views, size) in views.iter_mut().zip(sizes) {
                let resized = |whole: &Image| view.blacked_out(whole.resized(size.x, size.y));
                let camera = frame.camera(&view.camera).resized(size.x, size.y);
                let patches = config.patches(gpu, &camera);
                let is_as_loaded =
                    size == UVec2::new(image.width, image.height) && patches.len() == 1;
                let depth = view.depth.as_ref().filter(|_| !is_as_loaded);
                let print = LevelImage {
                    name: &view.name,
                    place,
                    index,
                    keeps_photograph: keeps_photographs,
                    photograph: resized(&image),
                    target: whole.as_ref().filter(|_| own != Some(size)).map(resized),
                    depth: depth.map(|depth| resized_plane(depth, &image, size)),
                };
                for patch in patches {
                    views.push(print.view(patch, &mut encoder, &mut cache)?);
                }
            }
        }
        views.iter_mut().flatten().enumerate().for_each(|(number, view)| view.number = number);
        let patches = views.iter().flatten().map(|view| view.patch).collect();
        let viewpoints = Viewpoints::new(gpu, patches)?;
        let views = Self {
            levels: views,
            viewpoints,
            left_out: BTreeSet::new(),
            cache,
            epochs: Epochs::default(),
            curves: gpu.buffer("curves", &curves)?,
        };
        // A profile determines the brightness of its targets.
        let scene = light.scene();
        let exposure = scene.exposure.clone().filter(|_| settings.profile.is_none());
        let exposure = exposure.map(|own| TargetExposure::new(own, gains, scene.recorded_gain()));
        Ok((views, exposure))
    }

    /// Makes the images of the next steps resident, for as many steps as fit but at least one; returns the last of
    /// them.
    pub(super) fn make_resident(
        &mut self,
        config: &TrainConfig,
        steps: RangeInclusive<u64>,
    ) -> Result<u64> {
        if self.cache.holds_all() {
            return Ok(*steps.end());
        }
        let (mut numbers, mut wanted) = (BTreeSet::new(), vec![]);
        let (mut bytes, mut last) = (0, *steps.start());
        for step in steps {
            let level = config.schedule.resolution_level(step);
            let view = self.get(self.of_step(config.seed, step, level));
            let slots = [Some(view.stored), view.photograph].into_iter().flatten();
            let own: u64 = slots.clone().map(|slot| self.cache.bytes(slot)).sum();
            let is_new = !numbers.contains(&view.number);
            if !numbers.is_empty() && is_new && bytes + own > self.cache.budget() {
                break;
            }
            if numbers.insert(view.number) {
                bytes += own;
                wanted.extend(slots);
            }
            last = step;
        }
        self.cache.make_resident(&wanted)?;
        Ok(last)
    }

    /// The images that loss terms compare views with.
    pub(super) fn sources<'a>(
        &'a self,
        gpu: &'a Gpu,
        pseudo_gt: &'a PseudoGt,
        dataset: &'a Dataset,
    ) -> Vec<ViewSource<'a>> {
        let source = |view: &'a TrainView| ViewSource {
            size: view.size(),
            depth: view.depth.as_deref().or(dataset.views[view.index].depth.as_deref()),
            target: Box::new(|| self.target(gpu, pseudo_gt, view)),
        };
        self.levels.iter().flatten().map(source).collect()
    }

    /// Records the target of a resident view, (3, H, W), which is either `scratch` or the stored image.
    pub(super) fn record_target<'a>(
        &'a self,
        pass: &mut Recorder<'_>,
        pseudo_gt: &PseudoGt,
        view: &TrainView,
        scratch: &'a mut Buffer<f32>,
    ) -> Result<&'a Buffer<f32>> {
        pseudo_gt.record(pass, self.cache.on_device(view.stored)?, self.curve(view), scratch)
    }

    /// [`Self::record_target`] for the dark photograph of a view, if that is kept.
    pub(super) fn record_photograph<'a>(
        &'a self,
        pass: &mut Recorder<'_>,
        pseudo_gt: &PseudoGt,
        view: &TrainView,
        scratch: &'a mut Buffer<f32>,
    ) -> Result<&'a Buffer<f32>> {
        let photograph = self.cache.on_device(view.photograph.unwrap_or(view.stored))?;
        pseudo_gt.record(pass, photograph, None, scratch)
    }

    /// The curve from the stored image of a view to its target.
    fn curve(&self, view: &TrainView) -> Option<(&Buffer<ToneParameters>, u32)> {
        view.gets_curve.then_some((&self.curves, view.place as u32))
    }

    /// Reads back targets or dark photographs of views, (3, H, W), in one submission.
    pub(super) fn read(
        &self,
        gpu: &Gpu,
        pseudo_gt: &PseudoGt,
        views: &[TrainView],
        kind: ImageKind,
    ) -> Result<Vec<Vec<f32>>> {
        let (mut stored, mut scratch) = (vec![], vec![]);
        for view in views {
            let slot = view.photograph.filter(|_| kind == ImageKind::Photographs);
            let photograph = self.cache.load(slot.unwrap_or(view.stored))?;
            let curve = self.curve(view).filter(|_| kind == ImageKind::Targets);
            scratch.push(gpu.uninit("target", photograph.value_count)?);
            stored.push((photograph, curve));
        }
        let mut downloads = vec![];
        gpu.run("pseudo-GT", |pass| {
            for ((photograph, curve), scratch) in stored.iter().zip(&mut scratch) {
                let target = pseudo_gt.record(pass, photograph, *curve, scratch)?;
                downloads.push(pass.download(target)?);
            }
            Ok(())
        })?;
        downloads.into_iter().map(Download::wait).collect()
    }

    /// The target of a view, (3, H, W), in a new buffer or in the stored one.
    fn target(
        &self,
        gpu: &Gpu,
        pseudo_gt: &PseudoGt,
        view: &TrainView,
    ) -> Result<Arc<Buffer<f32>>> {
        let stored = self.cache.load(view.stored)?;
        let curve = self.curve(view);
        if stored.code_bits == 32 && curve.is_none() {
            return Ok(Arc::clone(&stored.values));
        }
        let mut target = gpu.uninit("target", stored.value_count)?;
        gpu.run("pseudo-GT", |pass| {
            pseudo_gt.record(pass, &stored, curve, &mut target).map(|_| ())
        })?;
        Ok(Arc::new(target))
    }

    /// The target of white of each photograph.
    pub(super) fn whites(&self, gpu: &Gpu, pseudo_gt: &PseudoGt) -> Result<Vec<[f32; 3]>> {
        /// Photographs of one submission.
        const AT_ONCE: usize = 256;
        let white = gpu.buffer("white", &[1.0; COLOR_CHANNELS])?;
        let places: Vec<usize> = (0..self.curves.len()).collect();
        let mut whites = vec![];
        for places in places.chunks(AT_ONCE) {
            let target = |_| gpu.uninit("white_target", COLOR_CHANNELS);
            let mut targets = places.iter().map(target).collect::<Result<Vec<_>>>()?;
            let mut downloads = vec![];
            gpu.run("pseudo-GT", |pass| {
                for (&place, target) in places.iter().zip(&mut targets) {
                    pseudo_gt.map(pass, &white, &self.curves, place as u32, target)?;
                    downloads.push(pass.download(&*target)?);
                }
                Ok(())
            })?;
            for download in downloads {
                let values = download.wait()?;
                whites.push(std::array::from_fn(|channel| values[channel]));
            }
        }
        Ok(whites)
    }

    /// The view of a step at a level: every epoch takes each view once, in its own order; the view after one that is
    /// left out is taken twice.
    pub(super) fn of_step(&self, seed: u64, step: u64, level: usize) -> ViewId {
        let views = &self.levels[level];
        let (order, place) = self.epochs.of_step(seed, step, views.len());
        let from_place = order[place..].iter().chain(&order[..place]);
        let own = from_place.copied().find(|at| !self.left_out.contains(&views[*at].place));
        ViewId { level, index: own.unwrap_or(order[place]) }
    }

    pub(super) fn get(&self, ViewId { level, index }: ViewId) -> &TrainView {
        &self.levels[level][index]
    }

    /// The camera of a view, on the device.
    pub(super) fn viewpoint(&self, view: ViewId) -> Viewpoint<'_> {
        self.viewpoints.get(self.get(view).number)
    }

    /// Leaves a photograph out of training; false if it is the last.
    pub(super) fn leave_out(&mut self, place: usize) -> bool {
        let has_others = self.left_out.len() + 1 < self.photographs().count();
        has_others && self.left_out.insert(place)
    }

    /// The names of the views left out.
    pub(super) fn left_out(&self) -> Vec<String> {
        let views = self.photographs().filter(|view| self.left_out.contains(&view.place));
        views.map(|view| view.name.clone()).collect()
    }

    /// Leaves out exactly these views.
    pub(super) fn set_left_out(&mut self, names: &[String]) {
        let views = self.photographs().filter(|view| names.contains(&view.name));
        self.left_out = views.map(|view| view.place).collect();
    }

    /// The views of all levels, by number.
    pub(super) fn all(&self) -> impl Iterator<Item = &TrainView> {
        self.levels.iter().flatten()
    }

    /// The full-size views, grouped by photograph.
    pub(super) fn whole(&self) -> &[TrainView] {
        self.levels.first().map_or(&[], Vec::as_slice)
    }

    /// The number of values of the largest view.
    pub(super) fn largest_view_values(&self) -> usize {
        let values = |view: &TrainView| COLOR_CHANNELS * view.size().element_product() as usize;
        self.all().map(values).max().unwrap_or_default()
    }

    /// One full-size view of every photograph.
    pub(super) fn photographs(&self) -> impl Iterator<Item = &TrainView> {
        self.whole().iter().filter(|view| view.patch.is_first())
    }

    /// The names of the training photographs.
    pub(super) fn names(&self) -> impl Iterator<Item = &str> {
        self.photographs().map(|view| view.name.as_str())
    }

    /// Width and height of every full-size view.
    pub(super) fn sizes(&self) -> Vec<UVec2> {
        self.whole().iter().map(TrainView::size).collect()
    }
}

/// The kind of image of a view.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum ImageKind {
    /// Its target.
    Targets,
    /// Its dark photograph, if that is kept.
    Photographs,
}

/// A photograph at the size of a level.
struct LevelImage<'a> {
    name: &'a str,
    place: usize,
    index: usize,
    photograph: Image,
    /// Its target, if the curve was applied at another size.
    target: Option<Image>,
    /// Whether the photograph is kept in addition to the target.
    keeps_photograph: bool,
    /// The depth, if it differs from the dataset's map.
    depth: Option<Vec<f32>>,
}

impl LevelImage<'_> {
    fn view(&self, patch: Patch, encoder: &mut Encoder, cache: &mut Cache) -> Result<TrainView> {
        let mut upload =
            |name, image: &Image| cache.keep(encoder.upload(name, &patch.cut(&image.data))?);
        let (stored, photograph) = match &self.target {
            Some(target) => {
                let photograph = self.keeps_photograph.then(|| upload("low", &self.photograph));
                let photograph = photograph.transpose()?;
                (upload("target", target)?, photograph)
            }
            None => (upload("low", &self.photograph)?, None),
        };
        Ok(TrainView {
            name: self.name.to_owned(),
            number: 0,
            place: self.place,
            index: self.index,
            patch,
            depth: self.depth.as_ref().map(|depth| patch.cut(depth).into_owned()),
            stored,
            gets_curve: self.target.is_none(),
            photograph,
        })
    }
}

/// The size halved once per level, as far as its shorter side allows.
fn shrunk(size: UVec2, level: u32) -> UVec2 {
    let suits = |&level: &u32| level == 0 || (size >> level).min_element() >= SHORTEST_SIDE;
    (0..=level).rev().find(suits).map_or(size, |level| size >> level)
}

/// A plane of the size of `image`, resized by area means.
fn resized_plane(plane: &[f32], image: &Image, size: UVec2) -> Vec<f32> {
    let Image { width, height, .. } = *image;
    let mut data = Image { width, height, data: plane.repeat(3) }.resized(size.x, size.y).data;
    data.truncate(size.x as usize * size.y as usize);
    data
}

impl TrainView {
    /// Width and height in pixels.
    pub(super) fn size(&self) -> UVec2 {
        self.patch.size
    }
}
