//! The training views on the device: dark photographs, their curves, and the order in which steps take them.

use std::borrow::Cow;
use std::collections::{BTreeMap, BTreeSet};
use std::ops::RangeInclusive;
use std::sync::Arc;

use glam::{DVec3, UVec2, Vec3};
use serde::Serialize;

use super::cache::{Cache, CacheSize, Kept};
use super::precision::Darkroom;
use super::{TrainConfig, streams};
use crate::Result;
use crate::base::random::Stream;
use crate::camera::{Camera, Frame, Patch};
use crate::gpu::{Buffer, Gpu};
use crate::kernels::ToneParameters;
use crate::loss::ViewSource;
use crate::loss::exposure::Affine;
use crate::networks::Form;
use crate::photographs::dataset::{Dataset, Point, View};
use crate::photographs::image::Image;
use crate::photographs::pseudo_gt::PseudoGt;
use crate::photographs::tone::{
    Exposure, Measured, Scene, Statistics, ToneCurve, ToneSettings, all_black,
};
use crate::splats::render::{Viewpoint, Viewpoints};
use crate::splats::scene::{COLOR_CHANNELS, Feature, Gaussians, Shape, init};

/// One training view: a photograph, or a patch of one that is too large to be trained on at once.
#[derive(Debug)]
pub(super) struct TrainView {
    pub(super) name: String,
    /// Its place among the training views of all levels.
    pub(super) number: usize,
    /// Its photograph's place among those that are trained on.
    pub(super) place: usize,
    /// Index into the dataset's views.
    index: usize,
    /// What it is of its photograph, in the frame.
    pub(super) patch: Patch,
    /// Depth from elsewhere, (H, W), where the dataset's is of another size.
    depth: Option<Vec<f32>>,
    /// What the loss applies `tone` to, planar (3, H, W), sRGB-encoded: the dark photograph, or the target itself.
    pub(super) input: Kept,
    /// The dark photograph, where that is not the input and a network sees it.
    pub(super) photograph: Option<Kept>,
    /// The curve that the photograph gets; one element. Where the input is the target already, none.
    pub(super) tone: Buffer<ToneParameters>,
    /// Whether the input is the target.
    is_baked: bool,
    /// The target, where that is not the input and a network is held to it.
    pub(super) target: Option<Arc<Buffer<f32>>>,
}

/// How bright the targets are, and what a model makes of them.
#[derive(Clone, Debug, Serialize)]
pub struct TargetExposure {
    /// The gain that a model of views with differing gains agrees on, their geometric mean: the exposure at which it
    /// renders and is scored.
    pub model_gain: f64,
    /// What was found for the training photographs together.
    pub scene: Exposure,
    /// The gain of every training view, by name.
    pub gains: BTreeMap<String, f64>,
}

impl TargetExposure {
    fn new(scene: Exposure, gains: BTreeMap<String, f64>) -> Self {
        let logarithms: f64 = gains.values().map(|gain| gain.ln()).sum();
        let model_gain = (logarithms / gains.len().max(1) as f64).exp();
        Self { model_gain, scene, gains }
    }
}

/// All training views in the dataset's order, as they are and then by level of the resolution schedule, each half the
/// size of the one before.
#[derive(Debug)]
pub(super) struct Views {
    levels: Vec<Vec<TrainView>>,
    /// By their numbers.
    viewpoints: Viewpoints,
    /// The places of those that are trained on no more.
    left_out: BTreeSet<usize>,
    cache: Cache,
}

/// A view whose shorter side would fall below this is not shrunk any more, in pixels.
const SHORTEST_SIDE: u32 = 32;

