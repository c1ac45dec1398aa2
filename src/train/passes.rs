//! The kernels of a step.

use std::panic::resume_unwind;
use std::thread;

use nightsplat_core::random::Stream;
use nightsplat_core::watch::Watch;
use nightsplat_models::attributes::Attribute;
use nightsplat_models::gaussians::Shape;
use nightsplat_photographs::dataset::{Dataset, Photograph};
use nightsplat_photographs::image::PictureFile;

use super::config::{Background, DensityConfig, TrainConfig};
use super::streams;
use crate::gpu::{Gpu, Tile};
use crate::loss::Losses;
use crate::splats::batches::GradientKind;
use crate::splats::densify::{Densifier, DensifySettings};
use crate::splats::optimizer::{Adam, FiniteCheck};
use crate::splats::packed_sh::StorageFormat;
use crate::splats::render::{RenderSettings, Renderer};
use crate::splats::smoothing::SmoothingFloor;
use crate::targets::pseudo_gt::PseudoGt;
use crate::{Error, Result};

/// Kernels that depend only on the device and the settings.
pub(super) struct TrainKernels {
    pub(super) renderer: Renderer,
    pub(super) losses: Losses,
    pub(super) adam: Adam,
    pub(super) finite: FiniteCheck,
    pub(super) floor: Option<SmoothingFloor>,
    pub(super) densifier: Densifier,
}

impl TrainKernels {
    pub(super) fn new(gpu: &Gpu, config: &TrainConfig, dataset: &Dataset) -> Result<Self> {
        Ok(Self {
            renderer: renderer(gpu, config)?,
            losses: Losses::new(gpu, &config.loss())?,
            adam: adam(gpu, config)?,
            finite: FiniteCheck::new(gpu)?,
            floor: floor(gpu, config, dataset)?,
            densifier: densifier(gpu, config, dataset)?,
        })
    }
}

/// Loads the dataset while another thread compiles the kernels for views of the size of its first photograph: as long
/// as loading takes, and one kernel longer. [`TrainKernels::new`] finds them, unless a plan or the other views ask for
/// others. An error of `load` comes first.
pub(super) fn while_compiling<T>(
    gpu: &Gpu,
    config: &TrainConfig,
    load: impl FnOnce() -> Result<T>,
) -> Result<T> {
    let watch = Watch::default();
    thread::scope(|scope| {
        let beside = scope.spawn(|| watch.within(|| compile(gpu, config)));
        let loaded = load();
        watch.stop();
        match beside.join().unwrap_or_else(|panic| resume_unwind(panic)) {
            Ok(()) | Err(Error::Halted { .. }) => loaded,
            Err(error) => loaded.and(Err(error)),
        }
    })
}

/// Compiles the kernels for views of the size of the first photograph.
fn compile(gpu: &Gpu, config: &TrainConfig) -> Result<()> {
    // Loading tells what is wrong with the files.
    let Ok(tile) = first_tile(gpu, config) else { return Ok(()) };
    let config = &TrainConfig { tile: Some(tile), ..config.clone() };
    PseudoGt::new(gpu, &config.tone)?.compile()?;
    renderer(gpu, config)?;
    Losses::new(gpu, &config.loss())?.compile()?;
    adam(gpu, config)?;
    FiniteCheck::new(gpu).map(drop)
}

/// The tile for views of the size of the first photograph.
fn first_tile(gpu: &Gpu, config: &TrainConfig) -> Result<Tile> {
    let options = config.load_options();
    let (photographs, ..) = Dataset::listed(&config.dataset, &options)?;
    let size = |file: &Photograph| PictureFile::open(&file.input)?.size();
    let first = photographs.first().map(size).transpose()?;
    let size = first.map(|(width, height)| options.loaded_size(width, height));
    config.render_settings().tile_for(gpu, size.map(<[u32; 2]>::from).into_iter())
}

fn renderer(gpu: &Gpu, config: &TrainConfig) -> Result<Renderer> {
    let (rest, settings) = (config.precision.rest, config.render_settings());
    Renderer::with_gradients(
        gpu,
        RenderSettings { rest, shape: first_shape(config), ..settings },
        GradientKind::on(gpu, formats(config)),
        config.frozen_columns(),
    )
}

fn adam(gpu: &Gpu, config: &TrainConfig) -> Result<Adam> {
    let adam = Adam::with_frozen(gpu, config.frozen_columns())?;
    if GradientKind::on(gpu, formats(config)) == GradientKind::Colors {
        adam.of_gaussians(first_shape(config), formats(config))?;
    }
    Ok(adam)
}

/// The shape of the Gaussians in the first step.
fn first_shape(config: &TrainConfig) -> Shape {
    Shape { sh_degree: first_sh_degree(config), ..config.render_settings().shape }
}

