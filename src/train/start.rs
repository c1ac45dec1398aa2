//! Construction of a trainer from a configuration and a dataset.

use std::panic::resume_unwind;
use std::path::Path;
use std::sync::Arc;
use std::thread::{self, ScopedJoinHandle};

use glam::UVec2;
use nightsplat_core::camera::CameraModel;
use nightsplat_core::watch::Watch;
use nightsplat_models::gaussians::{FEATURES, Gaussians, Shape, ply};
use nightsplat_photographs::dataset::{Dataset, Fingerprint, Original, Split, View};
use nightsplat_photographs::scene_tone::SceneTone;

use super::batching::MAX_STEPS;
use super::cache::CacheSize;
use super::clock::RunClock;
use super::config::TrainConfig;
use super::context::Initial;
use super::gaussians::TrainedGaussians;
use super::lamp::{self, LampLearning};
use super::masks::Masks;
use super::memory::{Memory, activation_bytes};
use super::model::{Density, Optimizer, TrainedModel};
use super::passes::{TrainKernels, first_sh_degree};
use super::supervision::Supervision;
use super::target_views::TargetViews;
use super::terms::NetworkTerms;
use super::trainer::{TrainedScene, Trainer};
use super::views::Views;
use crate::gpu::Gpu;
use crate::loss::exposure::Exposures;
use crate::loss::{LossLog, ParameterTerms};
use crate::targets::Targets;
use crate::{Error, Result};

/// Refuses views whose cameras have no gradients.
fn refuse_orthographic(dataset: &Dataset) -> Result<()> {
    let is_orthographic = |view: &&View| view.camera.model == CameraModel::Orthographic;
    match dataset.views.iter().find(is_orthographic) {
        Some(View { name, .. }) => Err(Error::Usage(format!(
            "view {name} has an orthographic camera, which has no gradients; leave it out"
        ))),
        None => Ok(()),
    }
}

impl TrainConfig {
    /// The Gaussians of a file of [`TrainConfig::init`] in the shape of the configured model; further features are
    /// dropped.
    pub(super) fn initial_model(&self, path: &Path) -> Result<Gaussians> {
        let mut gaussians = ply::load(path)?;
        let (Shape { sh_degree, features }, shape) =
            (self.render_settings().shape, gaussians.shape);
        if shape.sh_degree > sh_degree {
            let problem = format!(
                "has SH degree {}, more than sh_degree, which is {sh_degree}",
                shape.sh_degree
            );
            return Err(Error::input(path, problem));
        }
        let lacks = |feature| features.has(feature) && !shape.features.has(feature);
        if let Some(spec) = FEATURES.iter().find(|spec| lacks(spec.feature)) {
            let (property, name) = (spec.ply_name, spec.name);
            let problem = format!(
                "has no property `f_{property}_0`, which a model with {name} needs; train without that part"
            );
            return Err(Error::input(path, problem));
        }
        if self.model.raw_colors {
            gaussians.shift_colors(0.5);
        }
        Ok(gaussians.with_features(features))
    }

    /// The SH degree in use at a step, at most `highest`.
    pub(super) fn sh_degree_at(&self, step: u64, highest: u32) -> u32 {
        // With fewer degrees, the first steps would train a given model to do without the higher ones.
        let keeps_all = self.init.is_some() && self.schedule.first_sh_degree.is_none();
        if keeps_all { highest } else { self.schedule.sh_degree(step, highest) }
    }
}

impl Trainer {
    /// A trainer for [`Trainer::restore`], which does not read [`TrainConfig::init`].
    pub(crate) fn to_restore(gpu: &Gpu, config: TrainConfig, dataset: &Dataset) -> Result<Self> {
        let initial = Initial::of_restored(&config, dataset)?;
        Self::on_patches(gpu, config, dataset, &initial)
    }

    /// Restarts with smaller patches if the first Gaussians exceed the device's limits with the present ones.
    pub(super) fn on_patches(
        gpu: &Gpu,
        mut config: TrainConfig,
        dataset: &Dataset,
        initial: &Initial,
    ) -> Result<Self> {
        let _phase = tracing::info_span!("upload").entered();
        loop {
            let mut trainer = Self::begin(gpu, config.clone(), dataset, initial)?;
            config.patch_pixels =
                match trainer.supervision.views.fewer_patch_pixels(&mut trainer.model)? {
                    None => {
                        trainer.supervision.views.log_patches(gpu);
                        break Ok(trainer);
                    }
                    fewer => fewer,
                };
            drop(trainer);
            gpu.free_unused();
        }
    }