impl Views {
    /// Measures every training photograph, and uploads it or its target in as many sizes as there are levels; the
    /// photographs too where a network sees them. One photograph at a time is in memory at its own size.
    ///
    /// # Errors
    /// Every photograph is as good as black where their exposure is asked for; a photograph can no longer be read; the
    /// device is out of memory or lost.
    pub(super) fn upload(
        gpu: &Gpu,
        pseudo_gt: &mut PseudoGt,
        dataset: &Dataset,
        frame: &Frame,
        config: &TrainConfig,
    ) -> Result<(Self, Scene, Option<TargetExposure>)> {
        let settings = pseudo_gt.settings().clone();
        let keeps_photographs = config.model.denoiser || config.model.tonemapper;
        let (scene, measured) = measured(pseudo_gt, dataset)?;
        let mut darkroom = Darkroom::new(gpu, config.precision.photographs);
        let budget = CacheSize::on_device(config.cache, config.max_vram, gpu);
        let mut cache = Cache::new(gpu, budget, config.spool.clone());
        let mut views = vec![];
        views.resize_with(config.schedule.resolution_levels(), Vec::<TrainView>::new);
        let mut gains = BTreeMap::new();
        for (place, ((index, view), measured)) in photographs(dataset).zip(&measured).enumerate() {
            let lift = settings.lift(&scene, measured);
            gains.extend(lift.gain.map(|gain| (view.name.clone(), gain)));
            let original = if settings.lift_first { view.photograph()? } else { None };
            let target = original.map(|original| pseudo_gt.lifted(&original, &lift)).transpose()?;
            let Some(image) = view.loaded()? else { continue };
            for (level, views) in views.iter_mut().enumerate() {
                let size = shrunk(UVec2::new(image.width, image.height), level as u32);
                let photograph = view.blacked_out(image.resized(size.x, size.y));
                let target = match &target {
                    Some(target) => Some(view.blacked_out(target.resized(size.x, size.y))),
                    None if settings.needs_baking() => Some(pseudo_gt.lifted(&photograph, &lift)?),
                    None => None,
                };
                let camera = frame.camera(&view.camera).resized(size.x, size.y);
                let patches = config.patches(gpu, &camera);
                let is_as_loaded = level == 0 && patches.len() == 1;
                let depth = view.depth.as_ref().filter(|_| !is_as_loaded);
                let print = Print {
                    name: &view.name,
                    place,
                    index,
                    keeps_photograph: target.is_some() && keeps_photographs,
                    photograph,
                    target,
                    depth: depth.map(|depth| resized_plane(depth, &image, size)),
                    tone: lift.parameters,
                };
                for patch in patches {
                    views.push(print.view(gpu, patch, &mut darkroom, &mut cache)?);
                }
            }
        }
        views.iter_mut().flatten().enumerate().for_each(|(number, view)| view.number = number);
        let patches = views.iter().flatten().map(|view| view.patch).collect();
        let viewpoints = Viewpoints::new(gpu, patches)?;
        let views = Self { levels: views, viewpoints, left_out: BTreeSet::new(), cache };
        // The targets of a profile are as bright as its references.
        let exposure = scene.exposure.clone().filter(|_| settings.profile.is_none());
        let exposure = exposure.map(|scene| TargetExposure::new(scene, gains));
        Ok((views, scene, exposure))
    }

    /// Brings to the device what steps need of their views, as many steps as fit there side by side but one at least; the
    /// last of them.
    ///
    /// # Errors
    /// Photographs that wait in a file cannot be read, or the device is out of memory or lost.
    pub(super) fn bring(
        &mut self,
        config: &TrainConfig,
        steps: RangeInclusive<u64>,
    ) -> Result<u64> {
        if self.cache.holds_all() {
            return Ok(*steps.end());
        }
        let (mut wanted, mut bytes, mut last) = (BTreeSet::new(), 0, *steps.start());
        for step in steps {
            let level = config.schedule.resolution_level(step);
            let view = self.of_step(config.seed, step, level);
            let own = view.input.bytes() + view.photograph.as_ref().map_or(0, Kept::bytes);
            let is_new = !wanted.contains(&view.number);
            if !wanted.is_empty() && is_new && bytes + own > self.cache.budget() {
                break;
            }
            bytes += if is_new { own } else { 0 };
            wanted.insert(view.number);
            last = step;
        }
        let (mut all, mut places) = (vec![], vec![]);
        for view in self.levels.iter_mut().flatten() {
            let is_wanted = wanted.contains(&view.number);
            for kept in std::iter::once(&mut view.input).chain(view.photograph.as_mut()) {
                places.extend(is_wanted.then_some(all.len()));
                all.push(kept);
            }
        }
        self.cache.bring(&mut all, &places)?;
        Ok(last)
    }

