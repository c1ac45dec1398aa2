//! The world's origin and unit make no difference to a model.

use nightsplat::results::eval::{self, After, Evaluation, Metric, ModelRenderer};
use nightsplat::results::run::{self, IfExists};
use nightsplat::splats::model::Model;
use nightsplat_core::camera::TrainingFrame;

use crate::common::prelude::*;

fn config() -> TrainConfig {
    let mut config = TrainConfig { steps: 150, ..TrainConfig::bare() };
    config.schedule.densify_after = 10;
    config.schedule.densify_interval = 40;
    config.schedule.resolution_steps = Some([0, 40]);
    config
}

/// The same scene and cameras in another world: scaled, then translated.
fn moved(dataset: &Dataset, scale: f64, offset: DVec3) -> Dataset {
    let mut moved = dataset.clone();
    for view in &mut moved.views {
        let DAffine3 { matrix3, translation } = view.camera.view_from_world;
        let translation = scale * translation - matrix3 * offset;
        view.camera.view_from_world = DAffine3 { matrix3, translation };
    }
    for point in &mut moved.points {
        point.position = scale * point.position + offset;
    }
    moved
}

fn mean_psnr(evaluation: &Evaluation) -> f64 {
    evaluation.mean(Metric::Psnr, After::Model).unwrap()
}

const WORLDS: [(f64, f64); 7] =
    [(1e-6, 0.0), (0.03, 0.0), (0.4, 1e4), (1e3, 0.0), (1e6, 0.0), (1.0, 1e7), (1e-3, -1e5)];

#[test]
fn a_scene_trains_equally_well_at_any_scale_and_position() {
    let dataset = crate::common::train::dataset(10, [64, 48]);
    let psnr = |dataset: &Dataset| {
        let mut trainer = Trainer::new(&gpu(), config(), dataset).unwrap();
        advance(&mut trainer, config().steps);
        mean_psnr(&eval::score(dataset, |view| trainer.render(&view.camera)).unwrap())
    };
    let expected = psnr(&dataset);
    assert!(expected > 17.0, "{expected}");
    for (scale, offset) in WORLDS {
        let there = psnr(&moved(&dataset, scale, offset * DVec3::new(1.0, -0.7, 0.1)));
        assert!((there - expected).abs() < 0.05, "{scale} at {offset}: {there}, not {expected}");
    }
}

#[test]
fn a_run_in_any_world_is_scored_as_trained_and_its_model_is_in_that_world() {
    let dataset = crate::common::train::dataset(10, [64, 48]);
    let config = TrainConfig { steps: 40, ..config() };
    for (scale, offset) in [(1e-6, 0.0), (1e6, 0.0), (3.0, 1e7)] {
        let offset = offset * DVec3::new(1.0, -0.7, 0.1);
        let there = moved(&dataset, scale, offset);
        let folder = tempfile::tempdir().unwrap();
        let out = folder.path().join("run");
        let trained = run::train(&gpu(), &config, &there, &out, IfExists::Refuse, |_| {}).unwrap();
        let recorded = run::load_config(&out).unwrap();
        let frame = recorded.frame.unwrap();
        assert_ne!(frame, TrainingFrame::WORLD);
        let model = Model::load(&out).unwrap();
        let mut model_renderer = ModelRenderer::new(&gpu(), &model, &recorded, None).unwrap();
        let stated = format!("comment nightsplat near {}\n", model.near);
        // A tenth of the frame's extent.
        assert!((f64::from(model.near) * frame.scale - 0.2).abs() < 1e-6, "{stated}");
        let gaussians = model.gaussians;
        let scored = eval::score(&there, |view| model_renderer.render(view)).unwrap();
        let (again, then) = (mean_psnr(&scored), mean_psnr(&trained.evaluation));
        assert!((again - then).abs() < 0.01, "{scale} at {offset}: {again}, not {then}");

        // Other programs see positions in the world, relative to the origin in the header.
        let header = fs::read(out.join("model.ply")).unwrap();
        let header = String::from_utf8_lossy(&header[..400]).into_owned();
        assert!(header.contains(&stated), "{header}");
        let origin = frame.file_origin();
        assert_eq!(
            header.contains("comment world = position + "),
            origin != DVec3::ZERO,
            "{header}"
        );
        let mean = |positions: &mut dyn Iterator<Item = DVec3>, count: usize| {
            positions.sum::<DVec3>() / count as f64
        };
        let model = mean(
            &mut gaussians.means().iter().map(|mean| mean.as_dvec3() + origin),
            gaussians.count,
        );
        let points = mean(&mut there.points.iter().map(|point| point.position), there.points.len());
        assert!(model.distance(points) < 0.5 * there.extent(), "{model} {points}");
        let scales = gaussians.log_scales().iter().map(|scale| f64::from(scale.x)).sum::<f64>();
        let typical = (scales / gaussians.count as f64).exp() / there.extent();
        assert!((1e-3..1.0).contains(&typical), "{scale}: {typical} of the extent");
    }
}

#[test]
fn a_run_that_starts_from_a_model_of_its_world_starts_with_its_scores() {
    let dataset = crate::common::train::dataset(10, [64, 48]);
    let config = TrainConfig { steps: 40, ..config() };
    for (scale, offset) in [(1.0, 0.0), (3.0, 4.5e6)] {
        let there = moved(&dataset, scale, offset * DVec3::new(1.0, -0.7, 0.1));
        let psnr = |trainer: &mut Trainer| {
            mean_psnr(&eval::score(&there, |view| trainer.render(&view.camera)).unwrap())
        };
        let mut trainer = Trainer::new(&gpu(), config.clone(), &there).unwrap();
        advance(&mut trainer, config.steps);
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("model.ply");
        let model = trainer.gaussians().unwrap();
        assert_eq!(model.origin != DVec3::ZERO, offset > 0.0);
        ply::save(&model, &path).unwrap();
        let from_model = TrainConfig { init: Some(path), ..config.clone() };
        let mut again = Trainer::new(&gpu(), from_model, &there).unwrap();
        let [before, after] = [psnr(&mut trainer), psnr(&mut again)];
        assert!((before - after).abs() < 0.01, "{scale} at {offset}: {after}, not {before}");
    }
}

#[test]
fn a_resumed_run_stays_in_its_frame_and_an_old_run_in_its_world() {
    let dataset = moved(&crate::common::train::dataset(10, [64, 48]), 0.1, DVec3::ZERO);
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("run");
    let config = TrainConfig { steps: 6, checkpoint_every: 5, ..config() };
    run::train(&gpu(), &config, &dataset, &out, IfExists::Refuse, |_| {}).unwrap();
    let longer = TrainConfig { steps: 8, ..config };
    let resumed = run::train(&gpu(), &longer, &dataset, &out, IfExists::Resume, |_| {}).unwrap();
    assert_eq!(*resumed.trainer.frame(), dataset.frame());
    assert_ne!(dataset.frame(), TrainingFrame::WORLD);
    // As written by a version without frames.
    let path = out.join("config.toml");
    let text = fs::read_to_string(&path).unwrap();
    let (before, after) = text.split_once("[frame]\n").unwrap();
    let after = after.split_once("\n[").map_or("", |(_, after)| after);
    fs::write(&path, format!("{before}[{after}")).unwrap();
    let longer = TrainConfig { steps: 9, ..longer };
    let old = run::train(&gpu(), &longer, &dataset, &out, IfExists::Resume, |_| {}).unwrap();
    assert_eq!(*old.trainer.frame(), TrainingFrame::WORLD);
}
