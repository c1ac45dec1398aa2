//! The training views on the device: photographs, their curves, and the order of steps.

use std::collections::BTreeSet;
use std::ops::{Range, RangeInclusive};
use std::sync::Arc;

use glam::UVec2;
use nightsplat_core::camera::Patch;
use nightsplat_core::watch::Stage;
use nightsplat_models::gaussians::COLOR_CHANNELS;
use nightsplat_photographs::dataset::{Dataset, NormalMap};
use nightsplat_photographs::image::Image;
use nightsplat_photographs::scene_tone::photographs;

use super::cache::{Cache, CacheSize, CacheSlot};
use super::config::TrainConfig;
use super::epochs::Epochs;
use super::precision::Encoder;
use crate::Result;
use crate::gpu::{Buffer, Download, Recorder};
use crate::kernels::ToneParameters;
use crate::loss::ViewSource;
use crate::splats::render::{Viewpoint, Viewpoints};
use crate::targets::Targets;
use crate::targets::pseudo_gt::PseudoGt;

/// A training view: a photograph, or a patch of a large one.
#[derive(Debug)]
pub(super) struct TrainView {
    pub(super) name: String,
    pub(super) id: TrainingView,
    pub(super) photograph: TrainingPhotograph,
    pub(super) in_dataset: DatasetView,
    /// Its part of the photograph, in the frame.
    pub(super) patch: Patch,
    /// The given depth, (H, W), if the dataset's map has another size.
    depth: Option<Vec<f32>>,
    /// The given normals, (H, W), likewise.
    normals: Option<Vec<u32>>,
    /// The stored image from which its target is made in every step: planar (3, H, W), sRGB-encoded.
    stored: CacheSlot,
    /// Whether that is the dark photograph, to which the curve is applied; else it is the target, tone-mapped at the
    /// photograph's own size.
    gets_curve: bool,
    /// The dark photograph, if it is not the stored image and a network uses it.
    dark: Option<CacheSlot>,
}

/// An index into the dataset's views.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct DatasetView(pub(super) usize);

/// The position of a photograph among those trained on.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct TrainingPhotograph(pub(super) usize);

/// The position of a view among the training views of all levels.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct TrainingView(pub(super) usize);