    /// Keeps the target of every view beside what the loss makes it of, for [`TrainView::kept_target`].
    ///
    /// # Errors
    /// The device is out of memory or lost.
    pub(super) fn keep_targets(&mut self, gpu: &Gpu, pseudo_gt: &PseudoGt) -> Result<()> {
        for view in self.levels.iter_mut().flatten().filter(|view| !view.is_baked) {
            view.target = Some(view.target(gpu, pseudo_gt)?);
        }
        Ok(())
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
        self.levels.iter().flatten().map(source).collect()
    }

    /// The view that a step trains on, at one of the levels: every epoch takes each view once, in an order of its own, and
    /// for one that is left out the next again.
    pub(super) fn of_step(&self, seed: u64, step: u64, level: usize) -> &TrainView {
        let views = &self.levels[level];
        let count = views.len() as u64;
        let (epoch, place) = ((step - 1) / count, (step - 1) % count);
        let stream = Stream::new(seed, streams::VIEWS);
        // Fisher-Yates from the end; the picks of an epoch only depend on its number.
        let mut order: Vec<usize> = (0..views.len()).collect();
        for left in (1..count).rev() {
            let draw = stream.bits(epoch * count + left) % (left + 1);
            order.swap(left as usize, draw as usize);
        }
        let from_place = order.iter().cycle().skip(place as usize).take(views.len());
        let own = from_place.copied().find(|at| !self.left_out.contains(&views[*at].place));
        &views[own.unwrap_or(order[place as usize])]
    }

