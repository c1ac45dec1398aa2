//! NaN where none is allowed: it is caught in the step in which it arises, named, and changes nothing.

use nightsplat::Error;
use nightsplat::gpu::testing::{Defect, with_defect};
use nightsplat::train::NotFinite;

use crate::common::prelude::*;
use crate::common::setup::Rendered;
use crate::common::train::dataset;

/// The background of the render is NaN, and therefore the loss.
const BAD_LOSS: Defect = Defect { kernel: "blend_forward", word: 4, bits: 0x7fc0_0000 };

/// The scale of the loss's gradient is NaN; the loss itself is not.
fn bad_gradient() -> Defect {
    let scale = (1.0 / (3.0 * 40.0 * 30.0)) as f32;
    Defect { kernel: "l1", word: 1, bits: scale.to_bits() ^ 0x7fc0_0000 }
}

fn config(not_finite: NotFinite) -> TrainConfig {
    let tone = ToneSettings::new(ToneCurve::Ap3);
    let mut config = TrainConfig { steps: 60, ssim_weight: 0.0, tone, ..TrainConfig::bare() };
    config.schedule.resolution_steps = Some([0, 0]);
    config.schedule.densify_after = u64::MAX / 2;
    config.stop.not_finite = not_finite;
    config
}

#[test]
fn a_not_finite_value_ends_the_run_at_its_own_step_with_view_and_place_and_changes_nothing() {
    let dataset = dataset(6, [40, 30]);
    for (defect, name) in [(BAD_LOSS, "L1"), (bad_gradient(), "a gradient")] {
        let mut trainer = Trainer::new(&gpu(), config(NotFinite::Stop), &dataset).unwrap();
        advance(&mut trainer, 3);
        let before = trainer.gaussians().unwrap();
        let (done, _) = with_defect(defect, || trainer.check_step());
        let Err(Error::NotFinite { step, view, what }) = done else {
            panic!("{name}: {done:?}");
        };
        assert_eq!((step, what.to_lowercase().as_str()), (4, name.to_lowercase().as_str()));
        assert!(dataset.views.iter().any(|known| known.name == view), "{view}");
        assert!(trainer.gaussians().unwrap() == before && trainer.steps_done() == 3, "{name}");
    }
}

#[test]
fn a_view_with_not_finite_values_is_left_out_and_the_run_continues_to_the_same_bits() {
    let dataset = dataset(6, [40, 30]);
    let folder = tempfile::tempdir().unwrap();
    for defect in [BAD_LOSS, bad_gradient()] {
        let new = || Trainer::new(&gpu(), config(NotFinite::SkipView), &dataset).unwrap();
        let mut trainer = new();
        advance(&mut trainer, 3);
        let before = trainer.gaussians().unwrap();
        let (done, _) = with_defect(defect, || trainer.check_step());
        assert!(done.unwrap().is_empty() && trainer.steps_done() == 3);
        assert!(
            trainer.gaussians().unwrap() == before,
            "the state before the step is the valid one"
        );
        let checkpoint = folder.path().join("checkpoint.safetensors");
        trainer.save_checkpoint(&checkpoint).unwrap();
        let reports = advance(&mut trainer, 30);
        let views: BTreeSet<&str> = reports.iter().map(|report| report.view.as_str()).collect();
        let all = dataset.train_views().count();
        assert_eq!(views.len(), all - 1, "{views:?}");
        let mut resumed = new();
        resumed.restore(&checkpoint).unwrap();
        let again = advance(&mut resumed, 30);
        let names = |reports: &[nightsplat::train::StepReport]| {
            reports.iter().map(|report| report.view.clone()).collect::<Vec<_>>()
        };
        assert_eq!(names(&again), names(&reports));
        assert!(resumed.gaussians().unwrap() == trainer.gaussians().unwrap());
    }
}

#[test]
fn the_last_view_is_never_left_out() {
    let dataset = dataset(6, [40, 30]);
    let mut trainer = Trainer::new(&gpu(), config(NotFinite::SkipView), &dataset).unwrap();
    let others = dataset.train_views().count() - 1;
    for _ in 0..others {
        let (done, _) = with_defect(BAD_LOSS, || trainer.check_step());
        assert!(done.unwrap().is_empty());
    }
    let (done, _) = with_defect(BAD_LOSS, || trainer.check_step());
    assert!(matches!(done, Err(Error::NotFinite { step: 1, .. })), "{done:?}");
}

#[test]
fn a_gradient_that_is_not_finite_raises_a_flag_and_does_not_change_the_statistics() {
    let setup = Setup::new(20, [33, 17], 3, 6);
    let mut rendered = setup.render();
    let mut d_render = vec![0.1; rendered.render.len()];
    d_render[40] = f32::NAN;
    let gradients = rendered.backward(&d_render);
    let status = gpu().read(rendered.renderer.status()).unwrap();
    let status = nightsplat::splats::render::Status::from_words(&status);
    assert!(status.gradient_not_finite && !status.not_finite);
    assert!(gradients.parameters.iter().any(|gradient| !gradient.is_finite()));
    assert!(gradients.grad_norm_sums.iter().all(|sum| sum.is_finite()));
}

/// Else the statistics would depend on which Gaussian raised the flag, and when.
#[test]
fn a_gaussian_adds_to_the_statistics_whether_or_not_another_has_raised_the_flag() {
    let count = 2000;
    let setup = Setup::new(count, [33, 17], 0, 6);
    let mut rendered = setup.render();
    let mut d_render = vec![0.1; rendered.render.len()];
    d_render[40] = f32::NAN;
    let gradients = rendered.backward(&d_render);
    let tile_counts = gpu().read(&rendered.renderer.frame().tile_counts).unwrap();
    let is_finite = |i: usize| {
        let gradient = setup.planes().load(&gradients.parameters, i);
        gradient.mean.is_finite()
            && gradient.quat.is_finite()
            && gradient.log_scale.is_finite()
            && gradient.raw_opacity.is_finite()
            && gradient.sh.iter().all(|sh| sh.is_finite())
    };
    let adds = |i: usize| tile_counts[i] > 0 && is_finite(i);
    let expected: Vec<u32> =
        (0..count).map(|i| Rendered::VISITS_BEFORE + u32::from(adds(i))).collect();
    let adding = (0..count).filter(|&i| adds(i)).count();
    let seen = tile_counts[..count].iter().filter(|&&tiles| tiles > 0).count();
    assert!(adding > 100 && adding < seen, "{adding} of {seen}");
    assert_eq!(gradients.visit_counts, expected);
}
