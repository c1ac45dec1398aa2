//! Training end to end on a small synthetic set.

use nightsplat::Error;
use nightsplat::gpu::DeviceChoice;
use nightsplat::gpu::testing::{gpu_that_sorts_tiles, recorded, submitted};
use nightsplat::results::eval::{self, After, Metric, ModelRenderer};
use nightsplat::splats::densify::DensityControl;
use nightsplat::splats::model::Model;
use nightsplat::train::{Background, StepReport};

use crate::common::prelude::*;
use crate::common::train::train;

/// Ten views of 64 x 48 pixels.
fn dataset() -> Dataset {
    crate::common::train::dataset(10, [64, 48])
}

/// Density control runs twice within sixty steps.
fn config() -> TrainConfig {
    let tone = ToneSettings::new(ToneCurve::Ap3);
    let mut config = TrainConfig { steps: 60, tone, ..TrainConfig::bare() };
    config.schedule.densify_after = 10;
    config.schedule.densify_interval = 20;
    config.schedule.sh_degree_interval = 15;
    config
}

fn mean_psnr(dataset: &Dataset, gaussians: &Gaussians) -> f64 {
    let model = Model::from(gaussians.clone());
    let mut model_renderer =
        ModelRenderer::new(&gpu(), &model, &TrainConfig::bare(), None).unwrap();
    let evaluation = eval::score(dataset, |view| model_renderer.render(view)).unwrap();
    evaluation.mean(Metric::Psnr, After::Model).unwrap()
}

#[test]
fn a_model_learns_to_show_the_scene_in_normal_light() {
    let dataset = dataset();
    let config = TrainConfig { steps: 200, ..config() };
    let (reports, gaussians) = train(&config, &dataset);
    let steps: Vec<u64> = reports.iter().map(|report| report.step).collect();
    assert_eq!(steps, (1..=200).collect::<Vec<_>>());
    let mean = |reports: &[StepReport]| {
        reports.iter().map(|report| report.loss).sum::<f64>() / reports.len() as f64
    };
    let (begin, end) = (mean(&reports[..9]), mean(&reports[191..]));
    assert!(end < 0.6 * begin, "the loss went from {begin} to {end}");
    let dark: Vec<Scores> = dataset
        .test_views()
        .map(|view| {
            Scores::measure(view.image.as_ref().unwrap(), view.reference.as_ref().unwrap()).unwrap()
        })
        .collect();
    let (dark, lit) = (Scores::mean(&dark).unwrap().psnr, mean_psnr(&dataset, &gaussians));
    assert!(lit > dark + 8.0, "the photographs score {dark} dB, the renders {lit} dB");
}

#[test]
fn a_round_of_density_control_hardly_changes_the_scores() {
    let dataset = dataset();
    let drop = |control: DensityControl| {
        let mut config = TrainConfig { steps: 400, ..config() };
        config.density.control = control;
        (config.schedule.densify_after, config.schedule.densify_interval) = (100, 160);
        config.density.gradient_threshold = Some(1e-4);
        let mut trainer = Trainer::new(&gpu(), config, &dataset).unwrap();
        advance(&mut trainer, 159);
        let before = (trainer.gaussian_count(), mean_psnr(&dataset, &trainer.gaussians().unwrap()));
        advance(&mut trainer, 160);
        let after = (trainer.gaussian_count(), mean_psnr(&dataset, &trainer.gaussians().unwrap()));
        assert!(4 * after.0 > 5 * before.0, "{before:?} {after:?}: hardly anything was split");
        before.1 - after.1
    };
    let (conserving, paper) = (drop(DensityControl::Conserving), drop(DensityControl::Paper));
    assert!(conserving <= 0.3, "{conserving} dB were lost");
    assert!(
        paper > conserving + 0.3,
        "the paper's control loses {paper} dB, not more than {conserving}"
    );
}

/// Of one threshold, since what pixels pull in opposite directions counts for one of them alone.
#[test]
fn the_conserving_control_densifies_more_than_the_papers_which_scores_the_sum_over_pixels() {
    let dataset = dataset();
    let growth = |control: DensityControl| {
        let mut config = TrainConfig { steps: 60, ..config() };
        config.density.control = control;
        config.density.gradient_threshold = Some(2e-3);
        (config.schedule.densify_after, config.schedule.densify_interval) = (10, 30);
        let mut trainer = Trainer::new(&gpu(), config, &dataset).unwrap();
        advance(&mut trainer, 29);
        let before = trainer.gaussian_count();
        advance(&mut trainer, 31);
        trainer.gaussian_count() as f64 / before as f64
    };
    let [conserving, paper] = [DensityControl::Conserving, DensityControl::Paper].map(growth);
    assert!(conserving - 1.0 > 2.0 * (paper - 1.0).max(0.02), "{conserving} {paper}");
}