    /// A view as it is rendered.
    pub(super) fn viewpoint(&self, view: &TrainView) -> Viewpoint<'_> {
        self.viewpoints.get(view.number)
    }

    /// Trains on a view no more; false where there is no other.
    pub(super) fn leave_out(&mut self, place: usize) -> bool {
        let has_others = self.left_out.len() + 1 < self.photographs().count();
        has_others && self.left_out.insert(place)
    }

    /// The names of the views that are trained on no more.
    pub(super) fn left_out(&self) -> Vec<String> {
        let views = self.photographs().filter(|view| self.left_out.contains(&view.place));
        views.map(|view| view.name.clone()).collect()
    }

    /// Leaves these views out, and no other.
    pub(super) fn set_left_out(&mut self, names: &[String]) {
        let views = self.photographs().filter(|view| names.contains(&view.name));
        self.left_out = views.map(|view| view.place).collect();
    }

    /// The views of all levels, by number.
    pub(super) fn all(&self) -> impl Iterator<Item = &TrainView> {
        self.levels.iter().flatten()
    }

    /// The views, unshrunk, those of a photograph side by side.
    pub(super) fn whole(&self) -> &[TrainView] {
        self.levels.first().map_or(&[], Vec::as_slice)
    }

    /// How many floats the largest input, and the largest photograph beside one, have to be decoded to.
    pub(super) fn decoded_lens(&self) -> [usize; 2] {
        let views = || self.levels.iter().flatten();
        let inputs = views().map(|view| view.input.decoded_len()).max();
        let photographs = views().filter_map(|view| view.photograph.as_ref());
        let photographs = photographs.map(Kept::decoded_len).max();
        [inputs, photographs].map(Option::unwrap_or_default)
    }

    /// One view of every photograph, unshrunk.
    pub(super) fn photographs(&self) -> impl Iterator<Item = &TrainView> {
        self.whole().iter().filter(|view| view.patch.is_first())
    }

    /// Warns of every view in which none of the first Gaussians, given in the frame, has its mean: most often its pose is wrong.
    pub(super) fn say_what_shows_nothing(&self, gaussians: &Gaussians) {
        let means: Vec<DVec3> = gaussians.means().iter().map(|mean| mean.as_dvec3()).collect();
        for TrainView { name, patch, .. } in self.photographs() {
            if !means.iter().any(|&mean| patch.camera.sees(mean).is_some()) {
                tracing::warn!(
                    "view {name} shows nothing: none of the {} first Gaussians lies in it; check its pose",
                    means.len()
                );
            }
        }
    }

    /// The names of the training photographs.
    pub(super) fn names(&self) -> impl Iterator<Item = &str> {
        self.photographs().map(|view| view.name.as_str())
    }

    /// Width and height of every view, unshrunk.
    pub(super) fn sizes(&self) -> Vec<UVec2> {
        self.whole().iter().map(TrainView::size).collect()
    }

    /// The points of the dataset, with random ones behind them where there is none or few.
    fn points<'a>(
        &self,
        dataset: &'a Dataset,
        config: &TrainConfig,
        frame: &Frame,
    ) -> Cow<'a, [Point]> {
        let own = &dataset.points;
        let wanted = if own.is_empty() { config.random_points } else { config.density.few() };
        let count = wanted.min(config.max_gaussians).saturating_sub(own.len());
        if count == 0 {
            return own.into();
        }
        let firsts = self.all().filter(|view| view.patch.is_first());
        let cameras: Vec<Camera> = firsts.map(|view| view.patch.camera).collect();
        let seed = Stream::new(config.seed, streams::POINTS).bits(0);
        let found = if own.is_empty() { "no".to_owned() } else { own.len().to_string() };
        tracing::info!("{found} points in the dataset: {count} random ones");
        let point = |position| Point { position: frame.to_world(position), views: vec![] };
        let random = init::random(&cameras, count, seed).into_iter().map(point);
        own.iter().cloned().chain(random).collect()
    }

    /// One Gaussian per point of the dataset, and per random point where there is none or few, coloured as the targets of
    /// the training views show it.
    pub(super) fn initial_gaussians(
        &self,
        gpu: &Gpu,
        pseudo_gt: &PseudoGt,
        dataset: &Dataset,
        config: &TrainConfig,
        exposures: Option<&[Affine]>,
    ) -> Result<Gaussians> {
        let frame = config.frame.unwrap_or_default();
        let points = self.points(dataset, config, &frame);
        let kept = &points[..points.len().min(config.max_gaussians)];
        let fitting = config.render_settings().most_gaussians(gpu);
        if kept.len() > fitting {
            let (of, device) = (kept.len(), &gpu.properties().name);
            tracing::warn!("{fitting} of {of} points begin as Gaussians: {device} binds no more");
        }
        let kept = &kept[..kept.len().min(fitting)];
        let colors = init::colors_from_views(kept, &dataset.views, |index| {
            let Some(view) = self.photographs().find(|view| view.index == index) else {
                return Ok(None);
            };
            let target = self.put_together(gpu, view.place, |view| view.target(gpu, pseudo_gt))?;
            let exposure = exposures.and_then(|exposures| exposures.get(view.place));
            Ok(Some(exposure.map_or(target.clone(), |own| own.inverse().applied(&target))))
        })?;
        let positions: Vec<DVec3> =
            kept.iter().map(|point| frame.from_world(point.position)).collect();
        let seed = Stream::new(config.seed, streams::FEATURES).bits(0);
        let shape = Shape { sh_degree: config.sh_degree, features: config.model.features() };
        let mut gaussians = init::from_points(&positions, &colors, shape, &config.start, seed)?;
        if config.model.network.form == Form::Identity {
            let low = if shape.features.illumination {
                init::colors_from_views(kept, &dataset.views, |index| {
                    let view = self.photographs().find(|view| view.index == index);
                    let low = |view: &TrainView| view.whole_photograph(gpu);
                    view.map(|view| self.put_together(gpu, view.place, low)).transpose()
                })?
            } else {
                vec![]
            };
            begin_as_identity(&mut gaussians, &colors, &low);
        }
        Ok(gaussians)
    }
}

/// A photograph at the size of a level.
struct Print<'a> {
    name: &'a str,
    place: usize,
    index: usize,
    photograph: Image,
    /// None where the loss makes it.
    target: Option<Image>,
    /// Whether the photograph stays beside the target.
    keeps_photograph: bool,
    /// Where it is not the dataset's.
    depth: Option<Vec<f32>>,
    tone: ToneParameters,
}

impl Print<'_> {
    fn view(
        &self,
        gpu: &Gpu,
        patch: Patch,
        darkroom: &mut Darkroom,
        cache: &mut Cache,
    ) -> Result<TrainView> {
        let mut upload =
            |name, image: &Image| cache.keep(darkroom.upload(name, &patch.cut(&image.data))?);
        let photograph = self.keeps_photograph.then(|| upload("low", &self.photograph));
        let (input, tone) = match &self.target {
            Some(target) => {
                let none = ToneSettings::new(ToneCurve::None).parameters(&Statistics::default());
                (upload("target", target)?, none)
            }
            None => (upload("low", &self.photograph)?, self.tone),
        };
        Ok(TrainView {
            name: self.name.to_owned(),
            number: 0,
            place: self.place,
            index: self.index,
            patch,
            depth: self.depth.as_ref().map(|depth| patch.cut(depth).into_owned()),
            input,
            photograph: photograph.transpose()?,
            tone: gpu.buffer("tone", &[tone])?,
            is_baked: self.target.is_some(),
            target: None,
        })
    }
}

