//! Sorted intersections of the views, which are kept where no step changes a splat.

use nightsplat_core::watch::Stage;

use super::call::Call;
use super::config::TrainConfig;
use super::memory::list_bytes;
use super::model::TrainedModel;
use super::views::Views;
use crate::Result;
use crate::gpu::Gpu;

impl TrainedModel {
    /// Keeps those of further views for as long as the call has time, if means, shapes and opacities are frozen.
    pub(super) fn keep_lists(
        &mut self,
        gpu: &Gpu,
        config: &TrainConfig,
        views: &mut Views,
        call: &Call,
    ) -> Result<()> {
        if !config.freezes_splats() {
            return Ok(());
        }
        let (gaussians, viewpoints) = (self.gaussians.values.slice(), &mut views.viewpoints);
        let limit = list_bytes(gpu, config);
        let [kept, all] = viewpoints.kept_and_all();
        let stage = Stage::after("sorting views", kept, all);
        while call.has_time() && self.renderer.keep_next_lists(gaussians, viewpoints, limit)? {
            stage.next()?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use nightsplat_photographs::dataset::Dataset;
    use nightsplat_synth::SyntheticOptions;

    use super::*;
    use crate::gpu::testing::{gpu_that_sorts_tiles, gpu_with};
    use crate::train::{CacheSize, Trainer};

    /// Ten views at most: five at two sizes.
    #[test]
    fn views_whose_intersections_are_kept_train_the_bits_of_those_that_are_sorted_in_every_step() {
        let folder = tempfile::tempdir().unwrap();
        let set = SyntheticOptions { views: 6, width: 64, height: 48, ..Default::default() };
        nightsplat_synth::write(folder.path(), &set).unwrap();
        let config =
            TrainConfig { dataset: folder.path().to_owned(), steps: 20, ..TrainConfig::bare() };
        let dataset = Dataset::load(&config.dataset, &config.load_options()).unwrap();
        let freeze = Some("means,quats,scales,opacities".parse().unwrap());
        let frozen = TrainConfig { init: Some("day.ply".into()), freeze, ..config.clone() };
        for gpu in [gpu_with(|_| ()), gpu_that_sorts_tiles()] {
            let day = Trainer::new(&gpu, config.clone(), &dataset).unwrap().gaussians().unwrap();
            let trained = [0, 2, 10].map(|most| {
                let config = frozen.clone();
                let mut trainer = Trainer::from_gaussians(&gpu, config, &dataset, &day).unwrap();
                let in_use = Some(CacheSize(gpu.memory_in_use()));
                let full = TrainConfig { max_vram: in_use, ..frozen.clone() };
                assert_eq!(list_bytes(&gpu, &full), 0);
                let kept = |trainer: &Trainer| trainer.supervision.views.viewpoints.kept_and_all();
                trainer.advance_within(1, Duration::ZERO).unwrap();
                assert_eq!(kept(&trainer), [0, 10], "a call without time");
                let views = &mut trainer.supervision.views.viewpoints;
                let TrainedModel { gaussians, renderer, .. } = &mut trainer.model;
                // The last has no memory for another.
                let limits = (0..=most).map(|at| if at < most { 1 << 30 } else { 0 });
                let are_kept = limits.map(|limit| {
                    renderer.keep_next_lists(gaussians.values.slice(), views, limit).unwrap()
                });
                assert_eq!(are_kept.filter(|&is_kept| is_kept).count(), most);
                while !trainer.has_ended() {
                    trainer.advance(20).unwrap();
                }
                assert_eq!(kept(&trainer), [most, 10]);
                trainer.gaussians().unwrap()
            });
            assert!(trained[0] == trained[1] && trained[0] == trained[2]);
        }
    }
}