#[test]
fn coarse_steps_come_first_and_repeat_bit_for_bit() {
    let dataset = crate::common::train::dataset(6, [128, 128]);
    let mut config = TrainConfig { steps: 30, ..config() };
    let (_, full) = train(&config, &dataset);
    config.schedule.resolution_steps = Some([8, 20]);
    let (reports, coarse) = train(&config, &dataset);
    assert_eq!(coarse, train(&config, &dataset).1);
    assert_ne!(coarse.parameters, full.parameters);
    assert!(reports.iter().all(|report| report.loss.is_finite()));
}

#[test]
fn the_same_seed_gives_the_same_bits_and_another_seed_gives_others() {
    let dataset = dataset();
    let config = TrainConfig { background: Background::Random, ..config() };
    let (_, first) = train(&config, &dataset);
    let (_, second) = train(&config, &dataset);
    assert_eq!(first, second);
    let (_, other) = train(&TrainConfig { seed: 11, ..config }, &dataset);
    assert_ne!(first.parameters, other.parameters);
}

#[test]
fn references_change_no_trained_bit() {
    let dataset = dataset();
    let mut spoiled = dataset.clone();
    for view in &mut spoiled.views {
        view.reference =
            Some(Image::filled(view.camera.width, view.camera.height, [0.9, 0.1, 0.5]));
        if view.split == Split::Test {
            view.image = None;
        }
    }
    assert_eq!(train(&config(), &dataset).1, train(&config(), &spoiled).1);
}

#[test]
fn steps_that_outgrow_their_memory_are_repeated_without_loss() {
    let dataset = dataset();
    let config = TrainConfig { steps: 20, ..config() };
    let run = |reserved: u32, in_flight: usize| {
        let mut trainer = Trainer::new(&gpu(), config.clone(), &dataset).unwrap();
        trainer.set_intersection_capacity(reserved).unwrap();
        trainer.set_batching(in_flight, Some(3));
        let mut reports = vec![];
        let mut interruptions = 0;
        while trainer.steps_done() < config.steps {
            let more = trainer.advance(config.steps).unwrap();
            interruptions += u32::from(more.is_empty());
            reports.extend(more);
        }
        let steps: Vec<u64> = reports.iter().map(|report| report.step).collect();
        assert_eq!(steps, (1..=20).collect::<Vec<_>>());
        (interruptions, trainer.gaussians().unwrap())
    };
    let (none, roomy) = run(100_000, 2);
    assert_eq!(none, 0);
    for in_flight in [1, 2, 3] {
        let (some, tight) = run(16, in_flight);
        assert!(some > 0, "no overflow with {in_flight} in flight");
        assert_eq!(roomy, tight, "{in_flight} in flight");
    }
}

#[test]
fn how_steps_are_submitted_changes_no_bit() {
    let dataset = dataset();
    let run = |in_flight: usize, steps: Option<u64>| {
        let mut trainer = Trainer::new(&gpu(), config(), &dataset).unwrap();
        trainer.set_batching(in_flight, steps);
        let losses: Vec<f64> = advance(&mut trainer, 60).iter().map(|report| report.loss).collect();
        (losses, trainer.gaussians().unwrap())
    };
    let one_by_one = run(1, Some(1));
    assert_eq!(one_by_one.0.len(), 60);
    for (in_flight, steps) in [(2, Some(1)), (1, Some(64)), (2, Some(7)), (2, None)] {
        assert_eq!(run(in_flight, steps), one_by_one, "{in_flight} in flight, {steps:?} steps");
    }
}

/// Some drivers do not compile kernels with plain constants, others none with specialization constants.
#[test]
fn who_specializes_the_kernels_changes_no_bit() {
    let dataset = dataset();
    let train = |gpu: &Gpu| {
        let mut trainer = Trainer::new(gpu, config(), &dataset).unwrap();
        advance(&mut trainer, 20);
        trainer.gaussians().unwrap()
    };
    assert_eq!(train(&gpu_with(|properties| properties.driver_specializes = true)), train(&gpu()));
}