/// Sets the features that parts of the model begin with so that nothing changes: no structure, and the illumination that
/// makes of each point's colour what the dark photographs show of it. Depth, which is correlated, stays as drawn.
fn begin_as_identity(gaussians: &mut Gaussians, colors: &[Vec3], low: &[Vec3]) {
    /// Darker targets say nothing of the light.
    const DARKEST: f32 = 1.0 / 255.0;
    let features = gaussians.shape.features;
    let places = |feature| {
        let channels = features.channels_of(feature).unwrap_or_default();
        channels.map(|channel| channel - COLOR_CHANNELS)
    };
    let width = features.width();
    for (i, own) in gaussians.features_mut().chunks_mut(width.max(1)).enumerate() {
        places(Feature::Structure).for_each(|at| own[at] = 0.0);
        for (channel, at) in places(Feature::Illumination).enumerate() {
            own[at] = (low[i][channel] / colors[i][channel].max(DARKEST)).clamp(0.0, 1.0);
        }
    }
}

/// The training views that have a photograph, and their places in the dataset.
fn photographs(dataset: &Dataset) -> impl Iterator<Item = (usize, &View)> {
    let views = dataset.views.iter().enumerate();
    views.filter(|(_, view)| view.is_train() && view.has_photograph())
}

/// What is measured of all training photographs together, and of each.
///
/// # Errors
/// Every photograph is as good as black where their exposure is asked for; a photograph can no longer be read; the
/// device is out of memory or lost.
pub(super) fn measured(
    pseudo_gt: &mut PseudoGt,
    dataset: &Dataset,
) -> Result<(Scene, Vec<Measured>)> {
    let lift_first = pseudo_gt.settings().lift_first;
    let mut measured = vec![];
    for (_, view) in photographs(dataset) {
        let Some(photograph) = lifted_from(view, lift_first)? else { continue };
        measured.push(pseudo_gt.measure(&view.counted(&photograph))?.seen_by(&view.camera));
    }
    let scene = pseudo_gt.settings().scene(&measured).ok_or_else(|| all_black(&dataset.root))?;
    Ok((scene, measured))
}

/// What is measured of a view and becomes its target: the photograph as its camera took it where it is lifted before it is
/// shrunk, else as it was loaded; none where the view has none.
///
/// # Errors
/// As [`View::photograph`].
pub(super) fn lifted_from(view: &View, lift_first: bool) -> Result<Option<Cow<'_, Image>>> {
    if lift_first { view.photograph() } else { view.loaded() }
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
        self.patch.size
    }

    /// The dark photograph, planar (3, H, W); only there where it is the input, or was kept.
    fn whole_photograph(&self, gpu: &Gpu) -> Result<Arc<Buffer<f32>>> {
        self.photograph.as_ref().unwrap_or(&self.input).whole(gpu)
    }

    /// The pseudo-GT of the view, (3, H, W), where the input is that, or it was kept.
    pub(super) fn kept_target(&self, gpu: &Gpu) -> Result<Arc<Buffer<f32>>> {
        self.target.as_ref().map_or_else(|| self.input.whole(gpu), |target| Ok(Arc::clone(target)))
    }

    /// The pseudo-GT of the view, (3, H, W).
    pub(super) fn target(&self, gpu: &Gpu, pseudo_gt: &PseudoGt) -> Result<Arc<Buffer<f32>>> {
        if self.is_baked {
            return self.input.whole(gpu);
        }
        let input = self.input.whole(gpu)?;
        let mut target = gpu.uninit("target", self.input.len())?;
        gpu.run("target", |pass| pseudo_gt.map(pass, &input, &self.tone, 0, &mut target))?;
        Ok(Arc::new(target))
    }

    /// Pixels of the view on the host.
    pub(super) fn image(&self, gpu: &Gpu, pixels: &Buffer<f32>) -> Result<Image> {
        let data = gpu.read(pixels)?;
        let UVec2 { x: width, y: height } = self.size();
        Ok(Image { width, height, data })
    }
}