    fn begin(
        gpu: &Gpu,
        mut config: TrainConfig,
        dataset: &Dataset,
        initial: &Initial,
    ) -> Result<Self> {
        config.check()?;
        refuse_orthographic(dataset)?;
        config.disable_missing_parts(dataset);
        config.frame.get_or_insert_with(|| dataset.frame());
        thread::scope(|scope| {
            // Pipelines are compiled on another thread while the views are uploaded and measured.
            let (config_of_thread, watch) = (config.clone(), Watch::current());
            let beside = scope.spawn(move || {
                watch.within(|| {
                    Ok((
                        TrainKernels::new(gpu, &config_of_thread, dataset)?,
                        Fingerprint::compute(dataset)?,
                    ))
                })
            });
            Self::assemble(gpu, config, dataset, initial, beside)
        })
    }

    fn assemble(
        gpu: &Gpu,
        config: TrainConfig,
        dataset: &Dataset,
        initial: &Initial,
        beside: ScopedJoinHandle<'_, Result<(TrainKernels, Fingerprint)>>,
    ) -> Result<Self> {
        if let Some(CacheSize(bytes)) = config.max_vram {
            gpu.limit_memory(bytes);
        }
        let frame = config.frame.unwrap_or_default();
        let targets = Targets::in_scene(gpu, SceneTone::measure(&config.tone, dataset)?)?;
        let views = Views::upload(&targets, dataset, &config)?;
        let sizes = views.sizes();
        let probes = probes(&targets, dataset, &config, &sizes)?;
        let held_out = held_out(&targets, dataset, &config)?;
        if let Some(exposure) = targets.scene.model_exposure() {
            tracing::info!("{}", exposure.reason());
        }
        config.model.log_parts(&sizes);
        let lamp = config.model.lamp.then(|| lamp::start(&targets, dataset, &config));
        let lamp = lamp.transpose()?;
        let starts = views.exposures(&targets, dataset, &config)?;
        let gaussians = match &initial.gaussians {
            Some(gaussians) => given(gaussians, &config)?,
            None => {
                let lamp = lamp.map(|lamp| lamp.scaled(1.0 / frame.scale));
                let exposures = starts.as_deref();
                views.initial_gaussians(
                    &targets.pseudo_gt,
                    dataset,
                    &config,
                    exposures,
                    lamp.as_ref(),
                )?
            }
        };
        views.warn_of_empty_views(&gaussians);
        if let Some(path) = &config.init {
            views.warn_of_another_world(&gaussians, path);
        }
        let masks = Masks::new(gpu, dataset, &views)?;
        let exposures = starts.map(|starts| {
            let whites = views.whites(&targets.pseudo_gt)?;
            Exposures::new(gpu, config.exposure.rates, &starts, &whites)
        });
        let mut exposures = exposures.transpose()?;
        if let Some(exposures) = &mut exposures {
            sizes.iter().try_for_each(|&size| exposures.reserve(size))?;
        }
        dataset.views.iter().filter_map(|view| view.original.as_ref()).for_each(Original::release);
        let waits = tracing::info_span!("pipelines");
        let (
            TrainKernels { mut renderer, mut losses, adam, finite, floor, densifier },
            fingerprint,
        ) = waits.in_scope(|| beside.join().unwrap_or_else(|panic| resume_unwind(panic)))?;
        if lamp.is_some() {
            renderer.set_lamp(lamp)?;
        }
        losses.prepare(&views.sources(&targets.pseudo_gt, dataset))?;
        let networks = NetworkTerms::new(gpu, &config, &sizes, !masks.is_empty())?;
        let pixels = sizes.iter().map(|size| size.x as usize * size.y as usize).max();
        let values = config.render_settings().trained_channels() * pixels.unwrap_or_default();
        let pictures = views.largest_view_values();
        // Only networks use the photograph in addition to the target.
        let photographs = if networks.is_some() { pictures } else { 0 };
        // A curve without an inverse has no law.
        let law = targets.scene.law().ok();
        let mut supervision = Supervision {
            views,
            targets,
            target: gpu.uninit("target", pictures)?,
            photograph: gpu.uninit("low", photographs)?,
            masks,
            exposures,
            networks,
            losses,
            parameter_terms: ParameterTerms::new(gpu, config.loss, config.frozen_columns())?,
            d_render: gpu.uninit("d_render", values)?,
            log: LossLog::new(gpu, MAX_STEPS as usize)?,
            held_out,
        };
        let degree = initial.context.as_ref().map_or(0, Gaussians::sh_degree_in_use);
        let degree = degree.max(first_sh_degree(&config));
        let (precision, frozen_columns) = (&config.precision, config.frozen_columns());
        let learning = lamp.map(|_| LampLearning::new(gpu, config.lamp.rates)).transpose()?;
        let mut model = TrainedModel {
            gaussians: TrainedGaussians::upload(
                gpu,
                &gaussians,
                degree,
                precision,
                frozen_columns,
            )?,
            renderer,
            optimizer: Optimizer { adam, finite, floor, lamp: learning, checked: 0 },
            density: Density { densifier, probes, has_logged_capacity: false },
            best: vec![],
        };
        // Given Gaussians may have SH degrees that the first step does not use.
        model.renderer.set_sh_degree(model.gaussians.shape().sh_degree)?;
        if let Some(context) = &initial.context {
            model.renderer.set_context(&given(context, &config)?)?;
        }
        model.reserve(&supervision.views)?;
        if let Some(terms) = &mut supervision.networks {
            terms.keep_activations(&sizes, activation_bytes(gpu, &config))?;
        }
        let extent = config.extent_of(dataset) * frame.scale;
        let config = Arc::new(config);
        Ok(Self {
            gpu: gpu.clone(),
            scene: TrainedScene { fingerprint, frame, extent, law },
            memory: Memory::new(gpu, Arc::clone(&config), &model),
            clock: RunClock::new(Arc::clone(&config), !supervision.held_out.is_empty()),
            supervision,
            model,
            config,
        })
    }
}