/// The storage formats of SH coefficients and of moments.
fn formats(config: &TrainConfig) -> [StorageFormat; 2] {
    [config.precision.rest, config.precision.moments]
}

/// The smoothing floor of the training views, in the frame, if it is on.
fn floor(gpu: &Gpu, config: &TrainConfig, dataset: &Dataset) -> Result<Option<SmoothingFloor>> {
    let (variance, near) = (config.antialiasing.smoothing, config.render_settings().near);
    if variance == 0.0 || config.freezes(Attribute::LogScales) {
        return Ok(None);
    }
    let frame = config.frame.unwrap_or_default();
    let cameras = dataset.train_views().map(|view| frame.camera(&view.camera));
    Ok(Some(SmoothingFloor::new(gpu, variance, near, &cameras.collect::<Vec<_>>())?))
}

/// Density control in the frame, for the cameras of the training views.
fn densifier(gpu: &Gpu, config: &TrainConfig, dataset: &Dataset) -> Result<Densifier> {
    let frame = config.frame.unwrap_or_default();
    let cameras = dataset.train_views().map(|view| frame.camera(&view.camera));
    let DensityConfig { control, gradient_threshold, split_scale, .. } = config.density;
    let settings = DensifySettings {
        control,
        gradient_threshold: gradient_threshold.unwrap_or(control.strategy().gradient_threshold),
        split_scale: split_scale * config.extent_of(dataset) * frame.scale,
        min_opacity: config.density.min_opacity,
        max_gaussians: config.max_gaussians,
        near: config.render_settings().near.into(),
        seed: Stream::new(config.seed, streams::DENSITY).bits(0),
    };
    Densifier::new(gpu, settings, &cameras.collect::<Vec<_>>())
}

/// The SH degree of the first step.
pub(super) fn first_sh_degree(config: &TrainConfig) -> u32 {
    config.sh_degree_at(1, config.sh_degree)
}

/// The background of a step.
pub(super) fn background(config: &TrainConfig, step: u64) -> [f32; 3] {
    match config.background {
        Background::Black => [0.0; 3],
        Background::Random => {
            let stream = Stream::new(config.seed, streams::BACKGROUND);
            std::array::from_fn(|c| stream.uniform(3 * step + c as u64) as f32)
        }
    }
}

#[cfg(test)]
mod tests {
    use std::time::{Duration, Instant};

    use nightsplat_synth::SyntheticOptions;
    use tempfile::TempDir;

    use super::*;
    use crate::gpu::testing::{compiled, gpu_with};
    use crate::train::Trainer;

    /// Views whose halves need the other kernel of SSIM.
    const SIZE: [u32; 2] = [132, 96];

    fn set() -> (TempDir, TrainConfig) {
        let folder = tempfile::tempdir().unwrap();
        let [width, height] = SIZE;
        let options = SyntheticOptions { views: 6, width, height, ..SyntheticOptions::default() };
        nightsplat_synth::write(folder.path(), &options).unwrap();
        let config = TrainConfig { dataset: folder.path().to_owned(), ..TrainConfig::default() };
        (folder, config)
    }

    #[test]
    fn a_trainer_uses_every_kernel_that_was_compiled_ahead() {
        let (_folder, config) = set();
        let dataset = Dataset::load(&config.dataset, &config.load_options()).unwrap();
        for is_cpu in [true, false] {
            // Devices of their own: those of other tests would have the kernels.
            let [ahead, alone] = [(); 2].map(|()| gpu_with(|device| device.is_cpu &= is_cpu));
            compile(&ahead, &config).unwrap();
            let first = compiled(&ahead);
            let tile = config.render_settings().tile_for(&alone, std::iter::once(SIZE)).unwrap();
            let [of_both, of_one] = [&ahead, &alone].map(|gpu| {
                let config = TrainConfig { tile: Some(tile), ..config.clone() };
                // The first step is that of a smaller view.
                Trainer::new(gpu, config, &dataset).unwrap().advance(1).unwrap();
                compiled(gpu)
            });
            assert_eq!(of_both, of_one, "CPU: {is_cpu}");
            assert!(2 * first > of_both, "{first} of {of_both}");
        }
    }

    #[test]
    fn no_more_kernels_are_compiled_once_loading_fails() {
        let ((_folder, config), gpu) = (set(), gpu_with(|_| ()));
        let before = compiled(&gpu);
        let failed = while_compiling::<()>(&gpu, &config, || {
            let begin = Instant::now();
            while compiled(&gpu) == before {
                assert!(begin.elapsed() < Duration::from_secs(60));
                thread::yield_now();
            }
            Err(Error::Usage("no such dataset".to_owned()))
        });
        assert_eq!(failed.unwrap_err().to_string(), "no such dataset");
        let some = compiled(&gpu) - before;
        compile(&gpu, &config).unwrap();
        assert!((1..compiled(&gpu) - before).contains(&some), "{some}");
    }
}
