//! Training on small datasets.

use std::path::Path;

use nightsplat::gpu::testing::gpu;
use nightsplat::train::{Part, StepReport, TrainConfig, Trainer};
use nightsplat_models::gaussians::Gaussians;
use nightsplat_photographs::dataset::Dataset;
use nightsplat_photographs::image::{Image, ImageFile as _};

use super::paths;
use super::sets::{small_set, written};

/// Six views of 40 x 30 pixels, with depth maps of half the size, as estimators return them: a plane that recedes
/// upwards.
pub(crate) fn write_with_depth(set: &Path) {
    nightsplat_synth::write(set, &small_set(6, [40, 30], 1)).unwrap();
    let map = Image::from_fn(20, 15, |x, y| [1.0 - (y as f32 + 0.1 * x as f32) / 20.0; 3]);
    std::fs::create_dir(set.join("depth")).unwrap();
    for photograph in paths(&set.join("low")) {
        let name = photograph.file_stem().unwrap().to_str().unwrap();
        map.save_png16(set.join(format!("depth/depth_{name}.png"))).unwrap();
    }
}

/// Enables parts, with small networks.
pub(crate) fn set_small_parts(config: &mut TrainConfig, parts: &[Part]) {
    config.model.set_parts(parts);
    let network = &mut config.model.network;
    (network.channels, network.stages, network.repeats) = (4, 2, 2);
}

/// A dataset of this many synthetic views of a size, loaded with default options.
pub(crate) fn dataset(views: usize, size: [u32; 2]) -> Dataset {
    Dataset::load(written(&small_set(views, size, 1)), &TrainConfig::bare().load_options()).unwrap()
}

/// Trains up to a step; returns the reports.
pub(crate) fn advance(trainer: &mut Trainer, until: u64) -> Vec<StepReport> {
    let mut reports = vec![];
    while trainer.steps_done() < until {
        reports.extend(trainer.advance(until).unwrap());
    }
    reports
}

/// A whole training: the reports, and the result.
pub(crate) fn train(config: &TrainConfig, dataset: &Dataset) -> (Vec<StepReport>, Gaussians) {
    let mut trainer = Trainer::new(&gpu(), config.clone(), dataset).unwrap();
    (advance(&mut trainer, config.steps), trainer.gaussians().unwrap())
}