/// Initial Gaussians, in the frame. The model of a run that ended early may lack the highest SH degree.
fn given(gaussians: &Gaussians, config: &TrainConfig) -> Result<Gaussians> {
    let shape = config.render_settings().shape;
    if !shape.holds(gaussians.shape) {
        let given_shape = gaussians.shape;
        return Err(Error::Usage(format!(
            "Gaussians of shape {given_shape:?} do not fit a model of {shape:?}"
        )));
    }
    Ok(gaussians.with_sh_degree(shape.sh_degree).to_frame(&config.frame.unwrap_or_default()))
}

/// The held-out views, by which a run stops early.
fn held_out(targets: &Targets, dataset: &Dataset, config: &TrainConfig) -> Result<TargetViews> {
    let frame = config.frame.unwrap_or_default();
    let held_out = dataset.views.iter().filter(|view| view.split == Split::HeldOut);
    let held_out = TargetViews::new(targets, held_out, &frame)?;
    if config.stop.views > 0 && held_out.is_empty() {
        tracing::info!("every held-out view is black or masked: the run takes all its steps");
    }
    Ok(held_out)
}

/// Training views on which the cost of a round of density control is measured.
const PROBES: usize = 8;
/// Pixels of each; all take at most 100 MB of host memory.
const MAX_PROBE_PIXELS: usize = 1 << 20;

fn probes(
    targets: &Targets,
    dataset: &Dataset,
    config: &TrainConfig,
    sizes: &[UVec2],
) -> Result<TargetViews> {
    if !config.density.control.strategy().keeps_views {
        return Ok(TargetViews::default());
    }
    // At most as large as the views that steps render.
    let largest = sizes.iter().map(|size| size.element_product() as usize).max();
    let pixels = largest.unwrap_or_default().min(MAX_PROBE_PIXELS);
    let frame = config.frame.unwrap_or_default();
    TargetViews::probes(targets, dataset, &frame, [PROBES, pixels])
}