/// Systems reset a device whose submission takes seconds.
#[test]
fn the_passes_of_a_slow_step_are_submitted_one_by_one_and_no_bit_changes() {
    const STEPS: u64 = 20;
    // A separate device: other tests would add to its counts.
    let (gpu, dataset) = (Gpu::new(&DeviceChoice::Best).unwrap(), dataset());
    let run = |slow_step: Duration| {
        let mut trainer = Trainer::new(&gpu, config(), &dataset).unwrap();
        trainer.set_batching(2, Some(1));
        trainer.set_slow_step(slow_step);
        let before = submitted(&gpu);
        advance(&mut trainer, STEPS);
        let submits = submitted(&gpu) - before;
        (submits, trainer.gaussians().unwrap())
    };
    let (at_once, whole) = run(Duration::MAX);
    let (one_by_one, cut) = run(Duration::ZERO);
    assert!(one_by_one >= at_once + 10 * STEPS, "{one_by_one} and {at_once} submissions");
    assert_eq!(cut, whole);
}

#[test]
fn a_plain_step_is_at_most_18_dispatches_and_barriers_on_a_gpu_and_in_small_views_on_a_cpu() {
    let with_all_coefficients = |rest| {
        let mut config = config();
        config.schedule.sh_degree_interval = 1;
        config.precision.rest = rest;
        config
    };
    // Separate devices: other tests would add to their counts.
    let cpu = Gpu::new(&DeviceChoice::Best).unwrap();
    // Views of more than 255 tiles have a second digit to sort by.
    let large = [320, 240];
    for (gpu, size, most) in [
        (cpu, [64, 48], [18, 16]),
        (gpu_with(|properties| properties.is_cpu = false), [64, 48], [16, 15]),
        (gpu_with(|properties| properties.is_cpu = false), large, [17, 16]),
        (gpu_that_sorts_tiles(), [64, 48], [13, 12]),
        (gpu_that_sorts_tiles(), large, [13, 12]),
    ] {
        let dataset = crate::common::train::dataset(4, size);
        for (bits, more) in [(StorageFormat::Single, 0), (StorageFormat::Half, 1)] {
            let recorded = recorded_for_a_step(&gpu, with_all_coefficients(bits), &dataset);
            let [dispatches, barriers] = recorded;
            let is_cpu = gpu.properties().is_cpu;
            let counted =
                format!("CPU {is_cpu}, {bits:?}: {dispatches} dispatches, {barriers} barriers");
            println!("{counted}");
            assert!(dispatches <= most[0] + more && barriers <= most[1] + more, "{counted}");
        }
    }
}

/// The dispatches and barriers of one step.
fn recorded_for_a_step(gpu: &Gpu, config: TrainConfig, dataset: &Dataset) -> [u64; 2] {
    let mut trainer = Trainer::new(gpu, config, dataset).unwrap();
    trainer.set_intersection_capacity(100_000).unwrap();
    trainer.set_batching(1, Some(64));
    let mut recorded_in = |until: u64| {
        let before = recorded(gpu);
        assert_eq!(trainer.advance(until).unwrap().last().unwrap().step, until);
        [0, 1].map(|i| recorded(gpu)[i] - before[i])
    };
    // Each of the first steps raises the SH degree; the cost of a submission is the same for two steps and for eight.
    for step in 1..=4 {
        recorded_in(step);
    }
    let (two, eight) = (recorded_in(6), recorded_in(14));
    [0, 1].map(|i| (eight[i] - two[i]).div_ceil(6))
}

/// Trains a few steps on views of one size, starting from `points` points.
fn train_on(size: [u32; 2], points: usize) -> (Vec<StepReport>, Gaussians) {
    let mut dataset = crate::common::train::dataset(3, [64, 48]);
    dataset.points.truncate(points);
    for view in &mut dataset.views {
        let [width, height] = size;
        view.camera.principal_point *= UVec2::from(size).as_dvec2() / DVec2::new(64.0, 48.0);
        (view.camera.width, view.camera.height) = (width, height);
        view.image = Some(Image::filled(width, height, [0.1, 0.2, 0.05]));
        view.reference = None;
    }
    let mut config = TrainConfig { steps: 6, random_points: 50, ..config() };
    config.schedule.densify_after = 1;
    config.schedule.densify_interval = 2;
    train(&config, &dataset)
}

#[test]
fn views_of_one_pixel_and_of_a_long_strip_are_trained_on() {
    for size in [[1, 1], [1, 33], [8192, 16]] {
        let (reports, gaussians) = train_on(size, usize::MAX);
        assert_eq!(reports.len(), 6, "{size:?}");
        assert!(reports.iter().all(|report| report.loss.is_finite()), "{size:?}");
        assert!(gaussians.parameters.iter().all(|value| value.is_finite()), "{size:?}");
    }
}

