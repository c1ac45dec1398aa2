//! Small datasets, and training on them.

use nightsplat::gpu::testing::gpu;
use nightsplat::train::{StepReport, TrainConfig, Trainer};
use nightsplat_models::gaussians::Gaussians;
use nightsplat_photographs::dataset::Dataset;
use nightsplat_synth::SyntheticOptions;

/// A synthetic set of this many views of a size.
pub(crate) fn small_set(views: usize, [width, height]: [u32; 2], seed: u64) -> SyntheticOptions {
    SyntheticOptions { views, width, height, seed, ..SyntheticOptions::default() }
}

/// A dataset of this many synthetic views of a size, loaded with default options.
pub(crate) fn dataset(views: usize, size: [u32; 2]) -> Dataset {
    let folder = tempfile::tempdir().unwrap();
    nightsplat_synth::write(folder.path(), &small_set(views, size, 1)).unwrap();
    Dataset::load(folder.path(), &TrainConfig::bare().load_options()).unwrap()
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