/// All training views in the dataset's order, at full size and then for each level of the resolution schedule at half
/// the size of the one before.
#[derive(Debug)]
pub(super) struct Views {
    all: Vec<TrainView>,
    /// The views of each level.
    levels: Vec<Range<usize>>,
    pub(super) viewpoints: Viewpoints,
    /// The photographs left out of training.
    left_out: BTreeSet<TrainingPhotograph>,
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
        targets: &Targets,
        dataset: &Dataset,
        config: &TrainConfig,
    ) -> Result<Self> {
        let Targets { scene, pseudo_gt } = targets;
        let gpu = pseudo_gt.gpu();
        let keeps_photographs = config.model.denoiser || config.model.tonemapper;
        let frame = config.frame.unwrap_or_default();
        let mut encoder = Encoder::new(gpu, config.precision.photographs);
        let budget = CacheSize::on_device(config.cache, config.max_vram, gpu);
        let mut cache = Cache::new(gpu, budget, config.spool.clone());
        let mut levels = vec![];
        levels.resize_with(config.resolution_levels(), Vec::<TrainView>::new);
        let mut curves = vec![];
        let stage = Stage::begin("uploading photographs", photographs(dataset).count());
        for (at, (index, view)) in photographs(dataset).enumerate() {
            stage.next()?;
            let Some(curve) = scene.curve_of_view(view)? else { continue };
            curves.push(curve);
            let Some(image) = view.loaded()? else { continue };
            let loaded_size = UVec2::new(image.width, image.height);
            let sizes = (0..levels.len()).map(|level| shrunk(loaded_size, level as u32));
            let sizes: Vec<UVec2> = sizes.collect();
            // At its own size, the curve is applied in every step.
            let photograph_size = view.own_size().filter(|_| scene.settings().full_resolution);
            let is_larger = photograph_size
                .filter(|photograph_size| sizes.iter().any(|size| size != photograph_size));
            let whole = if is_larger.is_some() { view.photograph()? } else { None };
            let whole = whole.map(|whole| pseudo_gt.tone_mapped(&whole, &curve)).transpose()?;
            let whole = targets.external(view)?.or(whole);
            for (views, size) in levels.iter_mut().zip(sizes) {
                let resized = |whole: &Image| view.blacked_out(whole.resized(size.x, size.y));
                let camera = frame.camera(&view.camera).resized(size.x, size.y);
                let patches = config.patches(gpu, &camera);
                let is_as_loaded =
                    size == UVec2::new(image.width, image.height) && patches.len() == 1;
                let depth = view.depth.as_ref().filter(|_| !is_as_loaded);
                let normals = view.normals.as_ref().filter(|_| !is_as_loaded);
                let print = LevelImage {
                    name: &view.name,
                    photograph: TrainingPhotograph(at),
                    in_dataset: DatasetView(index),
                    keeps_dark: keeps_photographs,
                    dark: resized(&image),
                    target: whole.as_ref().filter(|_| photograph_size != Some(size)).map(resized),
                    depth: depth.map(|depth| resized_plane(depth, &image, size)),
                    normals: normals.map(|map| map.resized(size.x, size.y)),
                };
                for patch in patches {
                    views.push(print.view(patch, &mut encoder, &mut cache)?);
                }
            }
        }
        let end_of = |level: usize| levels[..level].iter().map(Vec::len).sum();
        let ranges = (0..levels.len()).map(|level| end_of(level)..end_of(level + 1)).collect();
        let mut all: Vec<TrainView> = levels.into_iter().flatten().collect();
        all.iter_mut().enumerate().for_each(|(at, view)| view.id = TrainingView(at));
        Ok(Self {
            viewpoints: Viewpoints::new(gpu, all.iter().map(|view| view.patch).collect())?,
            all,
            levels: ranges,
            left_out: BTreeSet::new(),
            cache,
            epochs: Epochs::default(),
            curves: gpu.buffer("curves", &curves)?,
        })
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
        let (mut taken, mut wanted) = (BTreeSet::new(), vec![]);
        let (mut bytes, mut last) = (0, *steps.start());
        for step in steps {
            let view = self.get(self.at_step(config, step));
            let slots = [Some(view.stored), view.dark].into_iter().flatten();
            let bytes_of_view: u64 = slots.clone().map(|slot| self.cache.bytes(slot)).sum();
            let is_new = !taken.contains(&view.id);
            if !taken.is_empty() && is_new && bytes + bytes_of_view > self.cache.budget() {
                break;
            }
            if taken.insert(view.id) {
                bytes += bytes_of_view;
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
        pseudo_gt: &'a PseudoGt,
        dataset: &'a Dataset,
    ) -> Vec<ViewSource<'a>> {
        let source = |view: &'a TrainView| ViewSource {
            size: view.size(),
            camera: (&view.patch).into(),
            depth: view.depth.as_deref().or(dataset.views[view.in_dataset.0].depth.as_deref()),
            normals: view
                .normals
                .as_deref()
                .or_else(|| Some(dataset.views[view.in_dataset.0].normals.as_ref()?.packed())),
            target: Box::new(|| self.target(pseudo_gt, view)),
        };
        self.all.iter().map(source).collect()
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
        let photograph = self.cache.on_device(view.dark.unwrap_or(view.stored))?;
        pseudo_gt.record(pass, photograph, None, scratch)
    }

    /// The curve from the stored image of a view to its target.
    fn curve(&self, view: &TrainView) -> Option<(&Buffer<ToneParameters>, u32)> {
        view.gets_curve.then_some((&self.curves, view.photograph.0 as u32))
    }

    /// Reads back targets or dark photographs of views, (3, H, W), in one submission.
    pub(super) fn read(
        &self,
        pseudo_gt: &PseudoGt,
        views: &[TrainView],
        kind: ImageKind,
    ) -> Result<Vec<Vec<f32>>> {
        let gpu = pseudo_gt.gpu();
        let (mut stored, mut scratch) = (vec![], vec![]);
        for view in views {
            let slot = view.dark.filter(|_| kind == ImageKind::Photographs);
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
    fn target(&self, pseudo_gt: &PseudoGt, view: &TrainView) -> Result<Arc<Buffer<f32>>> {
        let gpu = pseudo_gt.gpu();
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
    pub(super) fn whites(&self, pseudo_gt: &PseudoGt) -> Result<Vec<[f32; 3]>> {
        /// Photographs of one submission.
        const AT_ONCE: usize = 256;
        let gpu = pseudo_gt.gpu();
        let white = gpu.buffer("white", &[1.0; COLOR_CHANNELS])?;
        let indices: Vec<usize> = (0..self.curves.len()).collect();
        let mut whites = vec![];
        for indices in indices.chunks(AT_ONCE) {
            let target = |_| gpu.uninit("white_target", COLOR_CHANNELS);
            let mut targets = indices.iter().map(target).collect::<Result<Vec<_>>>()?;
            let mut downloads = vec![];
            gpu.run("pseudo-GT", |pass| {
                for (&photograph_index, target) in indices.iter().zip(&mut targets) {
                    pseudo_gt.map(pass, &white, &self.curves, photograph_index as u32, target)?;
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

    /// The view of a step: every epoch takes each view once, in its own order; the view after one that is left out is
    /// taken twice.
    pub(super) fn at_step(&self, config: &TrainConfig, step: u64) -> TrainingView {
        let range = self.levels[config.resolution_level(step)].clone();
        let (order, first) = self.epochs.of_step(config.seed, step, range.len());
        let views = &self.all[range];
        let in_turn = order[first..].iter().chain(&order[..first]);
        let mut kept = in_turn.filter(|at| !self.left_out.contains(&views[**at].photograph));
        views[*kept.next().unwrap_or(&order[first])].id
    }

    pub(super) fn get(&self, TrainingView(at): TrainingView) -> &TrainView {
        &self.all[at]
    }

    /// The camera of a view, on the device.
    pub(super) fn viewpoint(&self, TrainingView(at): TrainingView) -> Viewpoint<'_> {
        self.viewpoints.get(at)
    }

    /// Leaves a photograph out of training; false if it is the last.
    pub(super) fn leave_out(&mut self, photograph: TrainingPhotograph) -> bool {
        let has_others = self.left_out.len() + 1 < self.photographs().count();
        has_others && self.left_out.insert(photograph)
    }

    /// The names of the views left out.
    pub(super) fn left_out(&self) -> Vec<String> {
        let views = self.photographs().filter(|view| self.left_out.contains(&view.photograph));
        views.map(|view| view.name.clone()).collect()
    }

    /// Leaves out exactly these views.
    pub(super) fn set_left_out(&mut self, names: &[String]) {
        let views = self.photographs().filter(|view| names.contains(&view.name));
        self.left_out = views.map(|view| view.photograph).collect();
    }

    /// The views of all levels.
    pub(super) fn all(&self) -> &[TrainView] {
        &self.all
    }

    /// The full-size views, grouped by photograph.
    pub(super) fn whole(&self) -> &[TrainView] {
        self.levels.first().map_or(&[], |range| &self.all[range.clone()])
    }

    /// The number of values of the largest view.
    pub(super) fn largest_view_values(&self) -> usize {
        let values = |view: &TrainView| COLOR_CHANNELS * view.size().element_product() as usize;
        self.all.iter().map(values).max().unwrap_or_default()
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
    photograph: TrainingPhotograph,
    in_dataset: DatasetView,
    dark: Image,
    /// Its target, if the curve was applied at another size.
    target: Option<Image>,
    /// Whether the photograph is kept in addition to the target.
    keeps_dark: bool,
    /// The depth, if it differs from the dataset's map.
    depth: Option<Vec<f32>>,
    /// The normals, likewise.
    normals: Option<NormalMap>,
}

impl LevelImage<'_> {
    fn view(&self, patch: Patch, encoder: &mut Encoder, cache: &mut Cache) -> Result<TrainView> {
        let mut upload =
            |name, image: &Image| cache.keep(encoder.upload(name, &patch.cut(&image.data))?);
        let (stored, dark) = match &self.target {
            Some(target) => {
                let dark = self.keeps_dark.then(|| upload("low", &self.dark)).transpose()?;
                (upload("target", target)?, dark)
            }
            None => (upload("low", &self.dark)?, None),
        };
        Ok(TrainView {
            name: self.name.to_owned(),
            id: TrainingView(0),
            photograph: self.photograph,
            in_dataset: self.in_dataset,
            patch,
            depth: self.depth.as_ref().map(|depth| patch.cut(depth).into_owned()),
            normals: self.normals.as_ref().map(|map| patch.cut(map.packed()).into_owned()),
            stored,
            gets_curve: self.target.is_none(),
            dark,
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