#[test]
fn one_gaussian_and_zero_gaussians_are_trained_and_rendered() {
    let (reports, gaussians) = train_on([64, 48], 1);
    assert!(reports.len() == 6 && gaussians.count <= 64);
    assert!(gaussians.parameters.iter().all(|value| value.is_finite()));
    let dataset = crate::common::train::dataset(3, [64, 48]);
    let none = Gaussians::zeros(0, Shape::from(3));
    let config = TrainConfig { steps: 6, ..config() };
    let mut trainer = Trainer::from_gaussians(&gpu(), config, &dataset, &none).unwrap();
    let reports = advance(&mut trainer, 6);
    assert!(reports.iter().all(|report| report.loss.is_finite() && report.gaussians == 0));
    let render = trainer.render(&dataset.views[0].camera).unwrap();
    assert!(render.colors.data.iter().all(|&value| value == 0.0));
}

#[test]
fn a_loss_that_is_not_finite_names_step_view_and_term() {
    let dataset = dataset();
    let mut gaussians = Trainer::new(&gpu(), config(), &dataset).unwrap().gaussians().unwrap();
    // The colours are finite; their squares in SSIM are not.
    gaussians.dc_mut().fill(Vec3::splat(1e30));
    let mut trainer = Trainer::from_gaussians(&gpu(), config(), &dataset, &gaussians).unwrap();
    let error = trainer.advance(20).unwrap_err();
    let Error::NotFinite { step, view, what } = &error else { panic!("{error}") };
    assert_eq!((*step, what.as_str()), (1, "SSIM"));
    assert!(dataset.train_views().any(|train| train.name == *view), "{error}");
    assert_eq!(trainer.steps_done(), 0);
    assert_eq!(trainer.gaussians().unwrap(), gaussians);
}

#[test]
fn a_parameter_that_is_not_finite_ends_the_run_with_step_and_plane_and_reaches_no_file() {
    let (dataset, mut config) = (dataset(), config());
    // A round of density control could prune the Gaussian before the check.
    config.schedule.densify_after = 1000;
    let mut gaussians =
        Trainer::new(&gpu(), config.clone(), &dataset).unwrap().gaussians().unwrap();
    gaussians.quats_mut()[7][2] = f32::NAN;
    let mut trainer = Trainer::from_gaussians(&gpu(), config, &dataset, &gaussians).unwrap();
    let folder = Folder::empty();
    let refused = trainer.save_checkpoint(&folder.join("a.safetensors")).unwrap_err().to_string();
    assert!(refused.contains("step 0: number 7 of quats is not finite"), "{refused}");
    assert_eq!(fs::read_dir(&folder).unwrap().count(), 0);
    let error = loop {
        match trainer.advance(60) {
            Ok(reports) => {
                assert!(reports.iter().all(|report| report.step < 60), "it was not detected");
            }
            Err(error) => break error,
        }
    };
    assert!(
        matches!(&error, Error::ParameterNotFinite { step: 50..=60, plane, .. } if plane == "quats"),
        "{error}"
    );
}

#[test]
fn a_dataset_without_points_starts_with_random_ones() {
    let mut dataset = dataset();
    dataset.points.clear();
    let config = TrainConfig { steps: 10, random_points: 300, ..config() };
    let (reports, gaussians) = train(&config, &dataset);
    assert_eq!((reports.len(), gaussians.count), (10, 300));
    assert!(gaussians.parameters.iter().all(|value| value.is_finite()));
}

#[test]
fn growth_stops_at_the_limit() {
    let dataset = dataset();
    let limit = dataset.points.len() + 5;
    let mut config = TrainConfig { max_gaussians: limit, ..config() };
    config.density.gradient_threshold = Some(1e-9);
    // The last round may use all of the remaining capacity.
    config.schedule.densify_before = 60;
    let (_, gaussians) = train(&config, &dataset);
    assert_eq!(gaussians.count, limit);
}

#[test]
fn a_render_shows_the_scene_that_its_model_was_trained_on() {
    let dataset = dataset();
    let mut trainer = Trainer::new(&gpu(), config(), &dataset).unwrap();
    advance(&mut trainer, 60);
    let view = &dataset.views[0];
    let in_training = trainer.render(&view.camera).unwrap();
    let model = trainer.model().unwrap();
    let mut model_renderer =
        ModelRenderer::new(&gpu(), &model, &TrainConfig::bare(), None).unwrap();
    assert_eq!(in_training.colors.data, model_renderer.render(view).unwrap().colors.data);
}
